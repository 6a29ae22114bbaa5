"""Exceptions carry the text of the command, with keywords for its options; warnings are Python's."""

import logging
import re
import warnings

import numpy as np
import pytest

import gp2
from conftest import MODELS, columns_of, write_csv

SURFACE = MODELS / "surface.toml"


@pytest.fixture
def log_file(arm_log, tmp_path):
    return write_csv(tmp_path / "log.csv", arm_log)


@pytest.fixture
def said(command):
    """What the command says to a mistake, without the words before."""

    def said(*arguments):
        outcome = command(*arguments)
        assert outcome.returncode == 2, outcome.stderr
        mark = "gp2: error: "
        assert mark in outcome.stderr
        return outcome.stderr.split(mark, 1)[1].rstrip("\n")

    return said


def with_keywords(text):
    """What the command says, with its options as Python has them."""
    text = re.sub(r"--map (\w+)=(\w+)", r"columns={'\2': '\1'}", text)
    text = re.sub(r"--(protocol|noise-std|prior|view) (paper|estimate|force|next-velocity)", lambda m: f"{m[1]}='{m[2]}'".replace("noise-", "noise_"), text)
    text = re.sub(r"--([a-z-]+) (S|SECONDS)\b", lambda m: f"{m[1].replace('-', '_')}={m[2]}", text)
    return re.sub(r"--([a-z-]+)", lambda m: m[1].replace("-", "_"), text)


def text_of(call):
    with pytest.raises(gp2.InputError) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("p1*q1^2", "p1*q1^*2"),
        ("p1*q1^2", "p7*q1^2"),
        ('["m", "0", "0"]', '["m", "1", "0"]'),
        ('["m", "0", "0"]', '["m", "0"]'),
        ('kernel     = "se"', 'kernel     = "sse"'),
        ('directions = "acceleration"', 'directions = "velocity"'),
        ("ddq = 0.1", "ddq = -0.1"),
        ("[noise]", "[nose]"),
        ('name        = "particle on a surface"', "name        = 3"),
        ("[sampling]", "[sampling"),
    ],
)
def test_a_mistake_in_a_model_file_reads_as_the_command_says_it(old, new, said, tmp_path):
    text = SURFACE.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    expected = said("show", path)
    assert "wrong.toml" in expected
    assert text_of(lambda: gp2.System.load(path)) == expected
    # without a file the text's name stands in its place
    named = text_of(lambda: gp2.System.parse(path.read_text(encoding="utf-8"), name="model.toml"))
    assert named == expected.replace(str(path), "model.toml")


@pytest.mark.parametrize(
    ("spoil", "options"),
    [
        (lambda log: log.pop("elbow"), {}),
        (lambda log: log.pop("ddelbow"), {}),
        (lambda log: log["dshoulder"].__setitem__(3, np.nan), {}),
        (lambda log: log, {"observe": ["ddwrist"]}),
        (lambda log: log, {"estimate": ["m7"]}),
        (lambda log: log, {"noise-std": 1e-12}),
        (lambda log: log, {"prior": "acceleration"}),
        (lambda log: log, {"protocol": "paper", "noise-std": "estimate"}),
    ],
)
def test_a_mistake_in_a_fit_reads_as_the_command_says_it(spoil, options, said, arm, arm_log, tmp_path):
    log = columns_of(arm_log)
    spoil(log)
    path = write_csv(tmp_path / "log.csv", log)
    arguments = []
    for name, value in options.items():
        arguments += [f"--{name}", ",".join(value) if isinstance(value, list) else value]
    expected = said("fit", MODELS / "arm_on_moving_plane.toml", "--data", path, *arguments, "-o", "fit.json")
    keywords = {name.replace("-", "_"): value for name, value in options.items()}
    assert text_of(lambda: gp2.fit(arm, path, **keywords)) == with_keywords(expected)


def test_a_mistake_in_a_file_reads_as_the_command_says_it(said, arm_fit_file, log_file, tmp_path):
    for content in ("", "a,b\n1\n", "a,a\n1,2\n"):
        path = tmp_path / "bad.csv"
        path.write_text(content, encoding="utf-8")
        assert text_of(lambda: gp2.read_csv(path)) == said("predict", arm_fit_file, "--states", path, "-o", "out.csv")
    for content in ("", "{}", arm_fit_file.read_text(encoding="utf-8")[:500]):
        path = tmp_path / "bad.json"
        path.write_text(content, encoding="utf-8")
        assert text_of(lambda: gp2.load(path)) == said("predict", path, "--states", log_file, "-o", "out.csv")


def test_a_mistake_in_a_prediction_reads_as_the_command_says_it(said, posterior, arm_fit_file, arm_log, tmp_path):
    states = {name: values for name, values in columns_of(arm_log).items() if name != "delbow"}
    path = write_csv(tmp_path / "states.csv", states)
    expected = said("predict", arm_fit_file, "--states", path, "-o", "out.csv")
    assert text_of(lambda: posterior.predict(path)) == with_keywords(expected)
    assert text_of(lambda: posterior.evaluate(path)) == with_keywords(said("evaluate", arm_fit_file, "--data", path))
    other = said("predict", arm_fit_file, "--states", path, "--system", SURFACE, "-o", "out.csv")
    assert text_of(lambda: posterior.predict(path, system=gp2.System.load(SURFACE))) == other


def test_a_state_without_prediction_reads_as_the_command_says_it(said, tmp_path):
    model = tmp_path / "model.toml"
    model.write_text(
        'coordinates = ["x"]\n[mechanics]\nmass = [["x"]]\n[[latent]]\nfeatures = ["dx"]\n[noise]\nddq = 0.1\n'
        '[truth]\nacceleration = ["dx"]\n[sampling]\nx = [1, 2]\ndx = [-1, 1]\n',
        encoding="utf-8",
    )
    system = gp2.System.load(model)
    posterior = gp2.fit(system, system.generate(5), max_iterations=0)
    posterior.save(tmp_path / "fit.json")
    path = write_csv(tmp_path / "states.csv", {"x": np.array([1.0, -1.0]), "dx": np.zeros(2), "ddx": np.zeros(2)})
    fit = tmp_path / "fit.json"
    assert text_of(lambda: posterior.predict(path)) == said("predict", fit, "--states", path, "-o", "out.csv")
    assert text_of(lambda: posterior.evaluate(path)) == said("evaluate", fit, "--data", path)


def test_names_are_checked(posterior, arm, arm_log, arm_states):
    for call, text in [
        (lambda: posterior.predict(arm_states, "position"), "view: expected one of constrained, "),
        (lambda: posterior.predict(arm_states, latent="friction"), "latent: "),
        (lambda: posterior.predict(arm_states, "next-velocity"), "view='next-velocity' needs the time step: dt=SECONDS"),
        (lambda: posterior.predict(arm_states, dt=0.1), "dt goes with view='next-velocity'"),
        (lambda: posterior.predict(arm_states, "next-velocity", dt=-1), "dt: must be positive, got -1"),
        (lambda: posterior.sample(arm_states, 0), "n_samples: must be at least 1, got 0"),
        (lambda: posterior.simulate({}, [0, 1], n_samples=-1), "n_samples: must be at least 1, got -1"),
        (lambda: posterior.evaluate(arm_log, outputs=["ddwrist"]), "outputs"),
        (lambda: posterior.update(arm_log, observe=["ddwrist"]), "observe"),
        (lambda: arm.evaluate(arm_states, {"m7": 1}), "parameters: 'two-link arm on a moving plane' has no parameter 'm7'; it has:"),
        (lambda: gp2.fit(arm, arm_log, mean="none"), "mean: expected one of 'zero', 'force', got 'none'"),
        (lambda: gp2.fit(arm, arm_log, prior="velocity"), "prior: expected one of"),
        (lambda: gp2.fit(arm, arm_log, baseline="gp"), "baseline: expected one of 'se', 'icm', 'lmc', got 'gp'"),
        (lambda: gp2.fit(arm, arm_log, protocol="new"), "protocol: expected one of"),
        (lambda: gp2.fit(arm, arm_log, noise_std="guess"), "noise_std: expected one of 'estimate', 'stated', got 'guess'"),
        (lambda: gp2.fit(arm, arm_log, noise_std=-1), "noise_std: expected a positive number, 'estimate' or 'stated', got '-1'"),
        (lambda: gp2.fit(arm, arm_log, restarts=0), "restarts: must be positive, got 0"),
        (lambda: gp2.fit(arm, arm_log, max_iterations=-1), "max_iterations: must not be negative, got -1"),
        (lambda: gp2.fit(arm, arm_log, max_points=0), "max_points: must be positive, got 0"),
        (lambda: gp2.fit(arm, arm_log, threads=-1), "threads: must be positive, or 0 for as many as the machine has; got -1"),
    ]:
        assert text in text_of(call)
    with pytest.raises(TypeError, match="noise_std: expected a positive number, 'estimate' or 'stated', got \\[1\\]"):
        gp2.fit(arm, arm_log, noise_std=[1])
    with pytest.raises(TypeError, match="system: expected a gp2.System .gp2.System.load reads one from a file., got 'arm.toml'"):
        gp2.fit("arm.toml", arm_log)
    with pytest.raises(TypeError, match="seed: expected a whole number that is not negative, got -1"):
        posterior.sample(arm_states, 2, seed=-1)
    with pytest.raises(TypeError, match="n_samples: expected a whole number, got array"):
        posterior.sample(arm_states, np.array([1, 2]))
    with pytest.raises(TypeError, match="system: expected a gp2.System .gp2.System.load reads one from a file., got None"):
        gp2.fit(None, arm_log)
    with pytest.raises(TypeError, match=r"^fit\(\) is missing the argument 'data'$"):
        gp2.fit(arm)
    with pytest.raises(TypeError, match=r"^SideInformation\(\) is missing the argument 'data'$"):
        gp2.SideInformation("multipliers")
    with pytest.raises(TypeError, match=r"^export\(\) is missing the argument 'folder'$"):
        posterior.export()
    with pytest.raises(TypeError, match=r"also\[0\]: expected a gp2.SideInformation, got <class 'dict'>"):
        gp2.fit(arm, arm_log, also=[{}])
    with pytest.raises(TypeError, match="a model holds text, numbers, lists and mappings, not set"):
        gp2.System(coordinates=["x"], mass=[{1}])


def test_the_classes_of_errors_are_pythons(arm):
    assert issubclass(gp2.InputError, ValueError)
    assert issubclass(gp2.NumericalError, ArithmeticError)
    with pytest.raises(ValueError):
        gp2.System.load("missing.toml")


def test_a_failed_save_leaves_the_file(posterior, tmp_path):
    with pytest.raises(gp2.InputError, match="no-such-folder"):
        posterior.save(tmp_path / "no-such-folder" / "fit.json")


def test_warnings_are_pythons_and_notes_go_to_the_logger(posterior, arm, arm_log, caplog):
    off = columns_of(arm_log)
    off["elbow"] = off["elbow"] + 0.1
    with pytest.warns(UserWarning, match="off the constraint"):
        posterior.predict(off)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="off the constraint"):
            posterior.predict(off)
    renamed = {{"shoulder": "theta1"}.get(name, name): values for name, values in columns_of(arm_log).items()}
    with caplog.at_level(logging.INFO, logger="gp2"):
        posterior.predict(renamed, columns={"shoulder": "theta1"})
    assert "theta1" in caplog.text


def test_noise_that_is_not_given_is_not_taken_for_none():
    keys = {"coordinates": ["x"], "mass": [["1"]], "truth": ["0"], "sampling": {"x": [-1, 1], "dx": [-1, 1]}}
    with pytest.raises(gp2.InputError, match=r"no \[noise\] ddq to draw from; give noise_std=S \(0 for the truth\)"):
        gp2.System(**keys).generate(3)
    assert len(gp2.System(**keys).generate(3, noise_std=0)) == 3


def test_texts_name_options_as_keywords(arm, arm_log):
    log = columns_of(arm_log)
    del log["elbow"]
    assert "or give columns={'elbow': 'LOGNAME'}" in text_of(lambda: gp2.fit(arm, log))
    text = text_of(lambda: gp2.fit(arm, arm_log, protocol="paper", noise_std="estimate"))
    assert text == "protocol='paper' has fixed noise: leave out noise_std='estimate'"
    text = text_of(lambda: gp2.fit(arm, arm_log, columns={"elbow": "nosuch"}))
    assert text.startswith("columns={'elbow': 'nosuch'}: data of 'two-link arm on a moving plane' has no column 'nosuch'")
    assert "--" not in text
