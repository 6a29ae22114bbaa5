"""The text of a model file (TOML) from Python values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from os import PathLike, fspath
from typing import Any


def model_text(
    *,
    coordinates: Sequence[Any] | None = None,
    mass: Sequence[Sequence[Any]] | None = None,
    robot: str | PathLike[str] | None = None,
    name: str | None = None,
    inputs: Sequence[str | Mapping[str, Any]] = (),
    parameters: Mapping[str, Any] | None = None,
    let: Mapping[str, Any] | None = None,
    force: Sequence[Any] | None = None,
    force_on: Mapping[str, Any] | None = None,
    potential: Any = None,
    coriolis: bool | None = None,
    constraints: Any = (),
    latents: Sequence[Mapping[str, Any]] = (),
    noise: Any = None,
    truth: Any = None,
    sampling: Mapping[str, Any] | None = None,
    motion: Mapping[str, Any] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    drawing: Mapping[str, Any] | None = None,
) -> str:
    mechanics = {"mass": mass, "force": force, "force_on": force_on, "potential": potential, "coriolis": coriolis}
    if not isinstance(constraints, Mapping):
        constraints = {} if constraints is None or len(constraints) == 0 else {"position": constraints}
    if noise is not None and not (isinstance(noise, Mapping) and "ddq" in noise):
        noise = {"ddq": noise}
    if truth is not None and not isinstance(truth, Mapping):
        truth = {"acceleration": truth}

    lines = [f"name = {_value(name)}"] if name is not None else []
    if robot is not None:
        lines.append(f"robot = {_value(fspath(robot))}")
    if coordinates is not None or robot is None:
        lines.append(f"coordinates = {_value([] if coordinates is None else coordinates)}")
    lines.append(f"inputs = {_value(inputs)}")
    tables = {
        "parameters": parameters,
        "let": let,
        "mechanics": mechanics,
        "constraints": constraints,
        "noise": noise,
        "truth": truth,
        "sampling": sampling,
        "motion": motion,
        "columns": columns,
        "units": units,
        "drawing": drawing,
    }
    for table, entries in tables.items():
        entries = {} if entries is None else entries
        _require_mapping(table, entries)
        if written := _entries(entries):
            lines += ["", f"[{table}]", *written]
    if isinstance(latents, (str, Mapping)):
        raise TypeError(f"latents: expected a list of mappings, one for each latent, got {latents!r}")
    for latent in latents if latents is not None else ():
        _require_mapping("latents", latent)
        lines += ["", "[[latent]]", *_entries(latent)]
    return "\n".join(lines) + "\n"


def _require_mapping(name: str, value: Any) -> None:
    if not isinstance(value, Mapping):
        raise TypeError(f"{name}: expected a mapping of names to values, got {value!r}")


def _entries(table: Mapping[str, Any]) -> list[str]:
    return [f"{_key(str(key))} = {_value(value)}" for key, value in table.items() if value is not None]


def _key(key: str) -> str:
    return key if key.isidentifier() and key.isascii() else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Integral):
        return repr(int(value))
    if isinstance(value, Real):
        return repr(float(value))
    if isinstance(value, Mapping) and "function" in value:
        return "{ " + f"code = {_value(list(value.get('names', ())))}" + " }"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(_entries(value)) + " }"
    if hasattr(value, "tolist"):  # of NumPy
        return _value(value.tolist())
    if isinstance(value, Sequence):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    raise TypeError(f"a model holds text, numbers, lists and mappings, not {type(value).__name__}: {value!r}")
