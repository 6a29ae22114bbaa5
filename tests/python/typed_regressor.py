"""A user's code with gp2.sklearn, whose base classes have no types, checked by mypy --strict in test_stub.py. Not run."""

import numpy as np
import numpy.typing as npt

from gp2.sklearn import GP2Regressor


def main(X: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> float:
    model = GP2Regressor("surface.toml", mean="force", noise_std="estimate").fit(X, y)
    mean = model.predict(X)
    _, stddev = model.predict(X, return_std=True)
    mean, covariance = model.predict(X, return_cov=True)
    GP2Regressor(mean="gravity")  # type: ignore[arg-type]
    return float(mean.sum() + stddev.sum() + covariance.sum()) + model.score(X, y) + model.posterior_.report["m"]
