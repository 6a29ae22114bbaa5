"""The script and the notebooks in examples/ print what their texts promise."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gp2

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def code_of(notebook):
    """Its code cells, one after the other."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.fixture
def run(tmp_path):
    def run(name):
        script, folder = EXAMPLES / name, tmp_path
        if script.suffix == ".ipynb":  # Jupyter runs it in its own folder
            pytest.importorskip("matplotlib")
            script, folder = tmp_path / "notebook.py", EXAMPLES
            script.write_text(code_of(EXAMPLES / name), encoding="utf-8")
        environment = os.environ | {"PYTHONPATH": str(Path(gp2.__file__).resolve().parents[1]), "MPLBACKEND": "Agg"}
        result = subprocess.run([sys.executable, script], cwd=folder, env=environment, capture_output=True, text=True, timeout=120)
        assert result.returncode == 0, result.stderr
        # said: a motion may leave the data, an ordinary process another wire
        expected = r"UserWarning: (the motion leaves the region of the data|data of 'a wavy wire': \d+ % of the values lie within)"
        assert "Warning" not in re.sub(expected, "", result.stderr)
        return result.stdout

    return run


def numbers(output, pattern):
    """The numbers in the groups of a pattern that occurs once."""
    found = re.findall(pattern, output)
    assert len(found) == 1, f"{pattern} in:\n{output}"
    groups = found[0] if isinstance(found[0], tuple) else found
    return [float(number) for group in groups for number in group.split()]


def test_quickstart_errs_by_less_than_the_noise_and_keeps_the_constraint(run):
    output = run("quickstart.py")
    assert all(0 < error < 0.06 for error in numbers(output, r"Error of ddq1, ddq2, ddq3: \[(.*?)\]"))
    assert numbers(output, r"at most (\S+), rounding")[0] < 1e-13
    assert 80 <= numbers(output, r"(\d+)% of the true values")[0] <= 100


def test_real_life_tracks_better_with_the_learned_friction(run):
    output = run("real_life.ipynb")
    assert "  warning:" not in output and "  error:" not in output
    [with_friction] = numbers(output, r"with the learned friction: (\S+)°")
    [without] = numbers(output, r"error without friction: +(\S+)°")
    assert with_friction < 0.5 and without > 5
    [spread, slide] = numbers(output, r"ddphi: (\S+) rad/s² \(noise: 1\), ddx: (\S+)")
    assert 0.8 < spread < 2 and 0.08 < slide < 0.2


def test_transfer_holds_on_the_other_wire_where_an_ordinary_process_does_not(run):
    output = run("transfer.ipynb")
    home, ordinary_home = [max(map(float, found.split())) for found in re.findall(r"in the valley: +\[(.*?)\]", output)]
    away, ordinary_away, both = [max(map(float, found.split())) for found in re.findall(r"the wavy wire: +\[(.*?)\]", output)]
    assert home < ordinary_home and home < 0.05
    assert away < 0.3 and ordinary_away > 10 * away
    assert both < away
    assert numbers(output, r"on the wavy wire: +(\S+), its own constraint")[0] < 1e-13
    slow, fast = numbers(output, r"ddx there: +(\S+) m/s², (\S+) above")
    assert fast > 3 * slow
    drag, std = numbers(output, r"brakes with (\S+) ± (\S+) m/s²")
    assert abs(drag - 1.4) < 4 * std


def test_parameters_are_found_and_the_mass_only_where_the_log_knows_it(run):
    output = run("friction_and_parameters.ipynb")
    assert abs(numbers(output, r"mass +(\S+) kg    \(true")[0] - 0.2) < 0.005
    assert abs(numbers(output, r"bend +(\S+) 1/m   \(true")[0] - 0.5) < 0.005
    learned, believed = numbers(output, r"rms error of ddx: (\S+) m/s²; with the first guess believed: (\S+) m/s²")
    assert learned < 0.05 and 5 * learned < believed
    assert "the model does not explain what the input push does" in output
    pushed, coasting = numbers(output, r"pushed +(-.*)"), numbers(output, r"coasting +(-?\d.*)")
    assert pushed[0] < -100 and pushed[1] < -2 and pushed[3] < -2 and pushed[4] < -100
    assert min(coasting) > -0.5
    assert abs(numbers(output, r"at a wrong mass of 0.3 kg: (\S+) 1/m")[0] - 0.5) < 0.01


def test_a_raw_log_tells_the_friction_of_the_slide(run):
    output = run("raw_log.ipynb")
    assert numbers(output, r"in (\d+) rows over")[0] > 1000
    assert "ddphi_std" in output


def test_every_notebook_is_one_that_jupyter_opens_and_is_run_here():
    tests = Path(__file__).read_text(encoding="utf-8")
    notebooks = sorted(EXAMPLES.glob("*.ipynb"))
    assert notebooks
    for notebook in notebooks:
        assert f'"{notebook.name}"' in tests
        content = json.loads(notebook.read_text(encoding="utf-8"))
        assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
        assert content["cells"][0]["cell_type"] == "markdown"
        for cell in content["cells"]:
            assert cell["id"] and not cell.get("outputs"), "outputs would grow old"
