"""Inputs that act later than they are commanded."""

import re

import numpy as np
import pytest

import gp2

LATE = {"name": "u", "delay": {"estimate": True}, "lag": 0.05}


def cart(*inputs, mass=1.5):
    return gp2.System(
        name="cart", coordinates=["x"], inputs=inputs, parameters={"m": mass}, mass=[["m"]], force=["u"],
        latents=[{"features": ["dx"], "directions": "force"}], noise=0.05, truth={"force": ["-2*dx - tanh(5*dx)"]})


def log_of(delay, lag, seconds=4.0, rate=100):
    t = np.arange(round(seconds * rate) + 1) / rate
    u = sum(1.5 * np.sin(2 * np.pi * f * t + f) for f in (0.3, 0.9, 1.7, 2.3, 3.1))
    motion = gp2.simulate(cart({"name": "u", "delay": delay, "lag": lag}), {"x": 0, "dx": 0}, t, inputs={"t": t, "u": u})
    noise = 0.05 * np.random.default_rng(3).standard_normal(len(t))
    return {"t": t, "x": motion.states[:, 0], "dx": motion.states[:, 1], "ddx": motion.ddq[:, 0] + noise, "u": u}


def taken(log, rows):
    return {name: values[rows] for name, values in log.items()}


def test_a_delay_is_estimated_and_reported():
    posterior = gp2.fit(cart(LATE), log_of(0.03, 0.05), mean="force", max_points=100, restarts=2, hyperparameters="optimise")
    (estimate,) = posterior.report.actuators
    assert estimate["name"] == "u.delay"
    assert abs(estimate["value"] - 0.03) < 3 * estimate["std"] < 0.01
    assert not estimate["at_bound"] and estimate["moves"] == {}
    text = str(posterior.report)
    assert re.search(rf"^  u\.delay +{estimate['value']:.6g} ± {estimate['std']:.2g} +\[", text, re.MULTILINE)
    assert text == text.strip() and text in gp2.show(posterior)


def test_how_far_the_error_of_a_delay_shifts_a_parameter_is_told(tmp_path):
    system = cart(LATE, mass={"value": 1.4, "bounds": [1, 2], "estimate": True})
    posterior = gp2.fit(system, log_of(0.03, 0.05), mean="force", max_points=100, restarts=1, hyperparameters="optimise")
    (estimate,) = posterior.report.actuators
    assert list(estimate["moves"]) == ["m"]
    assert 0 < abs(estimate["moves"]["m"]) < posterior.report.standard_errors["m"]
    posterior.save(tmp_path / "fit.json")
    assert gp2.load(tmp_path / "fit.json").report.actuators == [estimate]


def test_rows_are_told_by_the_whole_log_what_acts():
    system, log = cart({"name": "u", "delay": 0.03, "lag": 0.05}), log_of(0.03, 0.05)
    rows = np.arange(60, 400, 7)
    options = dict(mean="force", max_iterations=0, thin=False)
    of_rows = gp2.fit(system, taken(log, rows), commands=log, **options)
    acting = system.states(log)[rows]
    of_arrays = gp2.fit(system, (acting, log["ddx"][rows, None]), **options)
    assert of_rows.negative_log_likelihood == of_arrays.negative_log_likelihood
    with pytest.raises(gp2.InputError, match="commands: no input of the model acts late: leave it out"):
        gp2.fit(cart("u"), taken(log, rows), commands=log, **options)


def test_arrays_are_what_acts_and_tables_what_is_commanded():
    system, log = cart({"name": "u", "delay": 0.03, "lag": 0.05}), log_of(0.03, 0.05)
    posterior = gp2.fit(system, log, mean="force", max_points=60, restarts=1, hyperparameters="optimise")
    np.testing.assert_array_equal(posterior.predict(log).mean, posterior.predict(system.states(log)).mean)


def test_a_motion_is_a_log_of_commands():
    system, t = cart({"name": "u", "delay": 0.03, "lag": 0.05}), np.linspace(0, 1, 101)
    commands = {"t": t, "u": 1.5 * np.sin(9 * t)}
    motion = gp2.simulate(system, {"x": 0, "dx": 0}, t, inputs=commands)
    np.testing.assert_allclose(motion.table["u"], commands["u"], rtol=0, atol=1e-15)
    assert np.abs(motion.states[:, system.state_names.index("u")] - commands["u"]).max() > 0.1  # what acts
    np.testing.assert_allclose(system.states(motion.table), motion.states, rtol=0, atol=1e-12)


def test_a_fit_again_tells_of_the_delay_that_it_was_given(tmp_path):
    posterior = gp2.fit(cart(LATE), log_of(0.03, 0.05), mean="force", max_points=60, restarts=1, hyperparameters="optimise")
    posterior.save(tmp_path / "fit.json")
    again = gp2.fit_again(tmp_path / "fit.json")
    assert again.report.actuators == posterior.report.actuators
    again.save(tmp_path / "again.json")
    # but for the seconds that it took
    first, second = (open(tmp_path / name).read() for name in ("fit.json", "again.json"))
    assert len(first) == pytest.approx(len(second), abs=40)


def test_a_fit_to_rows_is_repeated_with_their_commands(tmp_path):
    log = log_of(0.03, 0.05)
    rows = taken(log, np.arange(60, 400, 7))
    fit = gp2.fit(cart({"name": "u", "delay": 0.03, "lag": 0.05}), rows, commands=log, mean="force", max_iterations=0, thin=False)
    fit.save(tmp_path / "fit.json")
    again = gp2.fit_again(tmp_path / "fit.json", rows, commands=log)
    assert again.negative_log_likelihood == fit.negative_log_likelihood
    with pytest.raises(gp2.InputError, match="^again: commands goes with data$"):
        gp2.fit_again(tmp_path / "fit.json", commands=log)


def test_a_log_without_times_is_refused():
    log = log_of(0.03, 0.05, seconds=1)
    del log["t"]
    with pytest.raises(gp2.InputError, match="u acts late, which takes the times of the whole log, but it has no column t"):
        gp2.fit(cart(LATE), log, mean="force")
