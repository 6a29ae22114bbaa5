"""gp2.excite: the motion that tells most of what is not known."""

import numpy as np
import pytest

import gp2

LIMITS = {"inputs_within": {"u": (-1, 1)}, "within": {"x": (-0.5, 0.5)}}
FEW = {"n_rows": 60, "n_motions": 80}


def spring_of(k):
    return gp2.System(
        coordinates=["x"],
        inputs=["u"],
        parameters={"k": k},
        mass=[["1"]],
        force=["u - k*x"],
        latents=[{"kernel": "se", "features": ["dx"]}],
        noise=0.1,
    )


@pytest.fixture(scope="module")
def spring():
    return spring_of({"value": 9.0, "bounds": [1, 30], "estimate": True})


@pytest.fixture(scope="module")
def posterior(spring):
    random = np.random.default_rng(3)
    x, dx, u = random.uniform(-0.1, 0.1, 30), random.uniform(-0.5, 0.5, 30), random.uniform(-0.2, 0.2, 30)
    ddx = u - 9 * x - 0.5 * dx + 0.1 * random.standard_normal(30)
    return gp2.fit(spring, {"x": x, "dx": dx, "u": u, "ddx": ddx}, mean="force", restarts=1)


def test_a_plan_tells_more_than_a_random_motion_within_its_limits(posterior):
    plan = gp2.excite(posterior, {"x": 0}, 6, **LIMITS, **FEW)
    k = plan.parameters["k"]
    assert k["after"] < k["random"] < k["now"]
    assert k["now"] == pytest.approx(posterior.report.standard_errors["k"], rel=0.02)
    assert plan.factor == pytest.approx(k["after"] / k["now"])
    assert plan.factor < plan.random_factor
    assert plan.accelerations == {}
    assert np.abs(plan.motion.q).max() == pytest.approx(0.5 * plan.limits["x"]["share"])
    assert plan.limits["x"]["share"] <= 1
    assert np.abs(np.asarray(plan.table["u"], float)).max() <= 1
    assert plan.highest_frequency == pytest.approx(8 / 6)
    assert plan.n_motions >= 80
    driven = posterior.simulate({"x": 0}, plan.motion.t, inputs=plan.table)
    np.testing.assert_allclose(driven.q, plan.motion.q, atol=1e-6)


def test_another_system_is_driven(posterior):
    stiff = spring_of(20.0)
    plan = gp2.excite(posterior, {"x": 0}, 6, **LIMITS, system=stiff, target="accelerations", **FEW)
    motion = plan.motion
    there = posterior.predict(motion.states, system=stiff).mean
    np.testing.assert_allclose(motion.ddq, there, rtol=0, atol=1e-9 * np.abs(there).max())


def test_the_seed_alone_decides(posterior):
    def states(**options):
        return gp2.excite(posterior, [0.0, 0.0], 6, **LIMITS, **FEW, **options).motion.states

    np.testing.assert_array_equal(states(threads=1), states(threads=2))
    assert (states() != states(seed=1)).any()


def test_accelerations_may_be_asked_for(posterior):
    plan = gp2.excite(posterior, {"x": 0}, 6, **LIMITS, **FEW, target="accelerations")
    assert plan.accelerations["ddx"]["after"] < plan.accelerations["ddx"]["now"]


def test_errors_name_what_is_wrong(posterior):
    with pytest.raises(gp2.InputError, match="inputs_within: no limits of 'u'"):
        gp2.excite(posterior, {"x": 0}, 6, {})
    with pytest.raises(gp2.InputError, match="duration: must be positive, got -1"):
        gp2.excite(posterior, {"x": 0}, -1, {"u": (0, 1)})
    with pytest.raises(TypeError, match="inputs_within: expected a dict of names to \\(lowest, highest\\)"):
        gp2.excite(posterior, {"x": 0}, 6, {"u": 1})
    with pytest.raises(gp2.InputError, match="start: x = 2 is outside of its limits -0.5:0.5 in within"):
        gp2.excite(posterior, {"x": 2}, 6, **LIMITS)
    with pytest.raises(TypeError, match="did you mean 'n_motions'"):
        gp2.excite(posterior, {"x": 0}, 6, **LIMITS, n_motion=3)
