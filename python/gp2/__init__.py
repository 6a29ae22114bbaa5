"""Learn the dynamics of constrained mechanical systems from data.

    system = gp2.System.load("surface.toml")
    posterior = gp2.fit(system, "log.csv", mean="force")
    prediction = posterior.predict("test.csv")  # .mean, .std, .cov

Every prediction obeys the constraint A(q, dq, t) ddq = b(q, dq, t) to rounding (Geist & Trimpe 2020). Arrays of states are
(n, len(system.state_names)), with the columns q, dq, t, u.
"""

from gp2 import _objects as _objects
from gp2._gp2 import (
    FAR_FROM_DATA,
    Calibration,
    CrossValidation,
    Evaluation,
    EvaluationPart,
    Finding,
    FitReport,
    Hyperparameter,
    InputError,
    SideInformation,
    Log,
    Mechanics,
    Motion,
    NumericalError,
    Posterior,
    Prediction,
    Predictor,
    Progress,
    RestartReport,
    System,
    Table,
    __version__,
    blas_report,
    check,
    derive,
    learn_and_smooth,
    fit,
    fit_again,
    load,
    read_csv,
    resample,
    show,
    simulate,
)

__all__ = [
    "FAR_FROM_DATA",
    "Calibration",
    "CrossValidation",
    "Evaluation",
    "EvaluationPart",
    "Finding",
    "FitReport",
    "Hyperparameter",
    "InputError",
    "SideInformation",
    "Log",
    "Mechanics",
    "Motion",
    "NumericalError",
    "Posterior",
    "Prediction",
    "Predictor",
    "Progress",
    "RestartReport",
    "System",
    "Table",
    "__version__",
    "blas_report",
    "check",
    "derive",
    "learn_and_smooth",
    "fit",
    "fit_again",
    "load",
    "read_csv",
    "resample",
    "show",
    "simulate",
]
