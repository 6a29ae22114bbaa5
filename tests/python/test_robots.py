"""Robots from Python: the keywords of System, and copies that need no file."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

import gp2

PENDULUM = """<mujoco>
  <worldbody>
    <body name="rod">
      <joint name="angle" axis="0 1 0"/>
      <inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.1"/>
      <site name="end" pos="0 0 -1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def pendulum(tmp_path):
    file = tmp_path / "pendulum.xml"
    file.write_text(PENDULUM)
    try:
        return gp2.System(
            robot=file,
            inputs=["u"],
            parameters={"m": {"of": 'mass("rod")', "value": 3.0}},
            force_on={'site("end").x': '-0.5*dsite("end").x'},
            latents=[{"features": ["angle", "dangle"]}],
            noise=0.1,
            truth={"force": ["0"]},
            motion={"rate": 50, "segment": [0.5, 1], "natural_frequency": 20, "targets": {"angle": [-1, 1]}},
        )
    except gp2.InputError as error:
        if "without MuJoCo" in str(error):
            pytest.skip(str(error))
        raise


def test_a_pendulum_has_the_mechanics_of_a_textbook(pendulum):
    q, dq, u = 0.7, 1.3, 0.4
    values = pendulum.evaluate([[q, dq, 0.0, u]])
    mass, force = values.M, values.F
    assert np.isclose(np.ravel(mass)[0], 0.1 + 3 * 0.5**2, rtol=1e-14)
    friction = 0.5 * np.cos(q) ** 2 * dq
    assert np.isclose(np.ravel(force)[0], u - 3 * 9.81 * 0.5 * np.sin(q) - friction, rtol=1e-13)


def test_a_driven_motion_is_generated_and_fitted(pendulum):
    table = pendulum.generate(60, seed=3)
    posterior = gp2.fit(pendulum, table, mean="force", restarts=1, max_iterations=20)
    assert np.isfinite(posterior.predict(pendulum.states(table)).mean).all()


def test_copies_and_pickles_need_no_file(pendulum, tmp_path):
    states = [[0.1, 0.2, 0.0, 0.3]]
    (tmp_path / "pendulum.xml").unlink()
    for other in (copy.deepcopy(pendulum), pickle.loads(pickle.dumps(pendulum))):
        assert np.array_equal(other.evaluate(states).F, pendulum.evaluate(states).F)


def test_an_export_leaves_the_robots_own_file_alone(pendulum, tmp_path):
    posterior = gp2.fit(pendulum, pendulum.generate(30, seed=3), mean="force", restarts=1, max_iterations=0)
    with pytest.raises(gp2.InputError, match="pendulum.xml is the robot's own file, which would be lost"):
        posterior.export(tmp_path, to="mjcf", name="pendulum", robot=str(tmp_path / "pendulum.xml"))
    assert (tmp_path / "pendulum.xml").read_text() == PENDULUM
    (written,) = posterior.export(tmp_path, to="mjcf", name="fitted", robot=str(tmp_path / "pendulum.xml"))
    assert 'mass="3"' in Path(written).read_text()
