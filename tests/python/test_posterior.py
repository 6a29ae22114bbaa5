"""What a posterior does beside predicting: joint, samples, motions, growing data, files."""

import json
import threading
from pathlib import Path

import numpy as np
import pytest

import gp2
from conftest import columns_of, write_csv


def assert_on_constraint(system, states, ddq, parameters, tolerance=1e-12):
    mechanics = system.evaluate(states, parameters)
    A, b = mechanics.A, mechanics.b
    error = np.einsum("nij,...nj->...ni", A, ddq) - b
    scale = np.einsum("nij,...nj->...ni", np.abs(A), np.abs(ddq)) + np.abs(b)
    assert (np.abs(error) <= tolerance * scale).all()


def test_means_and_samples_obey_the_constraint(posterior, arm, arm_states):
    fitted = posterior.parameters
    assert fitted["m2"] != arm.parameters["m2"]
    assert_on_constraint(arm, arm_states, posterior.predict(arm_states).mean, fitted)
    samples = posterior.sample(arm_states, 50, seed=2)
    assert samples.std(axis=0).min() > 0
    assert_on_constraint(arm, arm_states, samples, fitted)


def test_joint_has_the_marginals_on_its_diagonal(posterior, arm_states):
    mean, covariance = posterior.joint(arm_states)
    prediction = posterior.predict(arm_states)
    np.testing.assert_allclose(mean.reshape(-1, 2), prediction.mean, rtol=1e-12, atol=1e-12 * np.abs(mean).max())
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-12, atol=1e-14)
    blocks = np.array([covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(len(arm_states))])
    np.testing.assert_allclose(blocks, prediction.cov, rtol=0, atol=1e-9 * np.abs(covariance).max())


def test_samples_are_draws_of_joint_and_repeat_with_their_seed(posterior, arm_states):
    mean, covariance = posterior.joint(arm_states)
    samples = posterior.sample(arm_states, 4000, seed=5).reshape(4000, -1)
    spread = np.sqrt(np.diag(covariance))
    assert (np.abs(samples.mean(axis=0) - mean) < 5 * spread / np.sqrt(4000)).all()  # five standard errors
    np.testing.assert_allclose(np.cov(samples.T), covariance, rtol=0, atol=0.1 * np.outer(spread, spread).max())
    np.testing.assert_array_equal(posterior.sample(arm_states, 2, seed=5), posterior.sample(arm_states, 2, seed=5))
    assert (posterior.sample(arm_states, 2, seed=5) != posterior.sample(arm_states, 2, seed=6)).any()


def test_the_number_of_threads_changes_no_bit(posterior, arm):
    states = arm.states(arm.generate(300, seed=9))
    one, three = posterior.predict(states, threads=1), posterior.predict(states, threads=3)
    np.testing.assert_array_equal(one.mean, three.mean)
    np.testing.assert_array_equal(one.cov, three.cov)
    with pytest.raises(gp2.InputError, match="threads: must be at least 0, got -1"):
        posterior.predict(states, threads=-1)


def test_python_threads_predict_at_the_same_time_as_the_data_grow(posterior, arm):
    states = arm.states(arm.generate(200, seed=9))
    before = posterior.predict(states, mean_only=True).mean
    more = arm.generate(20, seed=10)
    failures = []

    def predict():
        try:
            for _ in range(20):
                assert np.isfinite(posterior.predict(states, mean_only=True).mean).all()
                posterior.joint(states[:5])
                assert np.isfinite(posterior.evaluate(more, threads=1).nrmse)
                assert np.isfinite(posterior.cross_validate().one_by_one.nrmse)
                posterior.fewest_components(0.5)
        except BaseException as error:  # noqa: BLE001  # told by the main thread
            failures.append(error)

    threads = [threading.Thread(target=predict) for _ in range(3)]
    for thread in threads:
        thread.start()
    for k in range(20):
        posterior.update({name: values[k : k + 1] for name, values in columns_of(more).items()})
        posterior.remove_oldest()
    for thread in threads:
        thread.join()
    assert not failures
    assert (posterior.predict(states, mean_only=True).mean != before).any()


# ---------------------------------------------------------------- data that grow


def test_export_makes_its_folder(posterior, tmp_path):
    folder = tmp_path / "controller" / "c"
    paths = posterior.export(folder, name="arm")
    assert paths and {Path(path).parent for path in paths} == {folder}
    assert all(Path(path).is_file() for path in paths)
    with pytest.raises(gp2.InputError, match="the folder cannot be made: "):
        posterior.export(paths[0])


def test_update_is_the_fit_of_all_data_under_the_same_hyperparameters(arm, arm_log, arm_states, tmp_path):
    first, more = ({name: values[part] for name, values in columns_of(arm_log).items()} for part in (slice(20), slice(20, 30)))
    posterior = gp2.fit(arm, first, max_iterations=0, discrepancy="none")
    posterior.save(tmp_path / "first.json")
    posterior.update(more)
    assert posterior.n_data == 30
    anew = gp2.fit(arm, arm_log, start=tmp_path / "first.json", max_iterations=0, discrepancy="none")
    updated, expected = posterior.predict(arm_states), anew.predict(arm_states)
    np.testing.assert_allclose(updated.mean, expected.mean, rtol=0, atol=1e-10 * np.abs(expected.mean).max())
    np.testing.assert_allclose(updated.cov, expected.cov, rtol=0, atol=1e-10 * np.abs(expected.cov).max())

    # and the file of a posterior that has grown holds the data it has
    posterior.save(tmp_path / "grown.json")
    loaded = gp2.load(tmp_path / "grown.json")
    assert loaded.n_data == 30
    np.testing.assert_allclose(
        loaded.predict(arm_states).mean, updated.mean, rtol=0, atol=1e-10 * np.abs(updated.mean).max()
    )


def test_removed_data_are_as_if_they_had_not_been(arm, arm_log, arm_states, tmp_path):
    posterior = gp2.fit(arm, arm_log, max_iterations=0, discrepancy="none")
    posterior.save(tmp_path / "all.json")
    posterior.remove_oldest(12)
    assert posterior.n_data == 18
    rest = {name: values[12:] for name, values in columns_of(arm_log).items()}
    anew = gp2.fit(arm, rest, start=tmp_path / "all.json", max_iterations=0, discrepancy="none")
    # scales are held, those of another fit are its own data's; what starts by value is equal
    expected = anew.predict(arm_states).mean
    np.testing.assert_allclose(posterior.predict(arm_states).mean, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    with pytest.raises(gp2.InputError, match="there are 18 observed states"):
        posterior.remove_oldest(19)
    assert posterior.n_data == 18


def test_a_refused_update_leaves_the_posterior_as_it_was(posterior, arm_log, arm_states):
    before = posterior.predict(arm_states).cov
    bad = {name: values[:2] for name, values in columns_of(arm_log).items()}
    bad["ddelbow"] = np.array([0.1, np.inf])
    with pytest.raises(gp2.InputError, match="ddelbow"):
        posterior.update(bad)
    with pytest.raises(gp2.InputError, match="must be positive, got 0"):
        posterior.update(arm_log, window=0)  # after it was grown
    with pytest.raises(gp2.InputError, match="the oldest go by"):
        posterior.update(arm_log, forget=0.5)
    np.testing.assert_array_equal(posterior.predict(arm_states).cov, before)


def test_without_data_it_is_the_prior(posterior, arm_states):
    prior = posterior.without_data()
    assert prior.n_data == 0
    assert (prior.predict(arm_states).std > posterior.predict(arm_states).std).any()


# ---------------------------------------------------------------- files, figures, motion


def test_a_loaded_fit_gives_the_same_bits(arm, arm_log, arm_states, tmp_path):
    posterior = gp2.fit(arm, arm_log, mean="force", estimate=["m2"], restarts=1, max_iterations=5)
    posterior.save(tmp_path / "fit.json")
    for loaded in (gp2.load(tmp_path / "fit.json"), gp2.Posterior.load(str(tmp_path / "fit.json"))):
        for view in ("constrained", "unconstrained", "constraint-force", "multipliers"):
            ours, theirs = posterior.predict(arm_states, view), loaded.predict(arm_states, view)
            np.testing.assert_array_equal(ours.mean, theirs.mean)
            np.testing.assert_array_equal(ours.cov, theirs.cov)
        assert loaded.report["m2"] == posterior.report["m2"]
        assert loaded.negative_log_likelihood == posterior.negative_log_likelihood
        assert loaded.system.text == arm.text
        assert loaded.options == posterior.options
        assert (loaded.options["restarts"], loaded.options["estimate"]) == (1, ["m2"])
        loaded.save(tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == (tmp_path / "fit.json").read_bytes()


def test_a_start_out_of_bounds_is_taken_where_nothing_is_optimised(arm, arm_log, tmp_path):
    start = tmp_path / "start.json"
    start.write_text('{"m2": 2.5}', encoding="utf-8")
    posterior = gp2.fit(arm, arm_log, estimate=["m2"], start=start, max_iterations=0)
    assert posterior.parameters["m2"] == 2.5
    again = gp2.fit(arm, arm_log, estimate=["m2"], start=posterior.report, max_iterations=0)
    assert dict(again.report) == dict(posterior.report)
    assert any("m2 = 2.5 is outside its bounds [1, 2]; used" in note for note in posterior.notes)
    with pytest.raises(gp2.InputError, match="m2 = 2.5 is outside its bounds"):
        gp2.fit(arm, arm_log, estimate=["m2"], start=start)


def test_noise_that_collapses_is_told(oscillator):
    exact = oscillator.generate(6, noise_std=0)
    twice = {name: np.repeat(exact[name], 2) for name in exact.columns}
    with pytest.warns(UserWarning, match="repeat another one"):
        posterior = gp2.fit(oscillator, twice, noise_std="estimate", restarts=1, hyperprior=False)
    assert any("ended at the lower bound: the log has less noise" in note for note in posterior.notes)


def test_the_report_tells_how_the_fit_went(posterior):
    report = posterior.report
    names = [h.name for h in report.hyperparameters]
    assert "m2" in names
    assert report["m2"] == posterior.parameters["m2"]
    for ask in (lambda: report["m7"], lambda: report.correlation("m2", "m7")):
        with pytest.raises(KeyError, match="no hyperparameter 'm7'; there are: .*m2"):
            ask()
    assert len(report.restarts) == 1
    assert report.termination in repr(report)
    assert all(h.lower <= h.value <= h.upper for h in report.hyperparameters)


def test_figures_against_true_accelerations(posterior, arm):
    test = arm.generate(100, seed=21, noise_std=0)
    figures = posterior.evaluate(test)
    error = posterior.predict(test).mean - np.column_stack([test[name] for name in figures.outputs])
    np.testing.assert_allclose(figures.rmse, np.sqrt((error**2).mean(axis=0)), rtol=1e-12)
    assert figures.n == 100
    assert figures.outputs == arm.acceleration_names
    assert figures.max_constraint_error_fitted < 1e-10
    assert posterior.evaluate(test, outputs=["ddelbow"]).rmse.shape == (1,)


def test_the_predictor_gives_what_predict_gives(posterior, arm_states):
    for view, dt in [
        ("constrained", None),
        ("unconstrained", None),
        ("constraint-force", None),
        ("multipliers", None),
        ("next-velocity", 0.01),
        ("force", None),
    ]:
        predictor = gp2.Predictor(posterior, view, dt=dt)
        expected = posterior.predict(arm_states, view, dt=dt)
        scale = np.abs(expected.mean).max()
        for k, state in enumerate(arm_states):
            mean, std = predictor.mean_and_std(state)
            np.testing.assert_allclose(mean, expected.mean[k], rtol=0, atol=1e-12 * scale)
            np.testing.assert_array_equal(predictor.mean(state), mean)
            np.testing.assert_allclose(std**2, expected.std[k] ** 2, rtol=0, atol=1e-9 * np.square(expected.std).max())


def test_another_system_moves_and_is_predicted_at_one_state_after_another(arm, posterior):
    faster = gp2.System.parse(arm.text.replace("w  = 4.0", "w  = 5.0"))
    start = {"shoulder": 0.3}
    motion = posterior.simulate(start, np.linspace(0, 0.2, 5), system=faster)
    assert motion.max_position_drift < 1e-12
    assert not np.allclose(motion.q, posterior.simulate(start, np.linspace(0, 0.2, 5)).q, rtol=0, atol=1e-6)
    there = posterior.predict(motion.states, system=faster)
    np.testing.assert_allclose(motion.ddq, there.mean, rtol=0, atol=1e-11 * np.abs(there.mean).max())
    np.testing.assert_allclose(motion.std, there.std, rtol=0, atol=1e-11 * np.abs(there.mean).max())
    force = posterior.predict(motion.states, "force", system=faster, latent="friction of the tip")
    for predictor, expected in [
        (gp2.Predictor(posterior, system=faster), there),
        (gp2.Predictor(posterior, "force", system=faster, latent="friction of the tip"), force),
    ]:
        for k, state in enumerate(motion.states):
            np.testing.assert_allclose(predictor.mean(state), expected.mean[k], rtol=0, atol=1e-11 * np.abs(expected.mean).max())


def test_forward_of_the_inverse_dynamics_is_what_was_wanted(arm, posterior, arm_states):
    wanted = posterior.predict(arm_states).mean
    start = arm_states.copy()
    start[:, -2:] = 0
    found = posterior.inverse_dynamics(start, wanted)
    assert found.names == arm.inputs
    there = arm_states.copy()
    there[:, -2:] = found.inputs
    reached = posterior.predict(there)
    np.testing.assert_allclose(reached.mean, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(found.missed, wanted - reached.mean, rtol=0, atol=1e-11 * np.abs(wanted).max())
    np.testing.assert_allclose(found.std**2, np.diagonal(found.cov, axis1=1, axis2=2), rtol=1e-12)

    table = {name: start[:, k] for k, name in enumerate(arm.state_names) if not name.startswith("tau")}
    by_table = posterior.inverse_dynamics(table | {"ddelbow": wanted[:, 1]})
    np.testing.assert_array_equal(
        by_table.inputs, posterior.inverse_dynamics(start, wanted[:, 1:], outputs=["ddelbow"]).inputs
    )
    with pytest.raises(gp2.InputError, match="those of a table are its columns"):
        posterior.inverse_dynamics(table, wanted)


def test_inverse_dynamics_in_a_loop_is_that_of_many_states(arm, posterior, arm_states):
    faster = gp2.System.parse(arm.text.replace("w  = 4.0", "w  = 5.0"))
    start = arm_states.copy()
    start[:, -2:] = 0
    for outputs, system in [(None, None), (["ddelbow"], faster)]:
        wanted = posterior.predict(arm_states, system=system).mean[:, -len(outputs or []) :]
        found = posterior.inverse_dynamics(start, wanted, outputs=outputs, system=system)
        solver = gp2.InverseDynamicsSolver(posterior, outputs=outputs, system=system)
        predictor = gp2.Predictor(posterior)
        for k, state in enumerate(start):
            inputs, cov = solver.inputs_and_cov(state, wanted[k])
            np.testing.assert_array_equal(inputs, solver.inputs(state, wanted[k]))
            np.testing.assert_allclose(inputs, found.inputs[k], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(cov, found.cov[k], rtol=1e-6, atol=1e-9 * np.abs(found.cov).max())
            state[-2:] = inputs
            mean, ddq_cov = predictor.mean_and_cov(state)
            np.testing.assert_array_equal(mean, predictor.mean(state))
            np.testing.assert_allclose(np.diagonal(ddq_cov), predictor.mean_and_std(state)[1] ** 2, rtol=1e-9, atol=1e-15)

    solver = gp2.InverseDynamicsSolver(posterior, cov=False)
    for match, call in [
        ("accelerations", lambda: solver.inputs(start[0], [0.0])),
        ("ddshoulder is nan; what is read must be finite", lambda: solver.inputs(start[0], [np.nan, 0.0])),
        ("shoulder is nan, elbow is nan", lambda: solver.inputs(np.full_like(start[0], np.nan), [0.0, 0.0])),
        ("cov", lambda: solver.inputs_and_cov(start[0], [0.0, 0.0])),
        ("outputs", lambda: gp2.InverseDynamicsSolver(posterior, outputs=["ddknee"])),
    ]:
        with pytest.raises(gp2.InputError, match=match):
            call()


def test_the_predictors_jacobian_is_the_derivative(posterior, arm_states):
    predictor = gp2.Predictor(posterior)
    state, step = arm_states[0], 1e-6
    mean, jacobian = predictor.mean_and_jacobian(state)
    assert jacobian.shape == (2, 7)
    differences = [
        (predictor.mean(state + step * e) - predictor.mean(state - step * e)) / (2 * step) for e in np.eye(len(state))
    ]
    np.testing.assert_allclose(jacobian, np.transpose(differences), rtol=0, atol=1e-6 * np.abs(jacobian).max())
    assert np.abs(jacobian).max() > 0
    single = gp2.Predictor(posterior, storage="single", std=False, jacobian=False)
    np.testing.assert_allclose(single.mean(state), mean, rtol=0, atol=1e-3 * np.abs(mean).max())


def test_the_predictors_options_are_checked(posterior):
    for options, text in [
        ({"view": "position"}, "view: expected one of constrained"),
        ({"dt": 0.1}, "dt goes with view='next-velocity'"),
        ({"view": "next-velocity"}, "needs the time step: dt=SECONDS"),
        ({"storage": "half"}, "storage: expected 'double' or 'single', got 'half'"),
    ]:
        with pytest.raises(gp2.InputError) as caught:
            gp2.Predictor(posterior, **options)
        assert text in str(caught.value)


def test_a_motion_stays_on_the_constraint(posterior, arm):
    times = np.linspace(0, 0.5, 26)
    motion = posterior.simulate({"shoulder": 0.9, "dshoulder": 0.2}, times)
    np.testing.assert_array_equal(motion.t, times)
    assert motion.states.shape == (26, 7)
    np.testing.assert_array_equal(motion.states, np.column_stack([motion.q, motion.dq, times, np.zeros((26, 2))]))
    np.testing.assert_allclose(motion.ddq, posterior.predict(motion.states).mean, rtol=1e-12)
    np.testing.assert_allclose(motion.std, posterior.predict(motion.states).std, rtol=1e-9, atol=1e-9)
    assert motion.max_position_drift < 1e-12
    assert motion.steps > 0
    again = posterior.simulate(motion.states[0, :4], times)
    np.testing.assert_allclose(again.q, motion.q, rtol=0, atol=1e-9)
    assert gp2.simulate(arm, {"shoulder": 0.9}, times).std is None


def test_sampled_motions_differ_and_repeat_with_their_seed(posterior):
    def q(seed):
        return [m.q for m in posterior.simulate({"shoulder": 0.9}, [0, 0.2], n_samples=3, seed=seed)]

    first = q(4)
    assert len(first) == 3
    assert (first[0][-1] != first[1][-1]).any()
    np.testing.assert_array_equal(first, q(4))


def test_inputs_move_the_motion(posterior):
    start, times = {"shoulder": 0.9}, [0, 0.1, 0.2]
    pushed = posterior.simulate(start, times, inputs={"t": [0, 1], "tau1": [1, 1], "tau2": [0, 0]})
    assert (pushed.states[:, -2] == 1).all()
    assert (pushed.q[-1] != posterior.simulate(start, times).q[-1]).any()


def test_a_motion_starts_at_the_first_row_of_any_table(posterior, arm, arm_log):
    columns = {name: arm_log[name][:3] for name in arm.state_names}
    rows = np.rec.fromarrays(list(columns.values()), names=list(columns))
    expected = posterior.simulate(gp2.Table(columns), [0, 0.1]).q
    for start in (columns, {name: list(values) for name, values in columns.items()}, rows, np.asarray(rows)):
        np.testing.assert_array_equal(posterior.simulate(start, [0, 0.1]).q, expected)
    assert gp2.simulate(arm, {"shoulder": np.float64(0.9)}, [0, 0.1]).q[0, 0] == 0.9


def test_a_system_that_a_file_does_not_need_is_refused(arm, arm_fit_file):
    for call in (gp2.load, gp2.Posterior.load, gp2.fit_again):
        with pytest.raises(gp2.InputError, match="^system: it has no functions, .* to predict under another system, give it to predict"):
            call(arm_fit_file, system=arm)


@pytest.mark.parametrize(
    ("start", "times", "error", "text"),
    [
        ({"wrist": 1}, [0, 1], gp2.InputError, "start: 'wrist' is no coordinate or velocity of 'two-link arm on a moving plane'"),
        ({"elbow": np.nan}, [0, 1], gp2.InputError, "start: elbow = nan is not a finite number"),
        ([0.9, 0, 0], [0, 1], gp2.InputError, "start: expected shape (4,), got (3,)"),
        (0.9, [0, 1], TypeError, "start: expected a dict of names to numbers, or all of q and dq, got 0.9"),
        ({"elbow": "x"}, [0, 1], TypeError, "start: expected a dict of names to numbers"),
        ({"shoulder": 0.9}, [], gp2.InputError, "times: expected the times [s]"),
        ({"shoulder": 0.9}, [0, 1j], TypeError, "times: expected an array of real numbers"),
        ({"shoulder": 0.9}, [[0, 1]], gp2.InputError, "times: expected shape (n,), got (1, 2)"),
        ({"shoulder": 0.9}, [0, np.nan], gp2.InputError, "a time is not a finite number"),
        ({"shoulder": 0.9}, [0, 0], gp2.InputError, "times must increase"),
    ],
)
def test_a_motion_that_cannot_start_says_why(start, times, error, text, posterior):
    with pytest.raises(error) as caught:
        posterior.simulate(start, times)
    assert text in str(caught.value)


def test_a_motion_has_its_energy_where_the_model_has_a_potential(oscillator):
    spring = gp2.System(coordinates=["x"], mass=[["2"]], force=["-3*x"], potential="1.5*x^2")
    motion = gp2.simulate(spring, [0.5, 0.3], np.linspace(0, 3, 7))
    np.testing.assert_allclose(motion.energy, (motion.dq**2 + 1.5 * motion.q**2)[:, 0], rtol=1e-12)
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=1e-5)
    assert motion.energy_std is None
    assert gp2.simulate(oscillator, [0.5, 0.3], [0, 1]).energy is None


@pytest.fixture
def ball():
    """Slides under dry friction and bounces."""
    return gp2.System(
        name="ball", coordinates=["x", "z"], inputs=["touch"], mass=[["1", "0"], ["0", "1"]], force=["-sign(dx)", "-9.81"],
        constraints={"position": [{"expr": "z", "contact": "touch", "restitution": 0.5}]},
    )  # fmt: skip


def test_a_motion_tells_of_contacts_and_friction_as_the_command_does(ball, command, tmp_path):
    start = {"x": 0.0, "dx": 0.5, "z": 1.0}
    motion = gp2.simulate(ball, start, np.linspace(0, 2, 100))
    first, last = motion.contact_events[0], motion.contact_events[-1]
    assert first["t"] == pytest.approx(np.sqrt(2 / 9.81), abs=1e-6) and first["approach"] == pytest.approx(np.sqrt(2 * 9.81), abs=1e-6)
    assert (first["contact"], first["kind"]) == ("z", "impact") and first["energy_loss"] == pytest.approx(0.75 * 9.81, abs=1e-5)
    assert last["kind"] == "made"
    (stick,) = motion.stick_events
    assert stick == {"t": pytest.approx(0.5, abs=1e-6), "surface": "dx", "kind": "sticks"}
    (tmp_path / "ball.toml").write_text(ball.text, encoding="utf-8")
    outcome = command("simulate", "ball.toml", "--start", "x=0,dx=0.5,z=1", "--t-end", 2, "--json", "-o", "motion.csv")
    report = json.loads(outcome.stdout)
    assert motion.contact_events == report["contact_events"] and motion.stick_events == report["stick_events"]
    assert gp2.simulate(ball, {"z": 1.0}, [0, 0.1]).contact_events == []


def test_a_motion_that_cannot_go_on_leaves_what_was_reached(oscillator):
    explodes = gp2.System(coordinates=["x"], mass=[["1"]], force=["x^3"], potential="-x^4/4")
    times = np.linspace(0, 20, 201)
    with pytest.raises(gp2.NumericalError, match="the step size fell to") as caught:
        gp2.simulate(explodes, {"x": 1.0, "dx": 1.0}, times)
    motion = caught.value.motion
    n = len(motion.t)
    assert 1.3 < motion.t[-1] < 1.4 and motion.q.shape == (n, 1) and len(motion.table) == len(motion.energy) == n
    np.testing.assert_array_equal(motion.t[:-1], times[: n - 1])

    posterior = gp2.fit(oscillator, oscillator.generate(20), mean="force", max_iterations=0)
    with pytest.raises(gp2.NumericalError, match="max_steps") as caught:
        posterior.simulate({"x": 0.5, "dx": 0.1}, times, max_steps=3)
    assert caught.value.motion.std.shape == caught.value.motion.q.shape
    with pytest.raises(gp2.NumericalError, match="^sample 0: .*max_steps") as caught:
        posterior.simulate({"x": 0.5, "dx": 0.1}, times, max_steps=3, n_samples=2)
    (motion,) = caught.value.motion
    assert motion.t[-1] < 20


def test_a_motion_starts_where_a_log_does(arm, posterior, tmp_path):
    log = arm.generate(3, seed=5)
    first = {name: log[name][0] for name in (*arm.coordinates, "dshoulder", "delbow")}
    times = log["t"][0] + np.array([0, 0.1])  # the constraint depends on time
    expected = posterior.simulate(first, times).q
    for start in (log, log.to_frame(), write_csv(tmp_path / "log.csv", log)):
        np.testing.assert_allclose(posterior.simulate(start, times).q, expected, rtol=0, atol=1e-9)
    renamed = log.to_frame().rename(columns={"elbow": "theta2"})
    moved = posterior.simulate(renamed, times, columns={"elbow": "theta2"})
    np.testing.assert_allclose(moved.q, expected, rtol=0, atol=1e-9)
    with pytest.raises(gp2.InputError, match="^start: x alone has none of the columns shoulder"):
        posterior.simulate(gp2.Table({"x": [1.0]}, name="x alone"), [0, 1])


def test_a_report_is_a_mapping_of_hyperparameters(posterior):
    report = posterior.report
    assert "m2" in report and "m7" not in report and 3 not in report
    assert list(report) == [h.name for h in report.hyperparameters]
    assert {name: report[name] for name in report}["m2"] == posterior.parameters["m2"]
    with pytest.raises(KeyError, match="no hyperparameter 'm7'; there are: "):
        report["m7"]


def test_a_whole_start_off_the_constraints_is_warned_of(posterior):
    with pytest.warns(UserWarning, match="start: what is given leaves no solution of the constraints"):
        posterior.simulate([0.9, 0.5, 1, 1], [0, 0.01])


def test_a_seed_goes_with_samples(posterior):
    with pytest.raises(gp2.InputError, match="^seed: goes with n_samples, without which it means nothing"):
        posterior.simulate({"shoulder": 0.9}, [0, 0.1], seed=1)


# ---------------------------------------------------------------- systems


def test_a_system_of_strings_is_that_of_the_file_it_stands_for(arm):
    again = gp2.System.parse(arm.text)
    assert again.text == arm.text
    built = gp2.System(
        name="bead on a wire", coordinates=["x", "z"], inputs=["push"],
        parameters={"m": 0.2, "h": {"value": 0.5, "bounds": [0.3, 0.7], "estimate": True}},
        mass=[["m", "0"], ["0", "m"]], force=["push", "-9.81*m"], constraints=["z - h*x^2"],
        latents=[{"features": ["x", "dx"]}], noise=0.05,
    )  # fmt: skip
    assert built.state_names == ["x", "z", "dx", "dz", "t", "push"]
    assert built.acceleration_names == ["ddx", "ddz"]
    assert built.constraints == ["z - h*x^2"]
    mechanics = built.evaluate([[0.5, 0.125, 2, 1, 0, 3]], {"h": 0.6})
    np.testing.assert_allclose(mechanics.M, [[[0.2, 0], [0, 0.2]]])
    np.testing.assert_allclose(mechanics.A, [[[-2 * 0.6 * 0.5, 1]]])
    np.testing.assert_allclose(mechanics.b, [[2 * 0.6 * 2**2]])
    np.testing.assert_allclose(mechanics.F, [[3, -9.81 * 0.2]])
    parsed = gp2.System.parse(built.text)
    np.testing.assert_array_equal(parsed.evaluate([[0.5, 0.125, 2, 1, 0, 3]]).b, built.evaluate([[0.5, 0.125, 2, 1, 0, 3]]).b)


def test_true_accelerations_are_those_of_generated_data_without_noise(arm):
    data = arm.generate(6, seed=2, noise_std=0)
    np.testing.assert_array_equal(arm.true_acceleration(arm.states(data)), np.column_stack([data["ddshoulder"], data["ddelbow"]]))


def test_a_check_finds_what_is_wrong(arm, arm_log):
    assert {finding.level for finding in gp2.check(arm, arm_log)} <= {"ok", "warning"}
    off = columns_of(arm_log)
    off["elbow"] = off["elbow"] + 0.1
    levels = [finding.level for finding in gp2.check(arm, off)]
    assert set(levels) & {"warning", "error"}
    assert all(finding.text in repr(finding) for finding in gp2.check(arm))


def test_the_blas_in_use_is_told():
    report = gp2.blas_report()
    assert set(report) == {"library", "kernel", "threads", "fastest_kernel", "advice"}
    assert report["library"]
    assert report["threads"] >= 1


def test_a_fit_through_inducing_points_says_what_they_leave_out(arm, arm_log):
    told = gp2.fit(arm, arm_log, inducing=20, restarts=1, max_iterations=2).report.inducing
    assert 0 < told["n_variables"] <= 20
    assert told["left_out"].ndim == 1 and (told["left_out"] >= 0).all()
    assert told["n_start"] >= 0
