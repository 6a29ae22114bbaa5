"""Arrays go in and come out: shapes, types, orders, and whose memory it is."""

import gc
import re

import numpy as np
import pytest

import gp2


def refuses(call, error, *texts):
    with pytest.raises(error) as caught:
        call()
    for text in texts:
        assert text in str(caught.value)


# ---------------------------------------------------------------- what comes out


@pytest.mark.parametrize(
    ("view", "d"), [("constrained", 2), ("unconstrained", 2), ("constraint-force", 2), ("multipliers", 1), ("next-velocity", 2), ("force", 2)]
)
def test_shapes_are_the_same_for_every_view_even_with_one_row(view, d, posterior, arm_states):
    dt = 0.01 if view == "next-velocity" else None
    prediction = posterior.predict(arm_states, view, dt=dt)
    n = len(arm_states)
    assert prediction.mean.shape == (n, d)
    assert prediction.std.shape == (n, d)
    assert prediction.cov.shape == (n, d, d)
    assert len(prediction.names) == d
    np.testing.assert_array_equal(prediction.std, np.sqrt(np.diagonal(prediction.cov, axis1=1, axis2=2)))
    assert posterior.sample(arm_states, 3, view=view, dt=dt).shape == (3, n, d)
    mean, covariance = posterior.joint(arm_states, view, dt=dt)
    assert mean.shape == (n * d,)
    assert covariance.shape == (n * d, n * d)
    one = posterior.predict(arm_states[:1], view, dt=dt)
    assert one.mean.shape == (1, d)
    assert one.cov.shape == (1, d, d)


def test_one_coordinate_without_constraint_keeps_its_axes(oscillator):
    posterior = gp2.fit(oscillator, oscillator.generate(8), max_iterations=0)
    states = oscillator.states(oscillator.generate(3))
    prediction = posterior.predict(states)
    assert prediction.mean.shape == (3, 1)
    assert prediction.cov.shape == (3, 1, 1)
    mechanics = oscillator.evaluate(states)
    assert mechanics.M.shape == (3, 1, 1)
    assert mechanics.A.shape == (3, 0, 1)
    assert mechanics.b.shape == (3, 0)
    assert mechanics.F.shape == (3, 1)
    motion = posterior.simulate([0.5, 0], [0, 0.1])
    assert motion.q.shape == motion.dq.shape == motion.ddq.shape == motion.std.shape == (2, 1)
    refuses(lambda: posterior.predict(states, "multipliers"), gp2.InputError, "'multipliers'", "has no constraints")


def test_no_states_give_no_rows(posterior, arm, arm_states):
    none = arm_states[:0]
    prediction = posterior.predict(none)
    assert prediction.mean.shape == (0, 2)
    assert prediction.cov.shape == (0, 2, 2)
    assert posterior.predict(none, mean_only=True).mean.shape == (0, 2)
    assert posterior.sample(none, 2).shape == (2, 0, 2)
    assert posterior.joint(none)[1].shape == (0, 0)
    assert arm.evaluate(none).A.shape == (0, 1, 2)


def test_results_are_the_callers_own(posterior, arm_states):
    states = arm_states.copy()
    prediction = posterior.predict(states)
    mean, cov = prediction.mean, prediction.cov
    kept_mean, kept_cov = mean.copy(), cov.copy()
    del states, prediction
    posterior.remove_oldest(5)
    gc.collect()
    np.testing.assert_array_equal(mean, kept_mean)
    np.testing.assert_array_equal(cov, kept_cov)
    for array in (mean, cov):
        assert array.flags.writeable
        assert array.flags.c_contiguous
        assert array.dtype == np.float64
        array[:] = 0


def test_the_distance_from_the_data_is_that_of_the_predictor(posterior, arm_states):
    distance = posterior.predict(arm_states).distance_from_data
    assert distance.shape == (len(arm_states),)
    predictor = gp2.Predictor(posterior)
    np.testing.assert_allclose([predictor.distance_from_data(x) for x in arm_states], distance, rtol=1e-12)
    assert (posterior.predict(100 * arm_states).distance_from_data > gp2.FAR_FROM_DATA).all()
    with pytest.raises(gp2.InputError, match="^state: shoulder is nan, elbow is nan, .*; what is read must be finite"):
        predictor.distance_from_data(np.full(arm_states.shape[1], np.nan))


def test_two_predictions_share_no_memory(posterior, arm_states):
    first, second = posterior.predict(arm_states), posterior.predict(arm_states)
    first.mean[:] = np.nan
    assert np.isfinite(second.mean).all()
    assert not np.shares_memory(first.mean, arm_states)


def test_a_motion_and_mechanics_share_no_memory_with_what_they_come_from(posterior, arm, arm_states):
    motion = posterior.simulate({"shoulder": 0.9}, [0, 0.1])
    found = posterior.inverse_dynamics(arm_states, np.zeros((len(arm_states), 2)))
    for copied in (motion.t, motion.states, motion.q, motion.dq, motion.ddq, motion.std, motion.multipliers, found.inputs, found.cov):
        refuses(lambda copied=copied: copied.fill(np.nan), ValueError, "read-only")  # it would be lost
    mechanics = arm.evaluate(arm_states)
    kept = mechanics.A.copy()
    del arm_states
    np.testing.assert_array_equal(mechanics.A, kept)


def test_a_prediction_of_the_mean_only_has_no_spread(posterior, arm_states):
    mean_only = posterior.predict(arm_states, mean_only=True)
    np.testing.assert_array_equal(mean_only.mean, posterior.predict(arm_states).mean)
    refuses(lambda: mean_only.std, AttributeError, "mean_only=True")
    refuses(lambda: mean_only.cov, AttributeError, "mean_only=True")


# ---------------------------------------------------------------- what goes in


def same_bits(states):
    read_only = states.copy()
    read_only.flags.writeable = False
    shifted = np.frombuffer(b"x" + states.tobytes(), offset=1).reshape(states.shape)
    assert not shifted.flags.aligned
    wide = np.zeros((2 * len(states), 2 * states.shape[1]))
    wide[::2, ::2] = states
    return {
        "Fortran order": np.asfortranarray(states),
        "read-only": read_only,
        "at addresses of no double": shifted,
        "every second of every second": wide[::2, ::2],
        "reversed twice": np.ascontiguousarray(states[::-1, ::-1])[::-1, ::-1],
        "other byte order": states.astype(states.dtype.newbyteorder()),
        "longdouble": states.astype(np.longdouble),
        "list": states.tolist(),
        "tuple of rows": tuple(map(tuple, states)),
    }


def test_layout_and_container_do_not_matter(posterior, arm, arm_states):
    expected = posterior.predict(arm_states)
    for what, states in same_bits(arm_states).items():
        np.testing.assert_array_equal(posterior.predict(states).cov, expected.cov, err_msg=what)
        np.testing.assert_array_equal(arm.evaluate(states).A, arm.evaluate(arm_states).A, err_msg=what)


def test_narrower_numbers_are_widened(posterior, arm_states):
    for dtype in (np.float32, np.float16):
        narrow = arm_states.astype(dtype)
        np.testing.assert_array_equal(posterior.predict(narrow).mean, posterior.predict(narrow.astype(float)).mean)


def test_integers_are_numbers(oscillator):
    posterior = gp2.fit(oscillator, oscillator.generate(8), max_iterations=0)
    states = np.array([[1, -1, 0], [0, 2, 0]])
    for dtype in (np.int8, np.int64, np.uint16):
        whole = np.abs(states).astype(dtype)
        np.testing.assert_array_equal(posterior.predict(whole).mean, posterior.predict(whole.astype(float)).mean)


@pytest.mark.parametrize(
    ("change", "got"),
    [
        (lambda x: x.astype(complex), "dtype complex128"),
        (lambda x: x.astype(object), "dtype object"),
        (lambda x: x.astype(str), "dtype <U"),
        (lambda x: x > 0, "dtype bool"),
        (lambda x: x.astype("datetime64[s]"), "dtype datetime64[s]"),
    ],
)
def test_what_is_no_real_number_is_refused(change, got, posterior, arm, arm_states):
    for call in (posterior.predict, posterior.joint, posterior.sample, arm.evaluate):
        refuses(lambda call=call: call(change(arm_states)), TypeError, "states: expected an array of real numbers", got)


def test_shapes_that_do_not_fit_are_refused_with_the_names_of_the_columns(posterior, arm, arm_states):
    columns = "expected shape (n, 7), columns shoulder, elbow, dshoulder, delbow, t, tau1, tau2; got "
    for states, got in [
        (arm_states[:, :-1], "(7, 6)"),
        (arm_states[0], "(7,); of one row write array[None, :]"),
        (arm_states[:, 0][:3], "(3,)"),
        (arm_states[None], "(1, 7, 7)"),
        (np.float64(3), "()"),
        (np.zeros((0,)), "(0,)"),
        ([], "(0,)"),
    ]:
        refuses(lambda states=states: posterior.predict(states), gp2.InputError, "states: " + columns + got)
        refuses(lambda states=states: arm.evaluate(states), gp2.InputError, "states: " + columns + got)


def test_numbers_that_are_not_finite_are_refused_where_they_are_read(posterior, arm_states):
    for value in (np.nan, np.inf, -np.inf):
        states = arm_states.copy()
        states[4, 1] = value
        refuses(
            lambda states=states: posterior.predict(states), gp2.InputError,
            f"states: row 5, column 2 (elbow): {value} is not a finite number",
        )  # fmt: skip


def test_evaluate_refuses_a_state_without_what_the_equations_read():
    cart = gp2.System(coordinates=["x"], inputs=["u"], mass=[["1"]], force=["u"], latents=[{"features": ["dx"]}], noise=0.1)
    table = {"x": [0.0, 1.0], "dx": [2.0, 3.0]}
    refuses(lambda: cart.evaluate(table), gp2.InputError, "states: row 1 has no 'u', which M, A, b or F read")
    states = cart.states(table)
    assert np.isnan(states[:, 2:]).all()
    states[0, 3] = 5.0
    refuses(lambda: cart.evaluate(states), gp2.InputError, "states: row 2 has no 'u'")
    assert cart.evaluate(states[:1]).F == 5.0  # t is not read


def test_numbers_that_nothing_reads_may_be_anything(oscillator):
    posterior = gp2.fit(oscillator, oscillator.generate(8), max_iterations=0)
    states = np.array([[0.3, 0.1, np.nan]])  # neither the model nor its prior reads t
    assert np.isfinite(posterior.predict(states).mean).all()
    assert np.isfinite(gp2.Predictor(posterior).mean(states[0])).all()


def test_the_state_that_has_no_prediction_is_named_by_its_number_among_all():
    system = gp2.System(
        coordinates=["x"], mass=[["x"]], latents=[{"features": ["dx"]}], noise=0.1, sampling={"x": [1, 2], "dx": [-1, 1]},
        truth=["dx"],
    )  # fmt: skip
    posterior = gp2.fit(system, system.generate(5), max_iterations=0)
    states = np.ones((300_000, 3))  # more than are predicted between two looks for signals
    states[290_000, 0] = -1
    for mean_only in (True, False):
        refuses(lambda m=mean_only: posterior.predict(states, mean_only=m), gp2.InputError, "at state 290001 (x = -1")


def test_a_model_takes_arrays_of_names():
    system = gp2.System(
        coordinates=np.array(["x", "y"]), mass=np.eye(2), constraints=np.array(["x - y"]), latents=[{"features": ["dx"]}], noise=0.1
    )
    assert list(system.coordinates) == ["x", "y"] and system.evaluate(np.zeros((1, 5))).A.shape == (1, 1, 2)


def test_a_ragged_list_is_refused(posterior):
    refuses(lambda: posterior.predict([[1.0, 2.0], [3.0]]), TypeError, "states: expected an array of numbers, got <class 'list'>")


def test_the_predictor_takes_one_state(posterior, arm_states):
    predictor = gp2.Predictor(posterior)
    refuses(lambda: predictor.mean(arm_states), gp2.InputError, "state: expected shape (7,), got (7, 7)")
    refuses(lambda: predictor.mean(arm_states[0, :3]), gp2.InputError, "state: expected shape (7,), got (3,)")
    refuses(lambda: predictor.mean(arm_states[0] * 1j), TypeError, "state: expected an array of real numbers")
    refuses(lambda: predictor.mean(np.full(7, 1e300)), gp2.InputError, "state: a number that is read, or what the model makes of it")
    expected = predictor.mean(arm_states[0])
    for states in same_bits(arm_states).values():
        np.testing.assert_array_equal(predictor.mean(np.asarray(states)[0]), expected)
    np.testing.assert_array_equal(predictor.mean(arm_states[0].tolist()), expected)


def test_the_entry_of_a_state_that_is_missing_is_named(posterior, arm, arm_states):
    state = dict(zip(arm.state_names, arm_states[0])) | {"elbow": np.inf}
    del state["delbow"]
    solver = gp2.InverseDynamicsSolver(posterior)
    for call in (lambda: gp2.Predictor(posterior).mean(state), lambda: solver.inputs(state, np.zeros(2))):
        refuses(call, gp2.InputError, "state: elbow is inf, delbow is nan; what is read must be finite")
    refuses(
        lambda: solver.inputs(arm_states[0], {"ddelbow": 1.0}), gp2.InputError,
        "accelerations: ddshoulder is nan; what is read must be finite",
    )  # fmt: skip
    del state["tau1"], state["tau2"]
    state |= dict(zip(("elbow", "delbow"), arm_states[0][[1, 3]]))
    assert np.isfinite(solver.inputs(state, np.zeros(2))).all()  # the search begins at 0


def test_data_as_arrays_leave_out_what_is_not_measured(arm, arm_log):
    states, ddq = arm.states(arm_log), np.column_stack([arm_log[name] for name in arm.acceleration_names])
    from_arrays = gp2.fit(arm, (states, ddq), max_iterations=0)
    from_table = gp2.fit(arm, arm_log, max_iterations=0)
    np.testing.assert_array_equal(from_arrays.predict(states).cov, from_table.predict(states).cov)

    ddq[:, 1] = np.nan
    observed = gp2.fit(arm, (states, ddq), observe=["ddshoulder"], max_iterations=0)
    np.testing.assert_array_equal(
        observed.predict(states).cov, gp2.fit(arm, arm_log, observe=["ddshoulder"], max_iterations=0).predict(states).cov
    )
    ddq[3, 0] = np.nan
    gap = gp2.fit(arm, (states, ddq), observe=["ddshoulder"], max_iterations=0)
    rest = np.arange(len(states)) != 3
    without = gp2.fit(arm, (states[rest], ddq[rest]), observe=["ddshoulder"], max_iterations=0)
    assert gap.n_data == without.n_data == 29
    np.testing.assert_array_equal(gap.predict(states).cov, without.predict(states).cov)
    ddq[3, 0] = np.inf
    refuses(lambda: gp2.fit(arm, (states, ddq), observe=["ddshoulder"], max_iterations=0), gp2.InputError, "ddshoulder", "inf")
    refuses(lambda: gp2.fit(arm, (states,)), gp2.InputError, "data: expected (states, accelerations), got 1 arrays")
    refuses(lambda: gp2.fit(arm, (states, ddq[1:])), gp2.InputError, "data: 30 states, but 29 accelerations")
    refuses(lambda: gp2.fit(arm, (states, ddq.T)), gp2.InputError, "accelerations: expected shape (n, 2)")


# ---------------------------------------------------------------- no copies


def test_large_arrays_of_doubles_are_looked_at_in_place(oscillator):
    posterior = gp2.fit(oscillator, oscillator.generate(4), max_iterations=0)
    n = 2_000_000
    states = np.tile([0.5, -0.25, 0.0], (n, 1))  # 48 MB
    posterior.predict(states[:10000], mean_only=True)

    def peak():  # kB
        with open("/proc/self/status", encoding="ascii") as status:
            return int(re.search(r"VmHWM:\s+(\d+)", status.read())[1])

    before = peak()
    mean = posterior.predict(states, mean_only=True).mean
    grown = 1024 * (peak() - before)
    assert mean.shape == (n, 1)
    assert grown < mean.nbytes + 0.25 * states.nbytes  # a copy would add another states.nbytes
