"""A scikit-learn estimator around gp2.fit.

    model = GP2Regressor("surface.toml", mean="force").fit(X, y)
    ddq, std = model.predict(X, return_std=True)
"""

from __future__ import annotations

import numbers
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_array, check_is_fitted

import gp2

try:
    from sklearn.utils.validation import validate_data
except ImportError:  # scikit-learn before 1.6

    def validate_data(estimator: Any, *arguments: Any, **options: Any) -> Any:
        return estimator._validate_data(*arguments, **options)


_Array = npt.NDArray[np.float64]
_Table = Any  # an array or a frame, of pandas say


class GP2Regressor(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Learn accelerations ddq = f(q, dq, t, u) that obey the constraints of a mechanical system (Geist & Trimpe 2020).

    X holds states. An array has the columns of `system.state_names`: q, dq, t, u. A frame has columns by these names, in any
    order; one that the system does not read may be missing. `fit` and `predict` each take either, whatever the other was given;
    a frame whose columns are whole numbers is an array. y holds measured accelerations: an array with the columns of
    `system.acceleration_names` or of `observe`, (n,) where it is one, or a frame by name, whose columns are what is observed.
    Predictions have the shape and the columns of y. Without a system the columns of X are those of `fit`, as in scikit-learn.

    Parameters
    ----------
    system : gp2.System, path of a model file, or None
        None knows no mechanics: an ordinary Gaussian process from the columns of X to each of y, with one kernel for all.
    mean, prior, baseline, estimate, discrepancy
        As in gp2.fit.
    observe : names of accelerations, the columns of y; default: those of y where it is a frame or a Series, else all.
    noise_std : standard deviation of y, or 'estimate'; default: the system's, which for None is estimated.
    n_restarts : runs of the optimiser; default: 5, of a baseline 30.
    max_iterations : of each run; 0 keeps the starting values.
    n_threads : 0 stands for all cores. The result does not depend on it.
    random_state : int, RandomState or None: the starts of the runs. Same int, same bits.
    fit_options : the other options of gp2.fit by name, say {"hyperparameters": "optimise", "robust": True}.

    Attributes
    ----------
    posterior_ : gp2.Posterior, which can do more: other views, transfer, simulation.
    system_ : gp2.System
    outputs_ : names of the columns of y
    log_marginal_likelihood_value_ : log p(y) at the fitted values, without hyper-prior
    n_features_in_, feature_names_in_ : number and names of the columns that `fit` was given, as scikit-learn has them

    An input with a delay or a lag is taken as what acts, since rows of X do not say what was commanded before: `fit` warns of it.
    System.states(log) gives what acts; gp2.fit takes the log itself.

    Where it differs from sklearn.gaussian_process.GaussianProcessRegressor: y (n, 1) is predicted as (n, 1), not (n,); before
    fit, predict raises NotFittedError; samples of several outputs belong together, so that each obeys the constraint;
    random_state is 0 unless given. Standard deviations and covariances are those of the function, without measurement noise.
    """

    def __init__(
        self,
        system: gp2.System | str | os.PathLike[str] | None = None,
        *,
        mean: Literal["zero", "force"] = "zero",
        prior: Literal["acceleration", "force"] | None = None,
        baseline: Literal["se", "icm", "lmc"] | None = None,
        observe: str | Sequence[str] | None = None,
        noise_std: float | Literal["estimate", "stated"] | None = None,
        estimate: Sequence[str] | None = None,
        discrepancy: bool | Literal["default", "none"] = True,
        n_restarts: int | None = None,
        max_iterations: int = 1000,
        n_threads: int = 0,
        random_state: Any = 0,
        fit_options: Mapping[str, Any] | None = None,
    ) -> None:
        self.system = system
        self.mean = mean
        self.prior = prior
        self.baseline = baseline
        self.observe = observe
        self.noise_std = noise_std
        self.estimate = estimate
        self.discrepancy = discrepancy
        self.n_restarts = n_restarts
        self.max_iterations = max_iterations
        self.n_threads = n_threads
        self.random_state = random_state
        self.fit_options = fit_options

    def fit(self, X: _Table, y: _Table) -> GP2Regressor:
        """Fit to states X (n, len(state_names)) and accelerations y (n, nq) or (n,).

        Raises gp2.InputError, a ValueError, where X, y, the options and the system do not go together; gp2.NumericalError.
        """
        self.__dict__.pop("posterior_", None)  # of an earlier fit, should this one fail
        system = self._given_system()
        self._has_mechanics = system is not None
        if system is None and self.observe is not None:
            raise gp2.InputError("observe: goes with a system")
        if system is not None:
            _warn_of_late_inputs(system)
            outputs = self._outputs(system, y)
            y = _columns_by_name(y, outputs, system)
        given = None if system is None else _column_names("X", X)  # before it becomes an array
        X, y = validate_data(self, _without_mask(X), _without_mask(y), dtype=np.float64, multi_output=True, y_numeric=True, ensure_min_samples=2)
        rows = y.reshape(len(y), -1).astype(np.float64)
        if system is not None:
            _warn_of_scaled(X)
        self.system_ = _system_without_mechanics(X.shape[1], rows) if system is None else system
        self.outputs_ = self.system_.acceleration_names if system is None else outputs
        self._is_flat = y.ndim == 1
        states = self._states(X, given)
        if rows.shape[1] != len(self.outputs_):
            raise gp2.InputError(f"y: expected columns {', '.join(self.outputs_)}; got shape {y.shape}")

        names = self.system_.acceleration_names
        accelerations = np.full((len(rows), len(names)), np.nan)
        accelerations[:, self._rows_of_view()] = rows
        options: dict[str, Any] = {
            "observe": self.outputs_ if len(self.outputs_) < len(names) else None,
            "mean": self.mean,
            "prior": self.prior,
            "baseline": self.baseline,
            "noise_std": self.noise_std,
            "estimate": self.estimate,
            "discrepancy": self.discrepancy,
            "restarts": self.n_restarts,
            "max_iterations": self.max_iterations,
            "threads": self.n_threads,
            "seed": _seed(self.random_state),
        }
        others = dict(self.fit_options or {})
        for name in sorted(others.keys() & (options.keys() | self.get_params().keys() | {"data"})):
            own = {"restarts": "n_restarts", "threads": "n_threads", "seed": "random_state"}.get(name, name)
            raise gp2.InputError(f"fit_options: '{name}' is the argument {own} of GP2Regressor itself")
        try:
            self.posterior_ = gp2.fit(self.system_, (states, accelerations), **options, **others)
        except (gp2.InputError, TypeError) as error:
            raise type(error)(re.sub("^(restarts|threads):", r"n_\1:", str(error))) from None
        self.log_marginal_likelihood_value_ = -self.posterior_.report.negative_log_likelihood
        return self

    @overload
    def predict(self, X: _Table) -> _Array: ...
    @overload
    def predict(self, X: _Table, return_std: Literal[True]) -> tuple[_Array, _Array]: ...
    @overload
    def predict(self, X: _Table, return_std: Literal[False] = False, *, return_cov: Literal[True]) -> tuple[_Array, _Array]: ...
    @overload
    def predict(self, X: _Table, return_std: bool = False, return_cov: bool = False) -> _Array | tuple[_Array, _Array]: ...
    def predict(self, X: _Table, return_std: bool = False, return_cov: bool = False) -> _Array | tuple[_Array, _Array]:
        """Mean (n, d), or (n,) for a flat y; then its standard deviation, of that shape, or its covariance.

        The covariance (n, n, d), or (n, n), is that of each output over all states. `posterior_.predict` has the one between the
        outputs at each state, `posterior_.joint` both.
        """
        if return_std and return_cov:
            raise ValueError("return_std, return_cov: at most one of them")
        states = self._checked_states(X)
        rows = self._rows_of_view()
        if return_cov:
            n, nq = len(states), len(self.system_.acceleration_names)
            mean, covariance = self.posterior_.joint(states)
            blocks = covariance.reshape(n, nq, n, nq)[:, rows, :, rows]  # (d, n, n)
            return self._as_y(mean.reshape(n, nq)[:, rows]), self._as_y(np.moveaxis(blocks, 0, -1))
        prediction = self.posterior_.predict(states, mean_only=not return_std, threads=self.n_threads)
        mean = self._as_y(prediction.mean[:, rows])
        return (mean, self._as_y(prediction.std[:, rows])) if return_std else mean

    def sample_y(self, X: _Table, n_samples: int = 1, random_state: Any = 0) -> _Array:
        """Functions drawn from the posterior, at X: (n, d, n_samples), or (n, n_samples) for a flat y."""
        states = self._checked_states(X)
        samples = self.posterior_.sample(states, n_samples, seed=_seed(random_state))[:, :, self._rows_of_view()]
        samples = np.transpose(samples, (1, 2, 0))
        return samples[:, 0] if self._is_flat else samples

    def score(self, X: _Table, y: _Table, sample_weight: npt.ArrayLike | None = None) -> float:
        """R² of the prediction, the mean over the columns of y."""
        check_is_fitted(self, "posterior_")
        y = _columns_by_name(y, self.outputs_, self.system_) if self._has_mechanics else y
        return float(super().score(X, _without_mask(y), sample_weight))

    def _given_system(self) -> gp2.System | None:
        if self.system is None or isinstance(self.system, gp2.System):
            return self.system
        if not isinstance(self.system, (str, os.PathLike)):
            raise TypeError(f"system: expected a gp2.System, the path of a model file or None, got {self.system!r}")
        return gp2.System.load(self.system)

    def _outputs(self, system: gp2.System, y: _Table) -> list[str]:
        names = system.acceleration_names
        if self.observe is not None:
            what, outputs = "observe", [self.observe] if isinstance(self.observe, str) else list(self.observe)
        else:
            what, outputs = "y", _column_names("y", y) or _name_of_series(y, system) or names
        if not outputs:
            raise gp2.InputError(f"{what}: expected at least one name, got []")
        _refuse_twice(what, [str(name) for name in outputs])
        unknown = [str(name) for name in outputs if name not in names]
        if unknown:
            raise gp2.InputError(f"{what}: {', '.join(unknown)}: no acceleration of '{system.name}': {', '.join(names)}")
        return outputs

    def _columns_in_state(self, n_columns: int, given: list[str] | None) -> list[int]:
        names = self.system_.state_names
        if not self._has_mechanics:
            return [names.index(name) for name in self.system_.inputs]
        unknown = [name for name in given or [] if name not in names]
        if unknown:
            raise gp2.InputError(f"X: {', '.join(unknown)}: no part of a state of '{self.system_.name}': {', '.join(names)}")
        if given is None and n_columns != len(names):
            raise gp2.InputError(f"X: expected {len(names)} columns, {', '.join(names)}; got {n_columns} feature(s)")
        return [names.index(name) for name in given or names]

    def _states(self, X: _Array, given: list[str] | None) -> _Array:
        """States from X with columns of the names `given`, or, where there are none, of all states in order."""
        states = np.full((len(X), len(self.system_.state_names)), np.nan)
        states[:, self._columns_in_state(X.shape[1], given)] = X
        return states

    def _checked_states(self, X: _Table) -> _Array:
        check_is_fitted(self, "posterior_")
        if not self._has_mechanics:
            return self._states(validate_data(self, _without_mask(X), dtype=np.float64, reset=False), None)
        # scikit-learn would compare number and order of the columns with those of fit, but the system says what they are
        given = _column_names("X", X)
        names, fitted = list(self.system_.state_names), list(getattr(self, "feature_names_in_", ()))
        if given is None and len(fitted) == len(names) and fitted != names:
            warnings.warn(
                f"X has no column names and is read as {', '.join(names)}, but fit was given {', '.join(fitted)}",
                stacklevel=3,
            )
        return self._states(check_array(_without_mask(X), dtype=np.float64, estimator=self, input_name="X"), given)

    def _rows_of_view(self) -> list[int]:
        return [self.system_.acceleration_names.index(name) for name in self.outputs_]

    def _as_y(self, values: _Array) -> _Array:
        return values[..., 0] if self._is_flat else values


def _system_without_mechanics(n_features: int, y: _Array) -> gp2.System:
    """Unit masses without constraints, pushed by functions of free inputs."""
    features = [f"x{k + 1}" for k in range(n_features)]
    outputs = [f"y{k + 1}" for k in range(y.shape[1])]
    return gp2.System(
        name="without mechanics",
        coordinates=outputs,
        inputs=features,
        mass=np.eye(len(outputs)),
        latents=[{"features": features}],
        noise={"estimate": True, "initial": 0.1 * (y.std() or 1.0)},
    )


def _warn_of_scaled(X: _Array) -> None:
    """States have the units of their system: what a scaler makes of them are others."""
    varied = X[:, np.ptp(X, axis=0) > 0]
    if varied.shape[1] < 2:
        return

    def all_are(values: _Array, wanted: float) -> bool:
        return np.allclose(values, wanted, rtol=0, atol=1e-6)

    is_standard = all_are(varied.mean(axis=0), 0) and all_are(varied.std(axis=0), 1)
    is_between = varied.shape[1] > 2 and all_are(varied.min(axis=0), 0) and all_are(varied.max(axis=0), 1)  # two may be a grid's
    if is_standard or is_between:
        warnings.warn(
            "X: every column is scaled alike, as by a scaler: the system's equations take states in their own units; leave it out",
            UserWarning, stacklevel=3)


def _without_mask(values: _Table) -> _Table:
    """A masked array as one that is NaN where it is masked: scikit-learn would take what is behind the mask."""
    has_mask = isinstance(values, np.ma.MaskedArray)
    return values.astype(np.float64).filled(np.nan) if has_mask else values


def _column_names(what: str, table: _Table) -> list[str] | None:
    """The names of a frame's columns; None where they are whole numbers, or it is no frame."""
    names = list(getattr(table, "columns", []))
    if hasattr(table, "column_names") or all(isinstance(name, numbers.Integral) for name in names):  # Arrow's columns are values
        return None
    for name in names:
        if not isinstance(name, str):
            raise gp2.InputError(f"{what}: column names must be text, got {name!r}")
    _refuse_twice(what, names)
    return names


def _name_of_series(y: _Table, system: gp2.System) -> list[str] | None:
    """The name of a Series that is an acceleration of the system, in a list; None of all else."""
    return [y.name] if getattr(y, "name", None) in system.acceleration_names else None


def _warn_of_late_inputs(system: gp2.System) -> None:
    if system.late_inputs:
        warnings.warn(
            f"system: {', '.join(system.late_inputs)}: acts later than it is commanded. Rows of X are taken as what acts, as "
            "System.states(log) gives it, not as commands", stacklevel=3)


def _refuse_twice(what: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise gp2.InputError(f"{what}: {', '.join(twice)}: given twice")


def _columns_by_name(y: _Table, names: list[str], system: gp2.System) -> _Table:
    columns = _column_names("y", y)
    given = columns or _name_of_series(y, system)
    if given is None:
        return y
    missing = [name for name in names if name not in given]
    if missing:
        raise gp2.InputError(f"y: no column {', '.join(missing)}; it has: {', '.join(given)}")
    return y[names] if columns else y


def _seed(random_state: Any) -> int:
    if isinstance(random_state, (int, np.integer)) and random_state >= 0:
        return int(random_state)
    return int(check_random_state(random_state).randint(2**31))
