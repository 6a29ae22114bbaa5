"""Keywords, stub and pages come from the tables of options of the library."""

import collections
import re
import subprocess
import sys
import types

import numpy as np
import pandas as pd
import pytest

import gp2
from conftest import ROOT, program, write_csv


def test_pages_and_stub_are_those_of_the_tables():
    program("GP2_COMMAND")
    outcome = subprocess.run([sys.executable, ROOT / "scripts" / "options", "--check"], capture_output=True, text=True)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr


def test_an_unknown_keyword_is_refused_with_the_nearest(arm, arm_log):
    with pytest.raises(TypeError, match=r"fit\(\) got an unexpected keyword argument 'noise_sd'; did you mean 'noise_std'\?"):
        gp2.fit(arm, arm_log, noise_sd=0.1)
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'qqq'$"):
        gp2.fit(arm, arm_log, qqq=1)
    with pytest.raises(TypeError, match=r"System\(\) got an unexpected keyword argument 'unit'; did you mean 'units'\?"):
        gp2.System(coordinates=["x"], mass=[[1]], unit={"x": "m"})
    for misspelt, keyword in {"progres": "progress", "comands": "commands", "alos": "also"}.items():
        with pytest.raises(TypeError, match=f"unexpected keyword argument '{misspelt}'; did you mean '{keyword}'"):
            gp2.fit(arm, arm_log, **{misspelt: None})
    with pytest.raises(TypeError, match="'sistem'; did you mean 'system'"):
        gp2.fit(arm, arm_log, max_iterations=0).simulate({"shoulder": 0.9}, [0, 0.1], sistem=arm)


def test_arguments_that_are_something_else_are_named(arm, arm_log, posterior, arm_fit_file):
    with pytest.raises(TypeError, match=r"^posterior: expected a gp2.Posterior \(gp2.load reads one from a file\), got 'fit.json'$"):
        gp2.Predictor("fit.json")
    with pytest.raises(TypeError, match=r"^fit\(\) takes a system and data, then keywords; of arrays write fit\(system, \(X, y\)\)$"):
        gp2.fit(arm, arm_log, arm_log)
    for call, name in {
        lambda: gp2.load(3): "path",
        lambda: posterior.save(3): "path",
        lambda: posterior.export(3): "folder",
        lambda: gp2.fit_again(arm_fit_file, checkpoint=3): "checkpoint",
    }.items():
        with pytest.raises(TypeError, match=f"^{name}: expected a path, got 3$"):
            call()


def test_a_call_with_more_than_it_takes_says_how_it_is_written(arm, arm_log, posterior, arm_states):
    rest = "by position; write what follows with its name: "
    for call, said in {
        lambda: posterior.predict(arm_states, "force", arm): f"predict() takes states, view {rest}system=…, latent=…, dt=…, mean_only=…",
        lambda: gp2.Predictor(posterior, "force", arm): f"Predictor() takes posterior, view {rest}system=…, latent=…",
        lambda: gp2.derive(arm, arm_log, None, 3): f"derive() takes system, data, like {rest}help() lists them",
        lambda: gp2.check(arm, arm_log, None, 3): "check() takes no more than system, data, columns",
        lambda: gp2.blas_report(3): "blas_report() takes no arguments",
        lambda: posterior.cross_validate(3): "cross_validate() takes no arguments",
        lambda: gp2.System("wire.toml"): "System() takes keywords; gp2.System.load reads a model file",
        lambda: gp2.simulate(arm, {}, [0, 1], system=arm): "simulate() got the argument 'system' twice: by position and by name",
        lambda: posterior.sample(arm_states, 2, n_samples=2): "sample() got the argument 'n_samples' twice: by position and by name",
    }.items():
        with pytest.raises(TypeError) as caught:
            call()
        assert str(caught.value).startswith(said)


def test_a_whole_number_that_is_too_large_is_told_so(arm, arm_log, posterior, arm_states):
    start, times = {"shoulder": 0.9}, [0, 0.1]
    for call, said in {
        lambda: posterior.sample(arm_states, seed=2**64): "seed: expected a whole number below 2^64, got 18446744073709551616",
        lambda: posterior.simulate(start, times, n_samples=1, seed=2**64): "seed: expected a whole number below 2^64, got 184",
        lambda: posterior.sample(arm_states, 2**31, seed=2**40): "n_samples: expected a whole number below 2^31, got 2147483648",
        lambda: gp2.fit(arm, arm_log, restarts=2**31): "restarts: expected a whole number below 2^31, got 2147483648",
        lambda: posterior.predict(arm_states, "next-velocity", dt=np.ones(2)): "dt: expected a number, got array([1., 1.])",
    }.items():
        with pytest.raises(TypeError) as caught:
            call()
        assert str(caught.value).startswith(said)


def test_no_names_are_an_empty_list_where_the_command_says_none(arm, arm_log):
    with pytest.raises(TypeError, match=r"^estimate: expected a list of names, \[\] for none, got 'none'$"):
        gp2.fit(arm, arm_log, estimate="none")
    with pytest.raises(gp2.InputError, match=r"^estimate: expected a list of names, \[\] for none, got \['none'\]$"):
        gp2.fit(arm, arm_log, estimate=["none"])
    assert "parameters to estimate; estimate=[]: none; default: those marked in the model" in gp2.fit.__doc__


def test_what_is_no_fit_is_named(arm):
    for call in (lambda: gp2.plot(arm), lambda: gp2.report(arm), lambda: gp2.report([arm])):
        with pytest.raises(TypeError, match="^fit: expected a gp2.Posterior or the path of a FIT.json, got <gp2.System"):
            call()
    with pytest.raises(TypeError, match="^system: expected a gp2.System, a gp2.Posterior or the path of a file of one, got 3$"):
        gp2.show(3)


def test_a_truth_value_is_no_number_and_a_number_no_truth_value(arm, arm_log):
    for name, value, expected in [
        ("noise_std", True, "a positive number, 'estimate'"),
        ("restarts", np.True_, "a whole number"),
        ("robust", 2, "True or False"),
        ("standard_errors", 0.0, "True or False"),
    ]:
        with pytest.raises(TypeError, match=f"^{name}: expected {expected}"):
            gp2.fit(arm, arm_log, **{name: value})
    gp2.fit(arm, arm_log, max_iterations=0, robust=np.False_)


@pytest.mark.parametrize(
    ("keyword", "value"),
    [("drawing", [1]), ("units", "m"), ("parameters", ["m"]), ("latents", {"features": ["x"]}), ("latents", ["x"])],
)
def test_a_table_of_a_system_that_is_none_is_named(keyword, value):
    with pytest.raises(TypeError, match=rf"{keyword}: expected a (mapping|list) of .*, got "):
        gp2.System(coordinates=["x"], mass=[[1]], **{keyword: value})


def test_a_system_takes_the_coriolis_force_of_its_mass():
    rod = {"coordinates": ["q"], "mass": [["1 + q^2"]]}
    state = np.array([[0.5, 2.0, 0.0]])
    assert gp2.System(**rod).evaluate(state).F[0, 0] == 0
    assert gp2.System(**rod, coriolis=True).evaluate(state).F[0, 0] == pytest.approx(-0.5 * 2.0**2)


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("restarts", 2.5), ("seed", -1), ("observe", "ddshoulder"), ("noise_std", [1]), ("max_iterations", None),
        ("columns", 3), ("mean", 1), ("start", 3.5),
    ],
)  # fmt: skip
def test_a_keyword_of_another_type_is_a_type_error(arm, arm_log, keyword, value):
    with pytest.raises(TypeError, match=keyword if keyword != "start" else None):
        gp2.fit(arm, arm_log, **{keyword: value})


def test_words_and_numbers_out_of_range_are_input_errors(arm, arm_log):
    for keyword, value, said in [
        ("mean", "one", "mean: expected one of 'zero', 'force', got 'one'"),
        ("noise_std", "little", "noise_std: expected one of 'estimate', 'stated', got 'little'"),
        ("noise_std", -1.0, "noise_std: expected a positive number, 'estimate' or 'stated', got '-1'"),
        ("restarts", 0, "restarts: must be positive, got 0"),
    ]:
        with pytest.raises(gp2.InputError) as caught:
            gp2.fit(arm, arm_log, **{keyword: value})
        assert str(caught.value) == said


def test_options_of_a_fit_are_under_the_names_of_the_command(arm, arm_log):
    posterior = gp2.fit(arm, arm_log, mean="force", restarts=1, max_iterations=0, hyperprior=False, standard_errors=False)
    assert posterior.options["hyperprior"] == "none"
    assert posterior.options["restarts"] == 1
    assert posterior.options["standard_errors"] is False


def test_hyperparameters_are_integrated_over(arm, arm_log, tmp_path):
    posterior = gp2.fit(arm, arm_log, restarts=1, max_escapes=0, max_points=12, hyperparameters="integrate")
    draws = posterior.report.draws
    assert set(draws) == {h.name for h in posterior.report.hyperparameters}
    for of_one in draws.values():
        assert len(of_one["values"]) == 25
        assert of_one["interval95"][0] <= of_one["mean"] <= of_one["interval95"][1]
        assert of_one["r_hat"] >= 1 and of_one["effective_size"] > 0
    posterior.save(tmp_path / "fit.json")
    states = arm.generate(4, seed=9)
    assert (gp2.load(tmp_path / "fit.json").predict(states).std == posterior.predict(states).std).all()
    few = posterior.fewest_components(0.1)
    few.save(tmp_path / "few.json")
    assert (gp2.load(tmp_path / "few.json").predict(states).std == few.predict(states).std).all()
    assert 1 <= len(next(iter(few.report.draws.values()))["values"]) < 25
    assert abs(few.predict(states).mean - posterior.predict(states).mean).max() < posterior.predict(states).std.max()
    assert gp2.fit(arm, arm_log, restarts=1, max_iterations=3).report.draws is None


@pytest.mark.parametrize("kind", [types.MappingProxyType, collections.UserDict, pd.Series])
def test_where_a_dict_is_taken_any_mapping_is(kind, arm, arm_log, posterior):
    start, times = {"shoulder": 0.9}, [0, 0.1]
    expected = posterior.simulate(start, times).q
    np.testing.assert_array_equal(posterior.simulate(kind(start), times).q, expected)
    np.testing.assert_allclose(gp2.simulate(arm, kind(start), times).q[0], expected[0], rtol=1e-9)
    states = arm.states(arm_log)
    np.testing.assert_array_equal(arm.evaluate(states, kind({"m2": 3.0})).M, arm.evaluate(states, {"m2": 3.0}).M)
    renamed = {{"shoulder": "theta"}.get(name, name): arm_log[name] for name in arm_log}
    np.testing.assert_array_equal(arm.states(renamed, columns=kind({"shoulder": "theta"})), states)
    report = gp2.fit(arm, arm_log, max_iterations=0, start=kind({"m2": posterior.parameters["m2"]}), estimate=["m2"]).report
    assert report["m2"] == posterior.parameters["m2"]
    if kind is not pd.Series:
        assert gp2.report(kind({"this": posterior})) == gp2.report({"this": posterior})


def test_what_is_no_mapping_of_numbers_is_a_type_error(arm, arm_log, posterior):
    for call, text in [
        (lambda: arm.evaluate(arm_log, 3), "^parameters: expected a dict of names to numbers, got 3$"),
        (lambda: arm.evaluate(arm_log, {"m2": "heavy"}), "^parameters: expected a dict of names to numbers, got {'m2': 'heavy'}$"),
        (lambda: arm.generate(3, grid={"shoulder": 1.5}), "^grid: expected a dict of names to whole numbers, got"),
        (lambda: posterior.simulate({"shoulder": None}, [0, 1]), "^start: expected a dict of names to numbers, or all of q and dq, got"),
    ]:
        with pytest.raises(TypeError, match=text):
            call()


def test_rows_are_drawn_or_on_a_grid(arm):
    ranges = dict.fromkeys(["shoulder", "delbow", "t", "tau1", "tau2"], 2)
    assert len(arm.generate(grid=ranges, noise_std=0)) == 2**5
    for both_or_none in (dict(n=3, grid=ranges), {}):
        with pytest.raises(gp2.InputError, match="^give either n, a number of rows, or grid$"):
            arm.generate(**both_or_none)


def test_numbers_and_truth_values_of_numpy_go_into_a_model():
    keys = {"coordinates": ["q"], "mass": np.array([["m"]], dtype=object)}
    parameter = {"value": np.float32(0.5), "bounds": np.array([0.25, 1.0]), "estimate": np.True_}
    system = gp2.System(**keys, parameters={"m": parameter, "g": np.array(9.5), "n": np.int64(2)})
    assert system.parameters == {"m": 0.5, "g": 9.5, "n": 2}
    assert "bounds = [0.25, 1.0], estimate = true" in system.text


def test_start_may_be_a_dict(arm, arm_log):
    first = gp2.fit(arm, arm_log, restarts=1, max_iterations=3)
    values = {h.name: h.value for h in first.report.hyperparameters}
    again = gp2.fit(arm, arm_log, max_iterations=0, start=values)
    assert {h.name: h.value for h in again.report.hyperparameters} == values


def test_a_file_may_be_a_path(arm, arm_log, tmp_path):
    gp2.fit(arm, arm_log, restarts=1, max_iterations=2, hyperparameters="optimise", checkpoint=tmp_path / "last.json")
    assert gp2.load(tmp_path / "last.json").n_data == len(arm_log)


def test_a_fit_is_repeated_to_the_bits(arm, arm_log, tmp_path):
    posterior = gp2.fit(arm, arm_log, mean="force", estimate=["m2"], restarts=2, max_iterations=20, seed=4)
    posterior.save(tmp_path / "fit.json")
    gp2.fit_again(tmp_path / "fit.json").save(tmp_path / "again.json")
    gp2.fit_again(tmp_path / "fit.json", arm_log).save(tmp_path / "from_log.json")
    text = (tmp_path / "fit.json").read_text(encoding="utf-8")
    assert (tmp_path / "again.json").read_text(encoding="utf-8") == text
    assert (tmp_path / "from_log.json").read_text(encoding="utf-8") == text


def test_a_fit_again_warns_of_a_log_that_has_changed(arm, arm_log, tmp_path):
    path = write_csv(tmp_path / "log.csv", arm_log)
    gp2.fit(arm, path, max_iterations=0).save(tmp_path / "fit.json")
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    with pytest.warns(UserWarning, match="log.csv .*29 rows; then .* 30 rows"):
        gp2.fit_again(tmp_path / "fit.json", path, checkpoint=tmp_path / "last.json")


def test_messages_speak_of_keywords(arm, arm_log, tmp_path):
    with pytest.raises(gp2.InputError, match="^again: also goes with data$"):
        posterior = gp2.fit(arm, arm_log, restarts=1, max_iterations=0)
        posterior.save(tmp_path / "fit.json")
        gp2.fit_again(tmp_path / "fit.json", also=[gp2.SideInformation("unconstrained", arm_log)])


def functions_with_keywords():
    """Every function and constructor of the package that takes arguments by their names, and the first of these."""
    owners = [gp2] + [one for name, one in vars(gp2).items() if isinstance(one, type) and not name.startswith("_")]
    for owner in owners:
        for name in vars(owner):
            function = getattr(owner, name)
            signature = next(iter((getattr(function, "__doc__", None) or "").splitlines()), "")
            if not callable(function) or isinstance(function, (type, types.FunctionType)) or name.startswith("_") and name != "__init__":
                continue
            known = [word for word in re.findall(r"(\w+): ", signature.split(" -> ")[0]) if word != "self" and len(word) > 2]
            if known:
                yield pytest.param(owner, name, known[0], id=f"{owner.__name__}.{name}")


@pytest.mark.parametrize(("owner", "name", "keyword"), functions_with_keywords())
def test_every_function_names_a_misspelt_keyword_and_the_nearest(owner, name, keyword):
    function = owner if name == "__init__" else getattr(owner, name)
    called = owner.__name__ if name == "__init__" else name
    misspelt = keyword[1] + keyword[0] + keyword[2:]
    arguments = [object()] if isinstance(owner, type) and not isinstance(vars(owner)[name], staticmethod) and name != "__init__" else []
    with pytest.raises(TypeError, match=rf"{called}\(\) got an unexpected keyword argument '{misspelt}'; did you mean '{keyword}'"):
        function(*arguments, **{misspelt: 1})


EXPECTED = {"int": "a whole number", "float": "a number", "bool": "True or False", "str": "a str", "List[str]": "a list of names"}


@pytest.mark.parametrize(("owner", "name", "keyword"), functions_with_keywords())
def test_every_function_names_a_value_of_the_wrong_type(owner, name, keyword):
    function = owner if name == "__init__" else getattr(owner, name)
    documentation = getattr(owner, name).__doc__
    if "Overloaded function." in documentation:
        return
    for parameter, kind in re.findall(r"(\w+): ([\w.]+(?:\[\w+\])?)", documentation.splitlines()[0].split(" -> ")[0]):
        if kind not in EXPECTED:
            continue
        for wrong in [object(), "ddq1"][: 2 if kind == "List[str]" else 1]:
            with pytest.raises(TypeError) as error:
                function(**{parameter: wrong})
            text = str(error.value)
            if "**kwargs" not in text and "is missing the argument" not in text:  # options are read once the first arguments fit
                assert text == f"{parameter}: expected {EXPECTED[kind]}, got {wrong!r}"
