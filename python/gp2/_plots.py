"""Pictures by matplotlib, which the package needs for nothing else. They take axes, or make them, and return them."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from gp2 import _gp2

_BAND = 1.96  # standard deviations on both sides: 95 %


def _axes(given: Any, n: int = 1, width: float = 5.5) -> Any:
    if given is not None:
        return given
    pyplot = importlib.import_module("matplotlib.pyplot")
    return pyplot.subplots(1, n, figsize=(width * n, 4), layout="constrained")[1]


def _text(name: str) -> str:
    # matplotlib reads what stands between two of them as mathematics
    return name.replace("$", r"\$")


def _plot_learned(self: _gp2.Posterior, what: Any = None, *, along: Any = None, force: Any = None, ax: Any = None) -> Any:
    """plot_learned(self: Posterior, what: str | None = None, *, along: str | None = None, force: str | None = None, ax=None)

    Draw one learned force along one variable, with its 95 % band and marks where the training data are; returns the axes. What is not
    said is chosen as by gp2.plot.
    """
    curve = _gp2._learned_curve(self, what=what, along=along, force=force)  # type: ignore[attr-defined]
    ax = _axes(ax)
    half = _BAND * curve["std"]
    (line,) = ax.plot(curve["at"], curve["mean"], label=_text(curve["latent"]))
    ax.fill_between(curve["at"], curve["mean"] - half, curve["mean"] + half, color=line.get_color(), alpha=0.2, lw=0)
    ax.plot(curve["data"], np.zeros(len(curve["data"])), "|", color="gray", alpha=0.5, transform=ax.get_xaxis_transform(), ms=12)
    ax.set(xlabel=_text(curve["along"]), ylabel=_text(curve["name"]), title=_text(curve["latent"]))
    return ax


def _plot_predictions(self: _gp2.Posterior, data: Any, system: Any = None, columns: Any = None, *, ax: Any = None) -> Any:
    """plot_predictions(self: Posterior, data: Table, system: System | None = None, columns: Mapping | None = None, *, ax=None)

    Draw predicted accelerations, with their 95 % intervals, against those that a log has measured; returns an array of axes, one for
    each output. The intervals include the measurement noise where it is known, so that 95 % of them should reach the line, on which
    exact predictions of exact measurements lie.
    """
    found = _gp2._compared(self, data, system, columns)  # type: ignore[attr-defined]
    axes = np.ravel(_axes(ax, len(found["outputs"]), 4))
    if axes.size != len(found["outputs"]):
        raise _gp2.InputError(f"ax: expected {len(found['outputs'])} axes, of {', '.join(found['outputs'])}; got {axes.size}")
    for k, output in enumerate(map(_text, found["outputs"])):
        measured, mean = found["measured"][:, k], found["mean"][:, k]
        half = _BAND * np.hypot(found["std"][:, k], np.nan_to_num(found["noise"][:, k]))
        axes[k].errorbar(measured, mean, half, fmt=".", elinewidth=0.8, ecolor="lightgray")
        axes[k].axline((float(np.nanmean(measured)),) * 2, slope=1, color="gray", lw=0.8)
        axes[k].set(xlabel=f"measured {output}", ylabel=f"predicted {output}")
    return axes


def _plot_calibration(self: _gp2.Posterior, data: Any, system: Any = None, columns: Any = None, *, ax: Any = None) -> Any:
    """plot_calibration(self: Posterior, data: Table, system: System | None = None, columns: Mapping | None = None, *, ax=None)

    Draw the share of a log's measurements within the central interval of every probability, measurement noise included; returns the axes.
    Below the diagonal the deviations are too small, above it too large.
    """
    found = _gp2._compared(self, data, system, columns)  # type: ignore[attr-defined]
    ax = _axes(ax, width=4.5)
    ax.plot([0, 1], [0, 1], color="gray", lw=0.8)
    ax.plot(found["levels"], found["coverage"])
    ax.set(xlabel="probability of the interval", ylabel="share of measurements", xlim=(0, 1), ylim=(0, 1))
    return ax


def _plot_motion(self: _gp2.Motion, *, ax: Any = None) -> Any:
    """plot(self: Motion, *, ax=None)

    Draw the coordinates against time; returns the axes.
    """
    ax = _axes(ax)
    names = self.table.columns[1 : 1 + self.q.shape[1]]  # after t
    for name, values in zip(names, self.q.T):
        ax.plot(self.t, values, label=_text(name))
    ax.set(xlabel="t [s]")
    ax.legend()
    return ax


def _prepare() -> None:
    for name, drawn in {"plot_learned": _plot_learned, "plot_predictions": _plot_predictions, "plot_calibration": _plot_calibration}.items():
        setattr(_gp2.Posterior, name, drawn)
    setattr(_gp2.Motion, "plot", _plot_motion)


_prepare()
