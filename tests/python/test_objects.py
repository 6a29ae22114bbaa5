"""Copies, pickles and texts of the objects."""

import copy
import pickle
import pprint

import numpy as np
import pytest

import gp2
from conftest import columns_of


def test_posterior_survives_a_pickle_to_the_bit(posterior, arm_states):
    for other in [pickle.loads(pickle.dumps(posterior)), copy.deepcopy(posterior)]:
        np.testing.assert_array_equal(other.predict(arm_states).cov, posterior.predict(arm_states).cov)


def test_copy_of_a_posterior_keeps_its_data_when_the_other_grows(posterior, arm):
    other = copy.copy(posterior)
    other.update(arm.generate(5, seed=9))
    assert other.n_data == posterior.n_data + 5


def test_a_posterior_without_data_is_copied_but_not_saved(posterior, arm_states, tmp_path):
    prior = posterior.without_data()
    for other in (copy.copy(prior), copy.deepcopy([prior])[0]):
        assert other is not prior
        np.testing.assert_array_equal(other.predict(arm_states).cov, prior.predict(arm_states).cov)
    for call in (lambda: prior.save(tmp_path / "prior.json"), lambda: pickle.dumps(prior)):
        with pytest.raises(gp2.InputError, match="^a posterior without data is not saved: save the fit"):
            call()
    assert not (tmp_path / "prior.json").exists()


def test_what_never_changes_is_its_own_copy_and_a_system_travels_as_text(arm, arm_log):
    for fixed in (arm, arm_log):
        assert copy.copy(fixed) is fixed and copy.deepcopy([fixed])[0] is fixed
    assert pickle.loads(pickle.dumps(arm)).text == arm.text


def test_a_deep_copy_of_a_log_keeps_its_data_when_those_of_the_other_change(arm, arm_log):
    log, free = columns_of(arm_log), {name: arm_log[name][:3].copy() for name in arm.state_names}
    free |= {name: np.zeros(3) for name in ("abar_shoulder", "abar_elbow")}

    def fitted(log, also):
        return gp2.fit(arm, log, also=also, also_noise_std=0.1, max_iterations=0).negative_log_likelihood

    given = gp2.Log(log, arm), gp2.SideInformation("unconstrained", free)
    shallow, deep, before = tuple(map(copy.copy, given)), copy.deepcopy(given), fitted(*given)
    log["ddelbow"] += 1
    free["abar_elbow"] += 1
    assert fitted(*deep) == before != fitted(*shallow) == fitted(*given)


def test_tables_survive_a_pickle_with_gaps_and_text():
    table = gp2.Table({"x": [0.1, np.nan, 1 / 3], "n": [1, None, 3], "said": ["a, b", '"quoted"', " "]}, name="odd")
    for one in (table, gp2.Table({"x": [np.nan, 5e-324, -1e300]})):
        again = pickle.loads(pickle.dumps(one))
        assert (again.name, again.columns, len(again)) == (one.name, one.columns, len(one))
        np.testing.assert_array_equal(again["x"], one["x"])
    again = pickle.loads(pickle.dumps(table))
    np.testing.assert_array_equal(again["n"], table["n"])
    for one in (table, again):
        assert list(one["said"]) == ["a, b", '"quoted"', " "]


def test_logs_and_side_information_survive_a_pickle(arm, arm_log):
    free = {name: arm_log[name][:3] for name in arm.state_names} | {name: np.zeros(3) for name in ("abar_shoulder", "abar_elbow")}
    also = gp2.SideInformation("unconstrained", gp2.Table(free), system=arm)

    def fitted(log, also):
        return gp2.fit(arm, log, also=also, also_noise_std=0.1, max_iterations=0).negative_log_likelihood

    log = gp2.Log(arm_log, arm)
    assert fitted(*pickle.loads(pickle.dumps((log, also)))) == fitted(log, also)


def public_values(thing):
    """What a result shows of itself, with those of results in it."""
    values = {}
    for name in dir(thing):
        if name.startswith("_") or callable(getattr(type(thing), name)):
            continue
        value = getattr(thing, name, None)  # a mean alone has no deviations
        if isinstance(value, gp2.Table):
            value = {column: value[column] for column in value}
        many = isinstance(value, list)
        values[name] = [public_values(one) if type(one).__module__ == "gp2._gp2" else one for one in (value if many else [value])]
    return values


def fit_of_a_cart():
    cart = gp2.System(
        coordinates=["x"], inputs=["u"], mass=[["1"]], force=["u"], latents=[{"features": ["dx"]}], noise=0.1, truth=["0"],
        sampling={"x": [-1, 1], "dx": [-1, 1], "u": [-1, 1]},
    )  # fmt: skip
    return gp2.fit(cart, cart.generate(5), mean="force", max_iterations=0)


def test_results_survive_a_pickle(posterior, arm, arm_log, arm_states, oscillator):
    drawn = gp2.fit(oscillator, oscillator.generate(20), mean="force", restarts=1, noise_std="estimate")
    points = gp2.fit(oscillator, oscillator.generate(40), restarts=1, inducing=10, hyperparameters="optimise", max_iterations=5)
    start = {"shoulder": 0.9}
    for result in (
        posterior.predict(arm_states),
        posterior.predict(arm_states, mean_only=True),
        posterior.evaluate(arm_log),
        posterior.cross_validate(),
        posterior.report,
        drawn.report,
        points.report,
        posterior.report.hyperparameters[0],
        posterior.report.restarts[0],
        arm.evaluate(arm_states),
        gp2.check(arm, arm_log)[0],
        posterior.simulate(start, [0, 0.1]),
        gp2.simulate(arm, start, [0, 0.1]),
        posterior.inverse_dynamics(arm_states, np.zeros((len(arm_states), 2))),
        gp2.excite(fit_of_a_cart(), {"x": 0}, 1, {"u": (-1, 1)}, n_rows=40, n_motions=20),
    ):
        for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
            assert type(again) is type(result) and again is not result
            np.testing.assert_equal(public_values(again), public_values(result))
            assert "object at" not in repr(result) and repr(again) == repr(result)
    report = pickle.loads(pickle.dumps(posterior.report))
    assert report.correlation("m2", "m2") == posterior.report.correlation("m2", "m2")
    assert list(pickle.loads(pickle.dumps(posterior.predict(arm_states))).to_frame()) == list(posterior.predict(arm_states).to_frame())


def test_systems_of_one_text_are_equal(arm, posterior):
    again = gp2.System.parse(arm.text, arm.name)
    assert again is not arm and again == arm and len({again, arm}) == 1
    assert posterior.system == posterior.system
    assert gp2.System.parse(arm.text + "# another", arm.name) != arm and arm != arm.text


def test_what_holds_functions_cannot_be_pickled():
    def free_mass(states, parameters):
        n = len(states)
        return np.ones((n, 1, 1)), None, None, np.zeros((n, 1))

    system = gp2.System.from_callables(free_mass, name="a mass", coordinates=["x"], noise=0.1, reads=["x", "dx"])
    again = gp2.System.from_callables(free_mass, name="a mass", coordinates=["x"], noise=0.1, reads=["x", "dx"])
    assert system == system and again != system  # nobody knows what they compute
    posterior = gp2.fit(system, {"x": [0.0, 1.0], "dx": [1.0, 0.5], "ddx": [0.1, 0.2]}, max_iterations=0)
    for thing in [system, posterior]:
        with pytest.raises(TypeError, match="'a mass' cannot be pickled: it has functions, which are code"):
            pickle.dumps(thing)
    assert copy.copy(posterior).negative_log_likelihood == posterior.negative_log_likelihood


def test_texts_say_what_a_thing_is_and_pprint_takes_them(posterior, arm, arm_log):
    evaluation = posterior.evaluate(arm_log)
    assert f"nrmse {evaluation.nrmse:.4g}" in repr(evaluation)
    for thing in [arm, arm_log, posterior, evaluation, posterior.report, posterior.report.hyperparameters]:
        assert pprint.pformat(thing) == repr(thing) or isinstance(thing, list)
