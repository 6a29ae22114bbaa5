import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol, TypedDict, Union, overload

import numpy as np
import numpy.typing as npt

__version__: str
FAR_FROM_DATA: float

class _Columns(Protocol):  # a pandas frame, say
    def keys(self) -> Iterable[Any]: ...
    def __getitem__(self, name: Any, /) -> Any: ...

class _Frame(Protocol):  # of polars, say
    @property
    def columns(self) -> Sequence[str]: ...
    def __getitem__(self, name: Any, /) -> Any: ...

_Array = npt.NDArray[np.float64]
_Path = Union[str, bytes, os.PathLike[str], os.PathLike[bytes]]
_Table = Union[Table, str, os.PathLike[str], os.PathLike[bytes], _Columns, _Frame, npt.NDArray[np.void]]
_Arrays = tuple[npt.ArrayLike | _Table, npt.ArrayLike | _Table]  # states, accelerations
_Text = Union[str, float]  # an expression or a number
_View = Literal["constrained", "unconstrained", "constraint-force", "multipliers", "next-velocity", "force"]
_Parameters = dict[str, float]
_Matrices = tuple[npt.ArrayLike, Union[npt.ArrayLike, None], Union[npt.ArrayLike, None], npt.ArrayLike]  # M, A, b, F

class InputError(ValueError): ...
class NumericalError(ArithmeticError): ...

class Table:
    def __init__(self, columns: _Table, name: str | None = None) -> None: ...
    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> list[str]: ...
    def keys(self) -> list[str]: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[str]: ...
    def __contains__(self, arg0: object) -> bool: ...
    def __getitem__(self, name: str) -> _Array: ...
    def to_frame(self) -> Any: ...

class Mechanics:
    @property
    def M(self) -> _Array: ...
    @property
    def A(self) -> _Array: ...
    @property
    def b(self) -> _Array: ...
    @property
    def F(self) -> _Array: ...

class Finding:
    @property
    def level(self) -> Literal["ok", "warning", "error"]: ...
    @property
    def text(self) -> str: ...

class System:
    def __init__(
        self,
        *,
        coordinates: Sequence[str | Mapping[str, Any]] | None = None,
        mass: Sequence[Sequence[_Text]] | npt.NDArray[Any] | None = None,
        robot: _Path | None = None,
        name: str | None = None,
        inputs: Sequence[str | Mapping[str, Any]] = (),
        parameters: Mapping[str, float | Mapping[str, Any]] | None = None,
        let: Mapping[str, _Text] | None = None,
        force: Sequence[_Text] | None = None,
        force_on: Mapping[str, _Text] | None = None,
        potential: _Text | None = None,
        coriolis: bool | None = None,
        constraints: Sequence[_Text] | Mapping[str, Sequence[_Text]] = (),
        latents: Sequence[Mapping[str, Any]] = (),
        noise: float | Sequence[float] | Mapping[str, Any] | None = None,
        truth: Sequence[_Text] | Mapping[str, Any] | None = None,
        sampling: Mapping[str, Any] | None = None,
        motion: Mapping[str, Any] | None = None,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        drawing: Mapping[str, Any] | None = None,
    ) -> None: ...
    @staticmethod
    def load(path: _Path) -> System: ...
    @staticmethod
    def parse(text: str, name: str = "text", robot: str | None = None) -> System: ...
    @staticmethod
    def from_callables(
        mechanics: Callable[[_Array, _Parameters], _Matrices],
        constraints: Sequence[str] | Mapping[str, Sequence[str]] = (),
        derivatives: Callable[[_Array, _Parameters, str], _Matrices] | None = None,
        residuals: Callable[[_Array, _Parameters], npt.ArrayLike] | None = None,
        reads: Sequence[str] | None = None,
        **kwargs: Any,
    ) -> System: ...
    @property
    def name(self) -> str: ...
    @property
    def text(self) -> str: ...
    @property
    def robot(self) -> str | None: ...
    @property
    def coordinates(self) -> list[str]: ...
    @property
    def inputs(self) -> list[str]: ...
    @property
    def late_inputs(self) -> list[str]: ...
    @property
    def parameters(self) -> _Parameters: ...
    @property
    def units(self) -> dict[str, str]: ...
    @property
    def constraints(self) -> list[str]: ...
    @property
    def state_names(self) -> list[str]: ...
    @property
    def acceleration_names(self) -> list[str]: ...
    def evaluate(self, states: npt.ArrayLike | _Table, parameters: Mapping[str, float] = {}) -> Mechanics: ...
    def true_acceleration(self, states: npt.ArrayLike | _Table) -> _Array: ...
    def generate(
        self, n: int | None = None, seed: int = 1, noise_std: float | None = None, grid: Mapping[str, int] = {}
    ) -> Table: ...
    def states(self, data: _Table, columns: Mapping[str, str] | None = None) -> _Array: ...
    def __eq__(self, other: object) -> bool: ...
    def __hash__(self) -> int: ...

class Hyperparameter:
    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def value(self) -> float: ...
    @property
    def lower(self) -> float: ...
    @property
    def upper(self) -> float: ...
    @property
    def at_bound(self) -> bool: ...

class RestartReport:
    @property
    def objective(self) -> float: ...
    @property
    def negative_log_likelihood(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def evaluations(self) -> int: ...
    @property
    def failed_evaluations(self) -> int: ...
    @property
    def converged(self) -> bool: ...
    @property
    def termination(self) -> str: ...

class FitReport:
    @property
    def hyperparameters(self) -> list[Hyperparameter]: ...
    @property
    def negative_log_likelihood(self) -> float: ...
    @property
    def objective(self) -> float: ...
    @property
    def converged(self) -> bool: ...
    @property
    def termination(self) -> str: ...
    @property
    def iterations(self) -> int: ...
    @property
    def best_restart(self) -> int: ...
    @property
    def restarts(self) -> list[RestartReport]: ...
    @property
    def distrusted(self) -> list[dict[str, Any]]: ...
    @property
    def actuators(self) -> list[dict[str, Any]]: ...
    @property
    def inducing(self) -> dict[str, Any] | None: ...
    @property
    def seconds(self) -> float: ...
    @property
    def standard_errors(self) -> dict[str, float]: ...
    @property
    def draws(self) -> dict[str, dict[str, Any]] | None: ...
    def correlation(self, a: str, b: str) -> float: ...
    def __getitem__(self, arg0: str) -> float: ...
    def keys(self) -> list[str]: ...
    def __contains__(self, arg0: object) -> bool: ...
    def __iter__(self) -> Iterator[str]: ...

class Prediction:
    @property
    def mean(self) -> _Array: ...
    @property
    def std(self) -> _Array: ...
    @property
    def cov(self) -> _Array: ...
    @property
    def distance_from_data(self) -> _Array: ...
    @property
    def names(self) -> list[str]: ...
    @property
    def n_clipped(self) -> int: ...
    def to_frame(self) -> Any: ...

class Inputs:
    @property
    def inputs(self) -> _Array: ...
    @property
    def std(self) -> _Array: ...
    @property
    def cov(self) -> _Array: ...
    @property
    def missed(self) -> _Array: ...
    @property
    def names(self) -> list[str]: ...
    def to_frame(self) -> Any: ...

class Calibration:
    @property
    def coverage50(self) -> float: ...
    @property
    def coverage80(self) -> float: ...
    @property
    def coverage95(self) -> float: ...
    @property
    def coverage50_latent(self) -> float: ...
    @property
    def coverage80_latent(self) -> float: ...
    @property
    def coverage95_latent(self) -> float: ...
    @property
    def pit(self) -> _Array: ...

class EvaluationPart(Calibration):
    @property
    def n(self) -> int: ...
    @property
    def nrmse(self) -> float: ...

class LeftOutScores:
    @property
    def view(self) -> str: ...
    @property
    def one_by_one(self) -> EvaluationPart: ...
    @property
    def stretches(self) -> EvaluationPart | None: ...

class CrossValidation(LeftOutScores):
    @property
    def other_views(self) -> list[LeftOutScores]: ...

class Evaluation(Calibration):
    @property
    def outputs(self) -> list[str]: ...
    @property
    def rmse(self) -> _Array: ...
    @property
    def rmse_normalised(self) -> float: ...
    @property
    def nrmse(self) -> float: ...
    @property
    def max_constraint_error(self) -> float: ...
    @property
    def max_constraint_error_fitted(self) -> float: ...
    @property
    def nlpd(self) -> float: ...
    @property
    def nlpd_latent(self) -> float: ...
    @property
    def n_zero_variance(self) -> int: ...
    @property
    def near(self) -> EvaluationPart: ...
    @property
    def far(self) -> EvaluationPart: ...
    @property
    def n(self) -> int: ...
    @property
    def n_missing(self) -> int: ...

class _ContactEvent(TypedDict):
    t: float
    contact: str
    kind: Literal["impact", "made", "released"]
    approach: float
    energy_loss: float

class _StickEvent(TypedDict):
    t: float
    surface: str
    kind: Literal["sticks", "slips"]

class Motion:
    @property
    def t(self) -> _Array: ...
    @property
    def states(self) -> _Array: ...
    @property
    def q(self) -> _Array: ...
    @property
    def dq(self) -> _Array: ...
    @property
    def ddq(self) -> _Array: ...
    @property
    def std(self) -> _Array | None: ...
    @property
    def distance_from_data(self) -> _Array | None: ...
    @property
    def energy(self) -> _Array | None: ...
    @property
    def energy_std(self) -> _Array | None: ...
    @property
    def multipliers(self) -> _Array: ...
    @property
    def max_position_drift(self) -> float: ...
    @property
    def max_velocity_drift(self) -> float: ...
    @property
    def n_lower_rank(self) -> int: ...
    @property
    def start_displacement(self) -> float: ...
    @property
    def contact_events(self) -> list[_ContactEvent]: ...
    @property
    def stick_events(self) -> list[_StickEvent]: ...
    @property
    def table(self) -> Table: ...
    def to_frame(self) -> Any: ...
    def plot(self, *, ax: Any = None) -> Any: ...
    @property
    def steps(self) -> int: ...
    @property
    def rejected_steps(self) -> int: ...
    @property
    def evaluations(self) -> int: ...

class _Known(TypedDict):
    now: float
    after: float
    random: float

class _LimitUse(TypedDict):
    lower: float
    upper: float
    lowest: float
    highest: float
    share: float

class Excitation:
    @property
    def motion(self) -> Motion: ...
    @property
    def table(self) -> Table: ...
    @property
    def parameters(self) -> dict[str, _Known]: ...
    @property
    def accelerations(self) -> dict[str, _Known]: ...
    @property
    def limits(self) -> dict[str, _LimitUse]: ...
    @property
    def factor(self) -> float: ...
    @property
    def random_factor(self) -> float: ...
    @property
    def highest_frequency(self) -> float: ...
    @property
    def leaves_data(self) -> float | None: ...
    @property
    def n_motions(self) -> int: ...
    @property
    def n_random(self) -> int: ...
    @property
    def n_failed(self) -> int: ...
    @property
    def seconds(self) -> float: ...

class Posterior:
    @staticmethod
    def load(path: _Path, system: System | None = None) -> Posterior: ...
    def save(self, path: _Path) -> None: ...
    @property
    def system(self) -> System: ...
    @property
    def report(self) -> FitReport: ...
    @property
    def options(self) -> dict[str, Any] | None: ...
    @property
    def notes(self) -> list[str]: ...
    @property
    def _has_code(self) -> bool: ...
    @property
    def n_data(self) -> int: ...
    @property
    def negative_log_likelihood(self) -> float: ...
    @property
    def parameters(self) -> _Parameters: ...
    def predict(
        self,
        states: npt.ArrayLike | _Table,
        view: _View = "constrained",
        *,
        system: System | None = None,
        latent: str | None = None,
        dt: float | None = None,
        mean_only: bool = False,
        columns: Mapping[str, str] | None = None,
        threads: int = 0,
    ) -> Prediction: ...
    def joint(
        self,
        states: npt.ArrayLike | _Table,
        view: _View = "constrained",
        *,
        system: System | None = None,
        latent: str | None = None,
        dt: float | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> tuple[_Array, _Array]: ...
    def sample(
        self,
        states: npt.ArrayLike | _Table,
        n_samples: int = 1,
        seed: int = 0,
        view: _View = "constrained",
        *,
        system: System | None = None,
        latent: str | None = None,
        dt: float | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> _Array: ...
    def potential(
        self,
        states: npt.ArrayLike | _Table,
        latent: str,
        *,
        columns: Mapping[str, str] | None = None,
    ) -> tuple[_Array, _Array]: ...
    def inverse_dynamics(
        self,
        states: npt.ArrayLike | _Table,
        accelerations: npt.ArrayLike | _Table | None = None,
        *,
        outputs: Sequence[str] | None = None,
        system: System | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> Inputs: ...
    def evaluate(
        self,
        data: _Table,
        system: System | None = None,
        outputs: Sequence[str] | None = None,
        columns: Mapping[str, str] | None = None,
        threads: int = 0,
    ) -> Evaluation: ...
    def plot_learned(
        self, what: str | None = None, *, along: str | None = None, force: str | None = None, ax: Any = None
    ) -> Any: ...
    def plot_predictions(
        self, data: _Table, system: System | None = None, columns: Mapping[str, str] | None = None, *, ax: Any = None
    ) -> Any: ...
    def plot_calibration(
        self, data: _Table, system: System | None = None, columns: Mapping[str, str] | None = None, *, ax: Any = None
    ) -> Any: ...
    def shoot(
        self,
        data: _Table,
        duration: float | None = None,
        stretches: int = 50,
        columns: Mapping[str, str] | None = None,
        threads: int = 0,
    ) -> tuple[Posterior, dict[str, Any]]: ...
    def cross_validate(self) -> CrossValidation: ...
    def fewest_components(
        self,
        largest_error: float,
        view: _View = "constrained",
        *,
        system: System | None = None,
        latent: str | None = None,
        dt: float | None = None,
    ) -> Posterior: ...
    def update(
        self,
        data: _Table,
        observe: Sequence[str] | None = None,
        noise_std: float | None = None,
        columns: Mapping[str, str] | None = None,
        forget: float | None = None,
        window: int | None = None,
    ) -> None: ...
    def remove_oldest(self, n: int = 1) -> None: ...
    def without_data(self) -> Posterior: ...
    def export(
        self,
        folder: _Path,
        system: System | None = None,
        *,
        # options of export: written by scripts/options
        to: Literal["c", "casadi", "acados", "mjcf", "urdf"] = "c",
        name: str = "",
        robot: str | os.PathLike[str] = "",
        view: Literal["constrained", "unconstrained", "constraint-force", "multipliers", "next-velocity", "force"] = "constrained",
        dt: float | None = None,
        latent: str | None = None,
        std: bool = True,
        jacobian: bool = True,
        single: bool = False,
        portable_math: bool = False,
        draws_within: float | None = None,
        # end of options
    ) -> list[str]: ...
    @overload
    def simulate(
        self,
        start: Mapping[str, float] | npt.ArrayLike | _Table,
        times: npt.ArrayLike,
        inputs: _Table | None = None,
        system: System | None = None,
        *,
        rtol: float = 1e-06,
        atol: float = 1e-09,
        max_steps: int = 1000000,
        project: bool = True,
        n_samples: None = None,
        seed: int = 0,
        columns: Mapping[str, str] | None = None,
    ) -> Motion: ...
    @overload
    def simulate(
        self,
        start: Mapping[str, float] | npt.ArrayLike | _Table,
        times: npt.ArrayLike,
        inputs: _Table | None = None,
        system: System | None = None,
        *,
        rtol: float = 1e-06,
        atol: float = 1e-09,
        max_steps: int = 1000000,
        project: bool = True,
        n_samples: int,
        seed: int = 0,
        columns: Mapping[str, str] | None = None,
    ) -> list[Motion]: ...

class Predictor:
    def __init__(
        self,
        posterior: Posterior,
        view: _View = "constrained",
        *,
        system: System | None = None,
        latent: str | None = None,
        dt: float | None = None,
        std: bool = True,
        jacobian: bool = True,
        storage: Literal["double", "single"] = "double",
    ) -> None: ...
    def mean(self, state: npt.ArrayLike | Mapping[str, float]) -> _Array: ...
    def mean_and_std(self, state: npt.ArrayLike | Mapping[str, float]) -> tuple[_Array, _Array]: ...
    def mean_and_cov(self, state: npt.ArrayLike | Mapping[str, float]) -> tuple[_Array, _Array]: ...
    def mean_and_jacobian(self, state: npt.ArrayLike | Mapping[str, float]) -> tuple[_Array, _Array]: ...
    def distance_from_data(self, state: npt.ArrayLike | Mapping[str, float]) -> float: ...

class InverseDynamicsSolver:
    def __init__(
        self,
        posterior: Posterior,
        *,
        outputs: Sequence[str] | None = None,
        system: System | None = None,
        cov: bool = True,
        storage: Literal["double", "single"] = "double",
    ) -> None: ...
    def inputs(self, state: npt.ArrayLike | Mapping[str, float], accelerations: npt.ArrayLike | Mapping[str, float]) -> _Array: ...
    def inputs_and_cov(self, state: npt.ArrayLike | Mapping[str, float], accelerations: npt.ArrayLike | Mapping[str, float]) -> tuple[_Array, _Array]: ...

class Log:
    def __init__(self, data: _Table | _Arrays, system: System | None = None) -> None: ...

class SideInformation:
    def __init__(self, view: _View, data: _Table, latent: str = "", system: System | None = None) -> None: ...

class Progress:
    @property
    def restart(self) -> int: ...
    @property
    def n_restarts(self) -> int: ...
    @property
    def iteration(self) -> int: ...
    @property
    def best(self) -> float: ...
    @property
    def seconds(self) -> float: ...
    @property
    def fraction(self) -> float: ...
    @property
    def is_drawing(self) -> bool: ...
    @property
    def n_states(self) -> int: ...

class _BlasReport(TypedDict):
    library: str
    kernel: str
    threads: int
    fastest_kernel: str
    advice: str

def blas_report() -> _BlasReport: ...
def check(system: System, data: _Table | None = None, columns: Mapping[str, str] | None = None) -> list[Finding]: ...
def fit(
    system: System,
    data: _Table | Log | _Arrays | list[Any],  # of these
    *,
    commands: _Table | None = None,
    also: SideInformation | Sequence[SideInformation] = [],
    # options of fit: written by scripts/options
    also_noise_std: float | None = None,
    dt: float | None = None,
    columns: Mapping[str, str] | None = None,
    observe: Sequence[str] | None = None,
    noise_std: float | Literal["estimate", "stated"] | None = None,
    max_points: int | None = None,
    thin: bool | Literal["auto", "none"] = True,
    project: bool = False,
    robust: bool = False,
    mean: Literal["zero", "force"] = "zero",
    prior: Literal["acceleration", "force"] | None = None,
    baseline: Literal["se", "icm", "lmc"] | None = None,
    estimate: Sequence[str] | None = None,
    protocol: Literal["default", "paper"] = "default",
    hyperprior: bool | Literal["default", "none"] = True,
    discrepancy: bool | Literal["default", "none"] = True,
    restarts: int | None = None,
    max_iterations: int = 1000,
    max_escapes: int | None = None,
    gradient_tolerance: float | None = None,
    reduction_tolerance: float | None = None,
    start: _Path | Mapping[str, float] | None = None,
    seed: int = 0,
    hyperparameters: Literal["optimise", "integrate", "auto"] = "auto",
    standard_errors: bool = True,
    inducing: float | Literal["auto", "none"] | None = None,
    train_on: int | None = None,
    threads: int = 0,
    checkpoint: str | os.PathLike[str] = "",
    # end of options
    progress: Callable[[Progress], object] | None = None,
) -> Posterior: ...
def fit_raw(
    system: System,
    data: _Table,
    *,
    # options of fit_raw: written by scripts/options
    also_noise_std: float | None = None,
    dt: float | None = None,
    columns: Mapping[str, str] | None = None,
    observe: Sequence[str] | None = None,
    noise_std: float | Literal["estimate", "stated"] | None = None,
    max_points: int | None = None,
    thin: bool | Literal["auto", "none"] = True,
    project: bool = False,
    robust: bool = False,
    mean: Literal["zero", "force"] = "zero",
    prior: Literal["acceleration", "force"] | None = None,
    baseline: Literal["se", "icm", "lmc"] | None = None,
    estimate: Sequence[str] | None = None,
    protocol: Literal["default", "paper"] = "default",
    hyperprior: bool | Literal["default", "none"] = True,
    discrepancy: bool | Literal["default", "none"] = True,
    restarts: int | None = None,
    max_iterations: int = 1000,
    max_escapes: int | None = None,
    gradient_tolerance: float | None = None,
    reduction_tolerance: float | None = None,
    start: _Path | Mapping[str, float] | None = None,
    seed: int = 0,
    hyperparameters: Literal["optimise", "integrate", "auto"] = "auto",
    standard_errors: bool = True,
    inducing: float | Literal["auto", "none"] | None = None,
    train_on: int | None = None,
    threads: int = 0,
    checkpoint: str | os.PathLike[str] = "",
    passes: int = 4,
    windows: bool | Literal["auto", "none"] = True,
    episode: str = "",
    episodes: Sequence[str] | None = None,
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto",
    outlier_threshold: float = 5.0,
    smoothness: Literal["auto", "5/2", "7/2", "9/2"] = "auto",
    # end of options
    progress: Callable[[Progress], object] | None = None,
) -> tuple[Posterior, Table, dict[str, Any]]: ...
def fit_again(
    path: _Path,
    data: _Table | Log | _Arrays | list[Any] | None = None,
    *,
    commands: _Table | None = None,
    also: SideInformation | Sequence[SideInformation] = [],
    system: System | None = None,
    threads: int = 0,
    checkpoint: _Path | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Posterior: ...
def load(path: _Path, system: System | None = None) -> Posterior: ...
def read_csv(path: _Path) -> Table: ...
def derive(
    system: System,
    data: _Table,
    like: _Table | None = None,
    *,
    # options of derive: written by scripts/options
    episode: str = "",
    episodes: Sequence[str] | None = None,
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto",
    rate: float = 0.0,
    every: int = 1,
    hold_constraints: bool = False,
    outlier_threshold: float = 5.0,
    smoothness: Literal["auto", "5/2", "7/2", "9/2"] = "auto",
    keep: Sequence[str] = [],
    columns: Mapping[str, str] | None = None,
    # end of options
) -> tuple[Table, dict[str, Any]]: ...
def resample(
    system: System,
    data: _Table,
    n: int,
    *,
    # options of resample: written by scripts/options
    features: Sequence[str] | None = None,
    seed: int | None = None,
    columns: Mapping[str, str] | None = None,
    # end of options
) -> Table: ...
def show(
    system: System | Posterior | _Path,
    *,
    # options of show: written by scripts/options
    latex: bool = False,
    full: bool = False,
    json: bool = False,
    # end of options
) -> str: ...
def report(
    fit: Posterior | _Path | Sequence[Posterior | _Path] | Mapping[str, Posterior | _Path],
    path: _Path | None = None,
    *,
    data: _Table | None = None,
    system: System | _Path | None = None,
    truth: System | _Path | None = None,
    columns: Mapping[str, str] | None = None,
) -> str: ...
def plot(
    fit: Posterior | _Path,
    path: _Path | None = None,
    *,
    # options of plot: written by scripts/options
    what: str | None = None,
    along: str | None = None,
    force: str | None = None,
    # end of options
) -> str: ...
def simulate(
    system: System,
    start: Mapping[str, float] | npt.ArrayLike | _Table,
    times: npt.ArrayLike,
    inputs: _Table | None = None,
    *,
    # options of simulate: written by scripts/options
    rtol: float = 1e-06,
    atol: float = 1e-09,
    max_steps: int = 1000000,
    project: bool | Literal["on", "off"] = True,
    n_samples: int | None = None,
    seed: int = 0,
    columns: Mapping[str, str] | None = None,
    # end of options
) -> Motion: ...
def excite(
    posterior: Posterior,
    start: Mapping[str, float] | npt.ArrayLike | _Table,
    duration: float,
    inputs_within: Mapping[str, tuple[float, float]],
    within: Mapping[str, tuple[float, float]] | None = None,
    system: System | None = None,
    *,
    # options of excite: written by scripts/options
    target: Literal["auto", "parameters", "accelerations"] = "auto",
    n_rows: int = 200,
    n_harmonics: int = 8,
    n_motions: int = 1000,
    seed: int = 0,
    columns: Mapping[str, str] | None = None,
    threads: int = 0,
    # end of options
) -> Excitation: ...
