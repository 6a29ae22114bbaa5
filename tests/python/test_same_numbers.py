"""Python, the command and C++ give the same numbers."""

import json

import numpy as np
import pytest

import gp2
from conftest import MODELS, program, run, write_csv

VIEWS = ["constrained", "unconstrained", "constraint-force", "multipliers", "next-velocity", "force"]
LATENTS = [None, "friction of the tip", "friction of the joints", "discrepancy"]
TOLERANCE = 1e-12  # of the largest number of a kind

# states of the arm lie off the other plane
pytestmark = pytest.mark.filterwarnings("ignore:.*states are off the constraint")


def assert_same(actual, expected):
    assert actual.shape == expected.shape
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(actual, expected, rtol=0, atol=TOLERANCE * np.abs(expected).max())


@pytest.fixture
def other_file(tmp_path):
    """The arm on a plane that is tilted and moves twice as fast."""
    text = (MODELS / "arm_on_moving_plane.toml").read_text(encoding="utf-8")
    changed = text.replace("- h - a*sin(w*t)", "- h - 0.2*(l1*cos(shoulder) + l2*cos(shoulder + elbow)) - a*sin(2*w*t)")
    assert changed != text
    path = tmp_path / "other.toml"
    path.write_text(changed, encoding="utf-8")
    return path


@pytest.fixture
def states_file(arm, tmp_path):
    return write_csv(tmp_path / "states.csv", arm.generate(7, seed=11))


def options(view, latent=None, system=None):
    keywords = {"view": view, "latent": latent, "system": system}
    if view == "next-velocity":
        keywords["dt"] = 0.01
    return keywords


def columns(table, names):
    return np.column_stack([table[name] for name in names])


@pytest.mark.parametrize("under_other", [False, True])
@pytest.mark.parametrize("latent", LATENTS)
@pytest.mark.parametrize("view", VIEWS)
def test_every_view_is_that_of_the_command(
    view, latent, under_other, posterior, arm_fit_file, states_file, other_file, command, tmp_path
):
    arguments = ["predict", arm_fit_file, "--states", states_file, "--view", view, "--cov", "full", "-o", "out.csv"]
    if latent:
        arguments += ["--latent", latent]
    if under_other:
        arguments += ["--system", other_file]
    if view == "next-velocity":
        arguments += ["--dt", "0.01"]
    outcome = command(*arguments)
    assert outcome.returncode == 0, outcome.stderr
    expected = gp2.read_csv(tmp_path / "out.csv")

    system = gp2.System.load(other_file) if under_other else None
    prediction = posterior.predict(states_file, **options(view, latent, system))
    names = prediction.names
    assert set(names) <= set(expected.columns)
    assert_same(prediction.mean, columns(expected, names))
    assert_same(prediction.std, columns(expected, [name + "_std" for name in names]))
    for j, row in enumerate(names):
        for k, column in enumerate(names[j:], j):
            covariance = expected[f"cov_{row}_{column}"]
            scale = TOLERANCE * np.abs(prediction.cov).max()
            np.testing.assert_allclose(prediction.cov[:, j, k], covariance, rtol=0, atol=scale)
            np.testing.assert_allclose(prediction.cov[:, k, j], covariance, rtol=0, atol=scale)


def test_every_view_is_that_of_cpp(posterior, arm_fit_file, states_file, other_file):
    outcome = run(program("GP2_PRINT_VIEWS"), arm_fit_file, states_file, other_file)
    assert outcome.returncode == 0, outcome.stderr
    other = gp2.System.load(other_file)
    seen = 0
    for line in outcome.stdout.splitlines():
        name, *numbers = line.split(" ")
        view, _, part = name.partition("@")
        latent = LATENTS[1:][int(part)] if part.isdigit() else None
        prediction = posterior.predict(states_file, **options(view, latent, other if part == "other" else None))
        mean, covariance = np.split(np.array(numbers, float), [prediction.mean.size])
        assert_same(prediction.mean, mean.reshape(prediction.mean.shape))
        assert_same(prediction.cov, covariance.reshape(prediction.cov.shape).transpose(0, 2, 1))
        seen += 1
    assert seen == len(VIEWS) * (len(LATENTS) + 1)


def test_the_command_fits_generates_evaluates_and_simulates_the_same(arm, command, tmp_path):
    def succeeds(*arguments):
        outcome = command(*arguments)
        assert outcome.returncode == 0, outcome.stderr

    model = MODELS / "arm_on_moving_plane.toml"
    succeeds("generate", model, "--n", 25, "--seed", 4, "-o", "log.csv")
    log, drawn = gp2.read_csv(tmp_path / "log.csv"), arm.generate(25, seed=4)
    assert log.columns == drawn.columns
    for name in log.columns:
        np.testing.assert_array_equal(log[name], drawn[name])

    succeeds("fit", model, "--data", "log.csv", "--mean", "force", "--estimate", "m2", "--restarts", 2, "--max-iterations", 5,
             "--seed", 7, "-o", "fit.json")  # fmt: skip
    posterior = gp2.fit(arm, log, mean="force", estimate=["m2"], restarts=2, max_iterations=5, seed=7)
    fitted = gp2.load(tmp_path / "fit.json")
    for ours, theirs in zip(posterior.report.hyperparameters, fitted.report.hyperparameters):
        assert ours.name == theirs.name
        assert ours.value == theirs.value
    assert posterior.parameters == fitted.parameters
    states = arm.states(log)
    np.testing.assert_array_equal(posterior.predict(states).cov, fitted.predict(states).cov)

    figures = fitted.evaluate(log)
    outcome = command("evaluate", "fit.json", "--data", "log.csv", "--json")
    for name, value in json.loads(outcome.stdout).items():
        if name == "rmse":
            assert list(value) == figures.outputs
            value = list(value.values())
        if name in ("near", "far"):
            part = getattr(figures, name)
            value = {key: np.nan if number is None else number for key, number in value.items()}
            for key, number in value.items():
                np.testing.assert_allclose(getattr(part, key), np.array(number, dtype=float), rtol=1e-9, atol=1e-12)
            continue
        np.testing.assert_allclose(getattr(figures, name), value, rtol=1e-9, atol=1e-12)

    succeeds("simulate", "fit.json", "--start", "shoulder=0.9,dshoulder=0.1", "--t-end", "0.2", "--dt", "0.1", "-o", "motion.csv")
    motion = fitted.simulate({"shoulder": 0.9, "dshoulder": 0.1}, [0, 0.1, 0.2])
    expected = gp2.read_csv(tmp_path / "motion.csv")
    np.testing.assert_allclose(motion.q, columns(expected, arm.coordinates), rtol=1e-12)
