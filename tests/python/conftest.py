"""What the tests share. ctest sets GP2_COMMAND (the command gp2), GP2_PRINT_VIEWS (print_views.cpp), and PYTHONPATH."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import gp2

ROOT = Path(__file__).resolve().parents[2]
MODELS = ROOT / "models"


def program(variable):
    path = os.environ.get(variable)
    if not path:
        pytest.skip(f"{variable} is not set: run through ctest")
    return path


def run(*arguments, cwd=None):
    """A program's outcome, under the BLAS kernel that this process has: others round differently."""
    environment = dict(os.environ)
    if gp2.blas_report()["kernel"]:
        environment["OPENBLAS_CORETYPE"] = gp2.blas_report()["kernel"]
    return subprocess.run(
        [str(argument) for argument in arguments], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300
    )


@pytest.fixture
def command(tmp_path):
    """gp2 in a folder of its own."""
    path = program("GP2_COMMAND")
    return lambda *arguments: run(path, *arguments, cwd=tmp_path)


@pytest.fixture(scope="session")
def arm():
    """Two coordinates, one constraint that depends on time, two latents, a parameter to estimate."""
    return gp2.System.load(MODELS / "arm_on_moving_plane.toml")


@pytest.fixture(scope="session")
def arm_log(arm):
    return arm.generate(30, seed=3)


@pytest.fixture(scope="session")
def arm_states(arm):
    return arm.states(arm.generate(7, seed=11))


@pytest.fixture(scope="session")
def arm_fit_file(arm, arm_log, tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "fit.json"
    gp2.fit(arm, arm_log, mean="force", estimate=["m2"], restarts=1, max_iterations=30).save(path)
    return path


@pytest.fixture
def posterior(arm_fit_file):
    return gp2.load(arm_fit_file)


@pytest.fixture
def oscillator():
    """One coordinate, no constraint."""
    return gp2.System(
        coordinates=["x"],
        mass=[["2"]],
        force=["-3*x"],
        latents=[{"features": ["x", "dx"]}],
        noise=0.1,
        truth=["-0.2*dx^3"],
        sampling={"x": [-1, 1], "dx": [-1, 1]},
    )


def columns_of(table):
    return {name: table[name].copy() for name in table.keys()}


def write_csv(path, table):
    rows = np.column_stack(list(columns_of(table).values()))
    lines = [",".join(table.keys()), *(",".join(map(repr, row)) for row in rows.tolist())]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
