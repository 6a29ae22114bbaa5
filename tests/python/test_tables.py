"""Logs go by the names of their columns: paths, tables, pandas frames, mappings."""

import logging
import pickle

import numpy as np
import pandas as pd
import pytest

import gp2
from conftest import columns_of, write_csv


@pytest.fixture
def frame(arm_log):
    return pd.DataFrame(columns_of(arm_log))


def cov_of(system, data, states, **options):
    return gp2.fit(system, data, max_iterations=0, **options).predict(states).cov


def test_every_kind_of_table_is_the_same_log(arm, arm_log, arm_states, frame, tmp_path):
    expected = cov_of(arm, arm_log, arm_states)
    path = write_csv(tmp_path / "log.csv", arm_log)
    shuffled = frame[reversed(frame.columns)].assign(comment="text that nobody reads")
    for what, data in {
        "frame": frame,
        "frame with another order and more columns": shuffled,
        "frame with another index": frame.set_index(np.arange(len(frame)) * 7),
        "mapping of arrays": columns_of(arm_log),
        "mapping of lists": {name: values.tolist() for name, values in columns_of(arm_log).items()},
        "path": path,
        "text of a path": str(path),
        "table of a path": gp2.read_csv(path),
        "table of a frame": gp2.Table(frame),
        "list of one": [frame],
        "Log": gp2.Log(frame),
    }.items():
        np.testing.assert_array_equal(cov_of(arm, data, arm_states), expected, err_msg=what)


def test_what_is_masked_is_missing(arm, arm_log, arm_states):
    columns = columns_of(arm_log)
    name = arm.acceleration_names[0]
    missing, masked = dict(columns), dict(columns)
    missing[name] = np.where(np.arange(len(columns[name])) < 3, np.nan, columns[name])
    masked[name] = np.ma.masked_array(np.where(np.isnan(missing[name]), 1e20, columns[name]), mask=np.isnan(missing[name]))
    np.testing.assert_array_equal(cov_of(arm, masked, arm_states), cov_of(arm, missing, arm_states))
    rows = np.ma.masked_array(arm_states, mask=np.zeros(arm_states.shape, bool))
    fitted = gp2.fit(arm, missing, max_iterations=0)
    np.testing.assert_array_equal(fitted.predict(rows).mean, fitted.predict(arm_states).mean)
    rows[0, 0] = np.ma.masked
    with pytest.raises(gp2.InputError, match="nan is not a finite number"):
        fitted.predict(rows)


def test_states_are_found_by_name(posterior, arm, frame):
    expected = posterior.predict(arm.states(frame)).mean
    np.testing.assert_array_equal(posterior.predict(frame).mean, expected)
    np.testing.assert_array_equal(posterior.predict(frame[reversed(frame.columns)]).mean, expected)


def test_columns_of_other_names_are_found_by_alias(posterior, arm, frame):
    renamed = frame.rename(columns={"shoulder": "theta1", "dshoulder": "dtheta1", "ddshoulder": "ddtheta1"})
    alias = {"shoulder": "theta1"}
    expected = posterior.predict(frame).mean
    np.testing.assert_array_equal(posterior.predict(renamed, columns=alias).mean, expected)
    np.testing.assert_array_equal(arm.states(renamed, columns=alias), arm.states(frame))
    with pytest.raises(gp2.InputError, match="shoulder"):
        posterior.predict(renamed)
    with pytest.raises(TypeError, match="columns: expected a dict of the model's names to the log's, got 3"):
        posterior.predict(frame, columns=3)


def test_several_logs_are_learnt_from_together(arm, frame, arm_states):
    first, second = frame[:12], frame[12:]
    both = gp2.fit(arm, [first, second], max_iterations=0)
    assert both.n_data == len(frame)
    expected = both.predict(arm_states)
    np.testing.assert_array_equal(cov_of(arm, [gp2.Log(first), gp2.Table(second)], arm_states), expected.cov)

    faster = gp2.System.parse(arm.text.replace("w  = 4.0", "w  = 5.0"))
    with pytest.warns(UserWarning, match="off the constraint"):
        elsewhere = gp2.fit(arm, [first, gp2.Log(second, system=faster)], max_iterations=0)
    assert (elsewhere.predict(arm_states).mean != expected.mean).any()


def test_other_quantities_are_learnt_from_too(arm, frame, arm_states):
    rest = {name: np.array([value]) for name, value in frame.iloc[0].items()}
    rest |= {"abar_shoulder": np.array([0.5]), "abar_elbow": np.array([-0.5])}
    also = [gp2.SideInformation("unconstrained", rest)]
    posterior = gp2.fit(arm, frame, also=also, also_noise_std=1e-3, max_iterations=0)
    assert posterior.n_data == len(frame) + 1
    without = gp2.fit(arm, frame, max_iterations=0)
    error, error_without = (p.predict(frame[:1], "unconstrained").mean - [0.5, -0.5] for p in (posterior, without))
    assert np.abs(error).max() < 0.02 < np.abs(error_without).max()
    with pytest.raises(gp2.InputError, match="view: expected one of"):
        gp2.fit(arm, frame, also=[gp2.SideInformation("position", rest)])


def test_what_is_known_can_be_learnt_from_alone(arm, frame, arm_states):
    rest = {name: np.array([value]) for name, value in frame.iloc[0].items()}
    rest |= {"abar_shoulder": np.array([0.5]), "abar_elbow": np.array([-0.5])}
    also = [gp2.SideInformation("unconstrained", rest)]
    posterior = gp2.fit(arm, [], also=also, also_noise_std=1e-3, max_iterations=0)
    assert posterior.n_data == 1
    assert np.abs(posterior.predict(frame[:1], "unconstrained").mean - [0.5, -0.5]).max() < 0.02
    with pytest.raises(gp2.InputError, match="there is nothing to fit: give logs with data, or other knowledge with also"):
        gp2.fit(arm, [])


def test_a_table_is_a_mapping_of_names_to_arrays(arm_log):
    assert len(arm_log) == 30
    assert arm_log.keys() == arm_log.columns == list(arm_log) == list(dict(arm_log))
    assert "elbow" in arm_log
    assert "wrist" not in arm_log and 3 not in arm_log
    assert arm_log["elbow"].shape == (30,)
    assert "30 rows of shoulder, elbow" in repr(arm_log)
    with pytest.raises(KeyError, match="no column 'wrist'; it has: shoulder"):
        arm_log["wrist"]
    with pytest.raises(ValueError, match="read-only"):  # it would be lost
        arm_log["elbow"][5] = np.nan
    back = pd.DataFrame(columns_of(arm_log))
    np.testing.assert_array_equal(back["elbow"], arm_log["elbow"])


def test_a_table_has_its_own_name_or_the_one_that_is_given(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("x,said,mixed\n\n1,yes,1\n2,no,x\n", encoding="utf-8")
    columns = {"x": [1.0, 2.0], "said": ["yes", "no"], "mixed": ["1", "x"]}
    assert gp2.Table(columns).name == "data" and gp2.Table(columns, name="monday").name == "monday"
    assert gp2.Table(path).name == str(path)
    for table, place in [(gp2.Table(path, name="monday"), ":4: "), (gp2.Table(gp2.Table(columns), name="monday"), ": row 2, ")]:
        assert table.name == "monday" and list(table["x"]) == [1, 2]
        assert list(table["said"]) == ["yes", "no"]
        with pytest.raises(gp2.InputError, match=f"^monday{place}column 'mixed': 'x' is not a finite number"):
            table["mixed"]
    assert list(gp2.Table({"touch": np.array([True, False])})["touch"]) == [1, 0]
    assert gp2.Table(gp2.Table(columns, name="monday")).name == "monday"


def test_rows_of_what_is_no_file_are_counted_from_1(arm, frame, posterior):
    frame.loc[3, "ddelbow"] = np.inf
    for table in (frame, pickle.loads(pickle.dumps(gp2.Table(frame)))):
        for call in (lambda: gp2.fit(arm, table), lambda: posterior.evaluate(table), lambda: gp2.Table(table)["ddelbow"]):
            with pytest.raises(gp2.InputError, match="^data: row 4, column 'ddelbow': 'inf' is not a finite number$"):
                call()


@pytest.mark.parametrize(("change", "first"), [(lambda name: ("log", name), "('log', 'shoulder')"), (str.encode, "b'shoulder'")])
def test_names_of_columns_are_text(change, first, arm, frame, posterior):
    states, ddq = frame[arm.state_names], frame[arm.acceleration_names]
    odd = frame.set_axis(pd.Index([change(name) for name in frame.columns], tupleize_cols=False), axis=1)
    states = odd.iloc[:, : len(arm.state_names)]
    for name, call in {
        "data": lambda: gp2.fit(arm, odd),
        "states": lambda: posterior.predict(odd),
        "state": lambda: gp2.Predictor(posterior).mean(states.iloc[0]),
    }.items():
        with pytest.raises(gp2.InputError) as caught:
            call()
        assert str(caught.value) == f"{name}: column names must be text, got {first}"
    with pytest.raises(gp2.InputError, match="^states: column names must be text"):
        gp2.fit(arm, (states, ddq))
    with pytest.raises(gp2.InputError, match="^data: column names must be text, got 3$"):
        gp2.Table({"x": [1.0], 3: [2.0]})
    numbered = frame[arm.state_names].set_axis(range(len(arm.state_names)), axis=1)  # are positions
    np.testing.assert_array_equal(posterior.predict(numbered).mean, posterior.predict(frame).mean)


def test_numbers_go_through_a_table_unchanged():
    values = np.array([0.1, 1 / 3, 5e-324, -1.7976931348623157e308, 2**53 + 2])
    np.testing.assert_array_equal(gp2.Table({"x": values})["x"], values)
    np.testing.assert_array_equal(gp2.Table({"x": np.arange(3, dtype=np.int8)})["x"], [0, 1, 2])
    np.testing.assert_array_equal(gp2.Table({"x": values[::2]})["x"], values[::2])


@pytest.mark.parametrize(
    ("columns", "error", "text"),
    [
        ({"x": [1, 2], "y": [1]}, gp2.InputError, "data: the columns differ in length: 'x' has 2, 'y' has 1"),
        ({"x": [[1, 2], [3, 4]]}, gp2.InputError, "data['x']: expected one-dimensional"),
        (3, TypeError, "data: expected a gp2.Table, the path of a CSV file, a frame of pandas or polars, a structured array, or a mapping"),
        (np.zeros((2, 2)), TypeError, "got <class 'numpy.ndarray'>"),
    ],
)
def test_what_is_no_table_is_refused(columns, error, text):
    with pytest.raises(error) as caught:
        gp2.Table(columns)
    assert text in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, "abc", None, True, 1j, pd.NA])
def test_cells_that_are_no_number_are_refused_when_they_are_used(value, posterior, frame):
    frame = frame.astype({"elbow": object})
    frame.loc[4, "elbow"] = value
    with pytest.raises(gp2.InputError, match="elbow"):
        posterior.predict(frame)
    frame.insert(0, "unread", [value] * len(frame))
    with pytest.raises(gp2.InputError, match="elbow"):
        posterior.predict(frame)


def test_a_state_without_prediction_is_named_with_its_table(tmp_path):
    system = gp2.System(
        coordinates=["x"], mass=[["x"]], latents=[{"features": ["dx"]}], noise=0.1, truth=["dx"],
        sampling={"x": [1, 2], "dx": [-1, 1]},
    )  # fmt: skip
    posterior = gp2.fit(system, system.generate(5), max_iterations=0)
    path = write_csv(tmp_path / "bad.csv", {"x": np.array([1.0, -1.0]), "dx": np.zeros(2), "ddx": np.zeros(2)})
    for call in (posterior.predict, posterior.joint, posterior.sample, posterior.evaluate):
        with pytest.raises(gp2.InputError, match=r"bad\.csv: system .* at state 2"):
            call(path)


def test_a_path_may_be_bytes_and_hold_any_character(arm_log, tmp_path):
    path = write_csv(tmp_path / "Größe ü.csv", arm_log)
    for name in (path, str(path), str(path).encode()):
        assert len(gp2.read_csv(name)) == 30
    with pytest.raises(gp2.InputError, match="missing.csv"):
        gp2.read_csv(tmp_path / "missing.csv")
    with pytest.raises(TypeError):
        gp2.read_csv(3)


def test_deviations_in_a_table_are_the_noise_of_its_values(arm, frame, arm_log, arm_states):
    names = arm.acceleration_names
    stated = frame.assign(**{name + "_std": 0.2 for name in names})
    expected = gp2.fit(arm, frame, max_iterations=0, noise_std=0.2, discrepancy=False)
    got = gp2.fit(arm, stated, max_iterations=0, discrepancy=False)
    np.testing.assert_allclose(got.predict(arm_states).mean, expected.predict(arm_states).mean, rtol=1e-9, atol=1e-9)
    got.update(stated.head(1))
    expected.update(frame.head(1))
    np.testing.assert_allclose(got.predict(arm_states).mean, expected.predict(arm_states).mean, rtol=1e-9, atol=1e-9)
    with pytest.raises(gp2.InputError, match=f"each value of {names[0]} in the fit has its own noise"):
        got.update(frame.head(1))
    got.update(frame.head(1), noise_std=0.2)


def test_resampled_rows_are_rows_of_the_table(arm, frame, caplog):
    some = gp2.resample(arm, frame, 4)
    assert some.columns == list(frame.columns)
    first = frame.columns[0]
    assert set(some[first]) <= set(frame[first]) and len(some[first]) == 4
    np.testing.assert_array_equal(gp2.resample(arm, frame, 3)[first], some[first][:3])
    gaps = frame.assign(elbow=np.where(np.arange(len(frame)) < 2, np.nan, frame["elbow"]))
    with caplog.at_level(logging.INFO, logger="gp2"):
        assert len(gp2.resample(arm, gaps, 4, features=["elbow"])) == 4
    assert "data: 2 rows skipped" in caplog.text
    assert "distances are in sin(elbow), cos(elbow), each divided by its standard deviation" in caplog.text
    assert f"chosen: 4 of {len(frame)} rows; every other row is within " in caplog.text and "repeat" not in caplog.text
    with caplog.at_level(logging.INFO, logger="gp2"):
        gp2.resample(arm, pd.concat([frame, frame]), len(frame) + 3)
    assert "the last 3 rows repeat those before them in every feature" in caplog.text
    with pytest.raises(gp2.InputError, match="fewer than the n = 1000"):
        gp2.resample(arm, frame, 1000, seed=1, features=[first])


@pytest.mark.parametrize("gap", [np.nan, None, pd.NA])
def test_an_empty_cell_of_an_acceleration_is_not_measured(gap, arm, arm_log, tmp_path):
    frame = pd.DataFrame(columns_of(arm_log))
    whole = gp2.fit(arm, frame, max_iterations=0)
    frame = frame.astype({"ddelbow": object})
    frame.loc[4, "ddelbow"] = gap
    fitted = gp2.fit(arm, frame, max_iterations=0)
    assert fitted.n_data == len(frame)
    assert fitted.negative_log_likelihood != whole.negative_log_likelihood
    assert np.isnan(gp2.Table(frame)["ddelbow"][4])
    assert fitted.evaluate(frame).n_missing == 1
    fitted.save(tmp_path / "fit.json")
    assert gp2.load(tmp_path / "fit.json").negative_log_likelihood == fitted.negative_log_likelihood


def test_an_acceleration_that_is_measured_nowhere_is_not_compared(posterior, arm_log, caplog):
    log = columns_of(arm_log)
    log["ddelbow"][:] = np.nan
    for compared in (
        lambda: posterior.evaluate(log).outputs,
        lambda: gp2._gp2._compared(posterior, log, None, None)["outputs"],
        lambda: gp2.report(posterior, data=log) and ["ddshoulder"],
    ):
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="gp2"):
            assert compared() == ["ddshoulder"]
        assert "data: not compared: ddelbow, which it lacks" in caplog.text
    log["ddshoulder"][:] = np.nan
    mend = "choose others with observe of a fit, outputs of an evaluation$"
    for outputs in (None, ["ddelbow"]):
        with pytest.raises(gp2.InputError, match="every cell is empty, so nothing is measured there; " + mend):
            posterior.evaluate(log, outputs=outputs)


def test_a_robust_fit_lists_what_it_distrusts(arm, arm_log):
    log = columns_of(arm_log)
    log["ddelbow"][7] += 100 * np.std(log["ddelbow"])
    fitted = gp2.fit(arm, log, robust=True, restarts=1)
    worst = fitted.report.distrusted[0]
    assert worst["state"] == 7
    assert worst["distance"] > 4
    assert not gp2.fit(arm, log, max_iterations=0).report.distrusted
    # the log states no noise, and more of it needs none
    n = fitted.n_data
    fitted.update({name: values[:3] for name, values in columns_of(arm_log).items()})
    assert fitted.n_data == n + 3


def test_states_are_projected_before_the_fit_where_asked_for(arm, arm_log):
    log = columns_of(arm_log)
    log["elbow"] = log["elbow"] + 1e-3
    assert any("off the position constraint" in finding.text for finding in gp2.check(arm, log))
    projected = gp2.fit(arm, log, project=True, max_iterations=0)
    assert any("states projected onto the constraints" in note for note in projected.notes)
    assert projected.negative_log_likelihood != gp2.fit(arm, log, max_iterations=0).negative_log_likelihood


def test_results_are_pandas_frames(arm, arm_log, arm_fit_file, arm_states):
    log = arm_log.to_frame()
    assert list(log.columns) == arm_log.columns and np.array_equal(log["t"], arm_log["t"])
    posterior = gp2.load(arm_fit_file)
    prediction = posterior.predict(arm_states)
    frame = prediction.to_frame()
    assert list(frame.columns) == [*prediction.names, *(f"{name}_std" for name in prediction.names), "distance_from_data"]
    assert np.array_equal(frame[prediction.names], prediction.mean)
    assert np.array_equal(frame[f"{prediction.names[0]}_std"], prediction.std[:, 0])
    mean = posterior.predict(arm_states, mean_only=True)
    assert list(mean.to_frame().columns) == [*mean.names, "distance_from_data"]
    start = arm_states[0, :4]
    motion = posterior.simulate(start, np.linspace(0, 0.1, 3))
    frame = motion.to_frame()
    assert np.array_equal(frame[arm.coordinates], motion.q) and np.array_equal(frame["t"], motion.t)
    assert np.array_equal(frame[[f"{name}_std" for name in arm.acceleration_names]], motion.std)
    # a motion is a log, whose deviations are not those of a measurement
    assert list(motion.table.columns) == [c for c in frame.columns if not c.endswith("_std") and c != "distance_from_data"]
    assert list(gp2.simulate(arm, start, [0, 0.1]).to_frame().columns) == motion.table.columns


def test_what_is_masked_is_missing_whatever_the_column_holds():
    for values in ([1.0, 2.0], ["1", "2"], [1, "2"]):
        masked = np.ma.array(np.array(values, dtype=object if values == [1, "2"] else None), mask=[True, False])
        np.testing.assert_array_equal(gp2.Table({"x": masked})["x"], [np.nan, 2.0])


def test_a_log_of_another_system_may_be_arrays(arm, arm_log, arm_states):
    heavy = gp2.System.parse(arm.text.replace("# ", "# heavy "), arm.name)
    arrays = arm.states(arm_log), np.column_stack([arm_log[name] for name in arm.acceleration_names])
    expected = gp2.fit(arm, [gp2.Log(arm_log, heavy)], max_iterations=0).predict(arm_states)
    for data in (gp2.Log(arrays, heavy), [gp2.Log(arrays, heavy)]):
        got = gp2.fit(arm, data, max_iterations=0).predict(arm_states)
        np.testing.assert_allclose(got.mean, expected.mean, rtol=1e-9, atol=1e-9 * np.abs(expected.mean).max())
    with pytest.raises(TypeError, match=r"^data\[0\]: expected a gp2.Table"):
        gp2.fit(arm, [gp2.Log([arm_log], heavy)])


def test_columns_of_an_array_have_no_names(arm, arm_log, posterior):
    states = arm.states(arm_log)
    accelerations = np.column_stack([arm_log[name] for name in arm.acceleration_names])
    for call in (
        lambda **columns: posterior.predict(states, **columns),
        lambda **columns: posterior.joint(states[:2], **columns),
        lambda **columns: posterior.inverse_dynamics(states, accelerations, **columns),
    ):
        with pytest.raises(gp2.InputError, match="^columns: renames columns of a table, but states are an array"):
            call(columns={"elbow": "theta2"})


class Polars:
    """What a frame of polars shows of itself: columns by name, a shape, no keys."""

    def __init__(self, columns):
        self._columns = columns

    columns = property(lambda self: list(self._columns))
    shape = property(lambda self: (len(next(iter(self._columns.values()))), len(self._columns)))

    def __getitem__(self, name):
        return self._columns[name]


def test_a_table_is_what_has_named_columns(arm, arm_log, arm_fit_file):
    columns = {name: np.asarray(values) for name, values in columns_of(arm_log).items()}
    shuffled = dict(reversed(columns.items()))  # found by their names, wherever they stand
    structured = np.rec.fromarrays(list(shuffled.values()), names=",".join(shuffled))
    matlab = {"__header__": b"MATLAB 5.0", "__version__": "1.0", "__globals__": [],
              **{name: values[None, :] for name, values in columns.items()}}
    posterior = gp2.load(arm_fit_file)
    expected = posterior.predict(columns).mean
    struct = np.empty((1, 1), dtype=[(name, object) for name in columns])  # of MATLAB's
    for name, values in columns.items():
        struct[name][0, 0] = values[:, None]
    for table in (structured, np.asarray(structured), matlab, struct, Polars(shuffled)):
        assert sorted(gp2.Table(table).columns) == sorted(columns)
        np.testing.assert_array_equal(posterior.predict(table).mean, expected)
        np.testing.assert_array_equal(arm.states(table), arm.states(columns))


class Arrow(Polars):
    """What a table of Arrow shows of itself: names apart from columns, and an array of all in its own order."""

    column_names = property(lambda self: list(self._columns))
    columns = property(lambda self: list(self._columns.values()))

    def __array__(self, *_, **__):
        return np.column_stack(self.columns)


def test_a_table_of_arrow_goes_by_name_though_it_is_an_array_too(arm, arm_log, posterior):
    columns = columns_of(arm_log)
    backwards = Arrow({name: columns[name] for name in reversed(arm.state_names)})
    assert gp2.Table(backwards).columns == arm.state_names[::-1]
    np.testing.assert_array_equal(posterior.predict(backwards).mean, posterior.predict(columns).mean)
    np.testing.assert_array_equal(arm.evaluate(backwards).A, arm.evaluate(columns).A)


def test_what_only_looks_like_a_table_is_none():
    assert gp2.Table(np.rec.fromarrays([[1.0], [2.0]], names="keys,x")).columns == ["keys", "x"]
    with pytest.raises(TypeError, match="expected a gp2.Table"):
        gp2.Table(Polars({3: [1.0]}))  # of columns without names


def test_notebooks_show_systems_and_fits(arm, arm_fit_file):
    assert arm._repr_html_().startswith("<pre>") and "mass matrix M" in arm._repr_html_()
    assert "learned from 30 states" in gp2.load(arm_fit_file)._repr_html_()


def test_frames_of_states_and_accelerations_go_by_name_wherever_they_are_taken(arm, frame, arm_states):
    states, ddq = frame[arm.state_names], frame[arm.acceleration_names]
    backwards = states[states.columns[::-1]], ddq[ddq.columns[::-1]]
    arrays = (states.to_numpy(), ddq.to_numpy())
    for pair in (backwards, tuple(part.to_dict("list") for part in backwards), tuple(part.to_records(index=False) for part in backwards)):
        np.testing.assert_array_equal(cov_of(arm, pair, arm_states), cov_of(arm, arrays, arm_states))
    posterior = gp2.fit(arm, arrays, max_iterations=0)
    for name in ("M", "A", "b", "F"):
        np.testing.assert_array_equal(getattr(arm.evaluate(backwards[0]), name), getattr(arm.evaluate(arrays[0]), name))
    np.testing.assert_array_equal(arm.true_acceleration(backwards[0]), arm.true_acceleration(arrays[0]))
    np.testing.assert_array_equal(posterior.inverse_dynamics(arrays[0], backwards[1]).inputs, posterior.inverse_dynamics(*arrays).inputs)
    of_one = gp2.Predictor(posterior), gp2.InverseDynamicsSolver(posterior)
    for state, wanted in ((backwards[0].iloc[0], backwards[1].iloc[0]), tuple(dict(part.iloc[0]) for part in backwards)):
        np.testing.assert_array_equal(of_one[0].mean(state), of_one[0].mean(arrays[0][0]))
        np.testing.assert_array_equal(of_one[1].inputs(state, wanted), of_one[1].inputs(arrays[0][0], arrays[1][0]))


def test_frames_of_states_and_accelerations_have_no_unknown_columns(arm, frame):
    states, ddq = frame[arm.state_names], frame[arm.acceleration_names]
    known = ", ".join(arm.state_names)
    with pytest.raises(gp2.InputError, match=f"^states: unknown column 'ddshoulder'; there may be: {known}$"):
        gp2.fit(arm, (frame, ddq))
    with pytest.raises(gp2.InputError, match="^accelerations: unknown column 'shoulder'"):
        gp2.fit(arm, (states, frame))
    with pytest.raises(gp2.InputError, match="missing column 'elbow'"):
        gp2.fit(arm, (states.drop(columns="elbow"), ddq))
    with pytest.raises(gp2.InputError, match="^state: unknown column 'wrist'"):
        gp2.Predictor(gp2.fit(arm, frame, max_iterations=0)).mean({"wrist": 1.0})


def test_a_column_that_stands_twice_is_named(arm, frame, posterior):
    twice = pd.concat([frame, frame[["elbow"]]], axis=1)
    states = twice[[*arm.state_names]]
    for name, call in {
        "data": lambda: gp2.fit(arm, twice),
        "states": lambda: posterior.predict(twice),
        "state": lambda: gp2.Predictor(posterior).mean(states.iloc[0]),
    }.items():
        with pytest.raises(gp2.InputError, match=f"^{name}: the column 'elbow' stands twice"):
            call()
    with pytest.raises(gp2.InputError, match="^states: the column 'elbow' stands twice"):
        gp2.fit(arm, (states, frame[arm.acceleration_names]))


@pytest.mark.parametrize("name", ["observe", "outputs"])
def test_an_empty_list_of_names_is_not_all_of_them(name, arm, frame, posterior):
    calls = {
        "observe": [lambda names: gp2.fit(arm, frame, observe=names, max_iterations=0), lambda names: posterior.update(frame, observe=names)],
        "outputs": [
            lambda names: posterior.evaluate(frame, outputs=names),
            lambda names: gp2.InverseDynamicsSolver(posterior, outputs=names),
            lambda names: posterior.inverse_dynamics(arm.states(frame), frame[arm.acceleration_names], outputs=names),
        ],
    }
    for call in calls[name]:
        with pytest.raises(gp2.InputError, match=rf"^{name}: expected at least one name, got \[\]; None stands for the default"):
            call([])
        with pytest.raises(TypeError, match=f"{name}: expected a list of names, got 3"):
            call(3)
        call(None)
