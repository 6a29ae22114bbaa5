"""What the command and Python did differently once, and do by one function now."""

import json

import numpy as np
import pytest

import gp2
from conftest import MODELS, columns_of, write_csv


def findings(listed):
    return [(finding.level, finding.text) for finding in listed]


def test_check_finds_the_acceleration_that_a_singular_mass_does_not_have(tmp_path, command):
    rod = gp2.System.load(MODELS / "massless_rod.toml")
    rigid = tmp_path / "rigid.toml"
    rigid.write_text(rod.text.replace('directions = "force"', 'directions = "acceleration"'), encoding="utf-8")
    found = gp2.check(gp2.System.load(rigid), rod.generate(12))
    assert any(f.level == "error" and f.text.startswith("the mass matrix M is singular, so that there is no M⁻¹") for f in found)


def test_check_has_the_findings_of_the_command(tmp_path, command, arm, arm_log):
    log = columns_of(arm_log)
    log["spare"] = log.pop("ddelbow")
    path = write_csv(tmp_path / "log.csv", log)
    model = MODELS / "arm_on_moving_plane.toml"
    outcome = command("check", model, "--data", path)
    lines = [line for line in outcome.stdout.splitlines()]
    marks = {"ok": "ok", "warning": "warning", "ERROR": "error"}
    said = [(marks[line.split()[0]], line[9:].replace("--", "")) for line in lines]
    assert findings(gp2.check(arm, path))[1:] == said[1:]  # the first names the model's file
    assert "not in the log: ddelbow; fit with observe for the others" in [text for _, text in findings(gp2.check(arm, path))]


@pytest.mark.parametrize("options", [{}, {"full": True}, {"latex": True}])
def test_show_is_what_the_command_prints(command, options):
    model = MODELS / "unicycle.toml"
    flags = [f"--{name}" for name in options]
    assert gp2.show(gp2.System.load(model), **options) == gp2.show(model, **options) == command("show", model, *flags).stdout


def test_check_without_data_or_sampling_says_so():
    system = gp2.System(coordinates=["x"], mass=[["1"]], noise=1)
    assert findings(gp2.check(system))[1:] == [
        ("warning", "no data, and the model has no [truth] with [sampling] or [motion]: there are no states to check")
    ]


@pytest.fixture
def pushed():
    """One coordinate and an input, which logs call by another name."""
    return gp2.System(
        coordinates=["x"], inputs=["push"], mass=[["1"]], force=["push"], truth=["0"], sampling={"x": [-1, 1]}, noise=1,
        columns={"push": "u_measured"},
    )  # fmt: skip


def test_inputs_of_a_motion_are_found_by_the_columns_of_the_model_and_those_given(pushed):
    t = np.linspace(0, 1, 3)
    motion = gp2.simulate(pushed, {"x": 0}, t, {"t": [0, 1], "u_measured": [1, 1]})
    assert motion.q[-1, 0] == pytest.approx(0.5)
    again = gp2.simulate(pushed, {"x": 0}, t, {"t": [0, 1], "other": [1, 1]}, columns={"push": "other"})
    assert np.array_equal(again.q, motion.q)
    with pytest.raises(gp2.InputError, match=r"columns=\{'push': 'nosuch'\}"):
        gp2.simulate(pushed, {"x": 0}, t, {"t": [0, 1], "u_measured": [1, 1]}, columns={"push": "nosuch"})


def test_inputs_must_cover_the_motion(pushed):
    with pytest.raises(gp2.InputError, match="times 0 to 0.5 do not cover the motion from 0 to 1"):
        gp2.simulate(pushed, {"x": 0}, [0, 1], {"t": [0, 0.5], "u_measured": [1, 1]})


def test_a_view_is_chosen_by_one_function(posterior, arm_fit_file, command, arm_states, tmp_path, arm):
    states = write_csv(tmp_path / "states.csv", {name: column for name, column in zip(arm.state_names, arm_states.T)})
    for view, dt in (("constrained", None), ("multipliers", None), ("next-velocity", 0.1)):
        step = [] if dt is None else ["--dt", dt]
        outcome = command("predict", arm_fit_file, "--states", states, "--view", view, *step, "-o", "out.csv")
        assert outcome.returncode == 0, outcome.stderr
        table, prediction = gp2.read_csv(tmp_path / "out.csv"), posterior.predict(arm_states, view, dt=dt)
        assert np.array_equal(np.column_stack([table[name] for name in prediction.names]), prediction.mean)


def test_show_of_a_fit_is_what_the_command_prints(command, arm, arm_log, tmp_path):
    posterior = gp2.fit(arm, arm_log, mean="force", restarts=1, max_iterations=2, max_escapes=0, standard_errors=False)
    posterior.save(tmp_path / "fit.json")
    shown = command("show", tmp_path / "fit.json").stdout
    assert shown.startswith("learned from ") and "negative log likelihood" in shown and "mass matrix M" in shown
    assert gp2.show(gp2.load(tmp_path / "fit.json")) == gp2.show(tmp_path / "fit.json") == shown
    assert gp2.show(posterior).splitlines()[0] == shown.splitlines()[0]
    told = json.loads(command("show", tmp_path / "fit.json", "--json").stdout)
    assert told["fit"]["states"] == posterior.n_data and told["coordinates"] == arm.coordinates
    assert told["fit"]["hyperparameters"] == {h.name: h.value for h in posterior.report.hyperparameters}
    model = json.loads(gp2.show(arm, json=True))
    assert model == {key: value for key, value in told.items() if key != "fit"}
    with pytest.raises(gp2.InputError, match="leave out one"):
        gp2.show(arm, json=True, latex=True)
