"""gp2.sklearn: the checks that scikit-learn has for its own estimators, and what they cannot bring: states of a machine."""

import contextlib
import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.compose import ColumnTransformer
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, StandardScaler
from sklearn.utils.estimator_checks import check_estimator, parametrize_with_checks

import gp2
from gp2.sklearn import GP2Regressor

WIRE = gp2.System(
    name="bead on a wire",
    coordinates=["x", "z"],
    inputs=["push"],
    parameters={"m": 0.2, "h": {"value": 0.5, "bounds": [0.3, 0.7]}},
    mass=[["m", "0"], ["0", "m"]],
    force=["push", "-9.81*m"],
    constraints=["z - h*x^2"],
    latents=[{"features": ["x", "dx", "dz", "push"]}],
    noise=0.05,
    truth=["-0.8*dx - 0.3*tanh(10*dx)", "-0.8*dz"],
    sampling={"x": [-1, 1], "dx": [-1.5, 1.5], "push": [-1, 1]},
)

OWN_WIDTH = "brings X of its own width; the columns of X are those of the system's states"

# Checks that GP2Regressor(system) cannot pass. GP2Regressor(), without a system, passes all.
CANNOT_APPLY = {
    name: OWN_WIDTH
    for name in [
        "check_dict_unchanged",
        "check_dont_overwrite_parameters",
        "check_dtype_object",
        "check_estimators_dtypes",
        "check_estimators_fit_returns_self",
        "check_estimators_nan_inf",
        "check_estimators_overwrite_params",
        "check_estimators_pickle",
        "check_fit2d_predict1d",
        "check_fit_check_is_fitted",
        "check_fit_idempotent",
        "check_fit_score_takes_y",
        "check_methods_sample_order_invariance",
        "check_methods_subset_invariance",
        "check_n_features_in",
        "check_pipeline_consistency",
        "check_regressor_data_not_an_array",
        "check_regressor_multioutput",
        "check_regressors_int",
        "check_regressors_no_decision_function",
        "check_regressors_train",
        "check_supervised_y_2d",
    ]
}


def states_and_accelerations(n, seed, noise_std=None):
    data = WIRE.generate(n, seed=seed, noise_std=noise_std)
    X = np.zeros((n, len(WIRE.state_names)))
    for k, name in enumerate(WIRE.state_names):
        if name in data:
            X[:, k] = data[name]
    return X, np.column_stack([data[name] for name in WIRE.acceleration_names])


@pytest.fixture(scope="module")
def data():
    return states_and_accelerations(40, seed=1)


@pytest.fixture(scope="module")
def test_data():
    return states_and_accelerations(60, seed=2, noise_std=0)


@pytest.fixture(scope="module")
def model(data):
    return GP2Regressor(WIRE, mean="force", n_restarts=2).fit(*data)


# ---------------------------------------------------------------- scikit-learn's own checks


@parametrize_with_checks([GP2Regressor(n_restarts=1)])
def test_without_a_system_every_check_passes(estimator, check):
    check(estimator)


def checks(system):
    for estimator, check in check_estimator(GP2Regressor(system), generate_only=True):
        arguments = "".join(f" {key}={value}" for key, value in check.keywords.items())
        yield pytest.param(estimator, check, id=check.func.__name__ + arguments)


@pytest.mark.parametrize(("estimator", "check"), checks(WIRE))
def test_with_a_system_a_check_passes_unless_it_is_listed(estimator, check):
    if check.func.__name__ not in CANNOT_APPLY:
        check(estimator)
        return
    with pytest.raises(gp2.InputError, match=r"^X: expected 6 columns, x, z, dx, dz, t, push; got \d+ feature"):
        check(estimator)


def test_the_list_names_existing_checks_only():
    assert set(CANNOT_APPLY) <= {check.func.__name__ for _, check in check_estimator(GP2Regressor(), generate_only=True)}


# ---------------------------------------------------------------- a machine


def test_predictions_are_those_of_the_posterior_and_obey_the_constraint(model, test_data):
    X, y = test_data
    mean, std = model.predict(X, return_std=True)
    prediction = model.posterior_.predict(X)
    assert np.array_equal(mean, prediction.mean) and np.array_equal(std, prediction.std)
    mechanics = WIRE.evaluate(X)
    assert np.abs(np.einsum("nij,nj->ni", mechanics.A, mean) - mechanics.b).max() < 1e-13
    assert model.score(X, y) > 0.99
    assert model.log_marginal_likelihood_value_ == -model.posterior_.report.negative_log_likelihood
    assert model.n_features_in_ == 6 and model.outputs_ == ["ddx", "ddz"]


def test_covariances_have_the_shapes_of_scikit_learn_and_the_diagonal_of_the_variances(model, test_data):
    X = test_data[0][:7]
    mean, cov = model.predict(X, return_cov=True)
    std = model.predict(X, return_std=True)[1]
    assert mean.shape == (7, 2) and cov.shape == (7, 7, 2)
    np.testing.assert_allclose(np.einsum("iij->ij", cov), std**2, rtol=1e-9, atol=1e-14)
    joint = model.posterior_.joint(X)[1]
    np.testing.assert_array_equal(cov[..., 1], joint[1::2, 1::2])
    with pytest.raises(ValueError, match="at most one of them"):
        model.predict(X, return_std=True, return_cov=True)


def test_samples_obey_the_constraint_and_repeat_with_their_seed(model, test_data):
    X = test_data[0][:5]
    samples = model.sample_y(X, 3, random_state=7)
    assert samples.shape == (5, 2, 3)
    mechanics = WIRE.evaluate(X)
    assert np.abs(np.einsum("nij,njs->nis", mechanics.A, samples) - mechanics.b[:, :, None]).max() < 1e-13
    assert np.array_equal(samples, model.sample_y(X, 3, random_state=7))
    assert not np.array_equal(samples, model.sample_y(X, 3, random_state=8))
    generator = np.random.RandomState(7)
    assert not np.array_equal(model.sample_y(X, 3, random_state=generator), model.sample_y(X, 3, random_state=generator))


def test_one_observed_acceleration_may_be_flat(data):
    X, y = data
    model = GP2Regressor(WIRE, observe=["ddx"], n_restarts=1).fit(X, y[:, 0])
    mean, cov = model.predict(X[:4], return_cov=True)
    assert mean.shape == (4,) and cov.shape == (4, 4)
    assert model.predict(X[:4], return_std=True)[1].shape == (4,)
    assert model.sample_y(X[:4], 3).shape == (4, 3)
    column = GP2Regressor(WIRE, observe="ddx", n_restarts=1).fit(X, y[:, :1])
    assert np.array_equal(column.predict(X[:4]), mean[:, None])


def test_a_series_is_the_acceleration_that_it_is_called(data):
    X, y = data
    ddz = pd.DataFrame(y, columns=["ddx", "ddz"])["ddz"]
    flat = GP2Regressor(WIRE, max_iterations=0).fit(X, ddz)
    assert flat.outputs_ == ["ddz"]
    assert np.array_equal(flat.predict(X[:4]), GP2Regressor(WIRE, observe="ddz", max_iterations=0).fit(X, y[:, 1]).predict(X[:4]))
    assert flat.score(X, ddz) == flat.score(X, y[:, 1]) == flat.score(X, ddz.rename("target"))
    with pytest.raises(gp2.InputError, match="^y: no column ddx; it has: ddz$"):
        GP2Regressor(WIRE, observe="ddx").fit(X, ddz)
    with pytest.raises(gp2.InputError, match="^y: no column ddz; it has: ddx$"):
        flat.score(X, ddz.rename("ddx"))


def test_what_is_masked_is_missing_in_fit_and_in_score(data, model):
    X, y = data
    masked = np.ma.array(y, mask=np.zeros(y.shape, bool))
    assert model.score(X, masked) == model.score(X, y)
    masked[3, 0] = np.ma.masked
    for use in (model.score, GP2Regressor(WIRE, max_iterations=0).fit):
        with pytest.raises(ValueError, match="contains NaN"):
            use(X, masked)


def test_names_of_columns_are_text_unless_all_are_whole_numbers(data, model):
    X, y = data
    estimator = GP2Regressor(WIRE, max_iterations=0)
    for first, names in {
        r"\('state', 'x'\)": pd.MultiIndex.from_tuples([("state", name) for name in WIRE.state_names]),
        "b'x'": pd.Index([name.encode() for name in WIRE.state_names]),
        "1": pd.Index(["x", 1, 2, 3, 4, 5]),
    }.items():
        for use in (model.predict, lambda X: estimator.fit(X, y)):
            with pytest.raises(gp2.InputError, match=f"^X: column names must be text, got {first}$"):
                use(pd.DataFrame(X, columns=names))
    accelerations = pd.DataFrame(y, columns=[b"ddx", b"ddz"])
    for use in (model.score, estimator.fit):
        with pytest.raises(gp2.InputError, match="^y: column names must be text, got b'ddx'$"):
            use(X, accelerations)


def test_frames_are_read_by_their_names(data, model):
    X, y = data
    X = pd.DataFrame(X, columns=WIRE.state_names)[["push", "dz", "dx", "z", "x"]]  # t is not read
    y = pd.DataFrame(y, columns=["ddx", "ddz"])[["ddz", "ddx"]]
    by_name = GP2Regressor(WIRE, mean="force", n_restarts=2).fit(X, y)
    assert list(by_name.feature_names_in_) == ["push", "dz", "dx", "z", "x"] and by_name.n_features_in_ == 5
    assert by_name.outputs_ == ["ddz", "ddx"]
    np.testing.assert_allclose(by_name.predict(X)[:, ::-1], model.predict(data[0]), rtol=1e-6, atol=1e-6)
    assert by_name.score(X, y) == by_name.score(X, y[["ddx", "ddz"]]) > 0.99


@pytest.mark.parametrize("reversed_in_fit", [None, False, True])
def test_frames_go_by_name_and_arrays_by_position_whatever_fit_was_given(data, model, reversed_in_fit):
    X, y = data
    frame = pd.DataFrame(X, columns=WIRE.state_names)
    backwards = frame[frame.columns[::-1]]
    given = {None: X, False: frame, True: backwards}[reversed_in_fit]
    again = GP2Regressor(WIRE, mean="force", n_restarts=2).fit(given, y)
    assert hasattr(again, "feature_names_in_") == (reversed_in_fit is not None) and again.n_features_in_ == 6
    expected = model.predict(X)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for asked in (frame, backwards, frame.drop(columns="t"), backwards.drop(columns="t")):
            assert np.array_equal(again.predict(asked), expected)
        assert np.array_equal(again.sample_y(backwards, 2), model.sample_y(X, 2))
        assert again.score(backwards, y) == model.score(X, y)
    for asked in (X, pd.DataFrame(X)):
        with pytest.warns(match="no column names and is read as x, z,") if reversed_in_fit else contextlib.nullcontext():
            assert np.array_equal(again.predict(asked), expected)


def test_an_array_has_all_columns_after_a_frame_without_some(data, model):
    X, y = data
    frame = pd.DataFrame(X, columns=WIRE.state_names).drop(columns="t")
    by_name = GP2Regressor(WIRE, mean="force", n_restarts=2).fit(frame, y)
    assert np.array_equal(by_name.predict(X), model.predict(X))
    with pytest.raises(gp2.InputError, match=r"^X: expected 6 columns, x, z, dx, dz, t, push; got 5 feature"):
        by_name.predict(frame.to_numpy())


def test_transformers_may_give_frames_in_their_own_order_and_arrays_in_that_of_the_states(data, model):
    X, y = data
    frame = pd.DataFrame(X, columns=WIRE.state_names)
    estimator = GP2Regressor(WIRE, mean="force", n_restarts=2)
    push_first = ColumnTransformer([("push", "passthrough", ["push"])], remainder="passthrough", verbose_feature_names_out=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of_frames = make_pipeline(push_first.set_output(transform="pandas"), estimator).fit(frame, y)
        assert list(of_frames[-1].feature_names_in_)[0] == "push"
        assert np.array_equal(of_frames.predict(frame), model.predict(X))
        of_arrays = make_pipeline(FunctionTransformer(np.asarray), estimator).fit(frame, y)
        assert np.array_equal(of_arrays.predict(frame), model.predict(X))


def test_columns_of_frames_are_unknown_missing_or_given_twice(data, model):
    X, y = data
    frame = pd.DataFrame(X, columns=WIRE.state_names)
    estimator = GP2Regressor(WIRE, n_restarts=1, max_iterations=0)
    twice = pd.concat([frame, 0 * frame[["x"]]], axis=1)
    for use in (model.predict, model.sample_y, lambda X: model.score(X, y), lambda X: estimator.fit(X, y)):
        with pytest.raises(gp2.InputError, match="^X: x: given twice$"):
            use(twice)
        with pytest.raises(gp2.InputError, match="^X: episode: no part of a state of 'bead on a wire': x, z, dx, dz, t, push$"):
            use(frame.assign(episode=0))
    with pytest.raises(gp2.InputError, match="^states: missing column 'dz'"):
        model.predict(frame.drop(columns="dz"))
    accelerations = pd.DataFrame(y[:, [0, 1, 1]], columns=["ddx", "ddz", "ddz"])
    for use in (model.score, estimator.fit, GP2Regressor(WIRE, observe="ddx").fit):
        with pytest.raises(gp2.InputError, match="^y: ddz: given twice$"):
            use(frame, accelerations)
    assert model.score(frame, pd.DataFrame(y)) == model.score(frame, pd.DataFrame(y, columns=["ddx", "ddz"])[["ddz", "ddx"]])


def test_a_system_may_be_the_path_of_a_model_file(tmp_path, data, model):
    path = tmp_path / "wire.toml"
    path.write_text(WIRE.text)
    from_file = GP2Regressor(path, mean="force", n_restarts=2).fit(*data)
    assert np.array_equal(from_file.predict(data[0]), model.predict(data[0]))


def test_clones_and_pickles_give_the_same_bits(data, model):
    X = data[0]
    copy = clone(model)
    assert not hasattr(copy, "posterior_") and copy.get_params().keys() == model.get_params().keys()
    assert np.array_equal(copy.fit(*data).predict(X), model.predict(X))
    loaded = pickle.loads(pickle.dumps(model))
    assert np.array_equal(loaded.predict(X), model.predict(X))
    assert np.array_equal(loaded.sample_y(X, 2), model.sample_y(X, 2))
    assert loaded.system_.text == WIRE.text
    model.predict(X)  # pickling left it as it was


def test_parameters_that_are_set_after_a_fit_are_for_the_next(data):
    X, y = data
    model = GP2Regressor(WIRE, n_restarts=1, max_iterations=0).fit(X, y)
    expected, score = model.predict(X), model.score(X, y)
    model.set_params(system=None, observe=["ddx"])
    assert np.array_equal(model.predict(X), expected) and model.score(X, y) == score
    with pytest.raises(ValueError, match="Seed must be between 0 and"):
        model.set_params(system=WIRE, observe=None, random_state=-1).fit(X, y)


def test_systems_of_functions_can_be_cloned_but_not_pickled():
    system = gp2.System.from_callables(
        lambda states, parameters: (np.ones((len(states), 1, 1)), None, None, np.zeros((len(states), 1))),
        name="a mass",
        coordinates=["x"],
        latents=[{"features": ["dx"]}],
        noise=0.1,
    )
    X = np.random.default_rng(5).normal(size=(20, 3))
    model = clone(GP2Regressor(system)).fit(X, -X[:, 1])
    np.testing.assert_allclose(model.predict(X), -X[:, 1], atol=0.1)
    with pytest.raises(TypeError, match="'a mass' cannot be pickled: it has functions, which are code"):
        pickle.dumps(model)


def test_an_estimator_shows_its_system(model):
    assert repr(model).startswith("GP2Regressor(mean='force', n_restarts=2,") and repr(WIRE) in repr(model)


def test_it_takes_part_in_cross_validation_pipelines_and_searches(data):
    X, y = data
    estimator = GP2Regressor(WIRE, n_restarts=1, max_iterations=20)
    assert cross_val_score(estimator, X, y, cv=3).min() > 0.9
    pipeline = make_pipeline(FunctionTransformer(), estimator).fit(X, y)
    assert pipeline.score(X, y) > 0.9
    search = GridSearchCV(estimator, {"mean": ["zero", "force"], "prior": ["acceleration", "force"]}, cv=2, n_jobs=2).fit(X, y)
    assert search.best_params_["mean"] == "force"


def test_options_reach_the_fit(data):
    X, y = data
    options = {"noise_std": "estimate", "estimate": ["h"], "discrepancy": False, "n_restarts": 1, "max_iterations": 30}
    model = GP2Regressor(WIRE, mean="force", prior="force", n_threads=1, random_state=3, **options).fit(X, y)
    names = [hyperparameter.name for hyperparameter in model.posterior_.report.hyperparameters]
    assert "h" in names and any(name.startswith("noise_stddev") for name in names)
    assert not any("discrepancy" in name for name in names)
    assert len(model.posterior_.report.restarts) == 1
    assert abs(model.posterior_.parameters["h"] - 0.5) < 0.05
    baseline = GP2Regressor(WIRE, baseline="se", n_restarts=1).fit(X, y)
    assert baseline.log_marginal_likelihood_value_ < model.log_marginal_likelihood_value_


def test_every_option_of_fit_reaches_it(data):
    X, y = data
    options = {"hyperparameters": "optimise", "robust": True, "restarts": 2}
    with pytest.raises(gp2.InputError, match="fit_options: 'restarts' is the argument n_restarts of GP2Regressor itself"):
        GP2Regressor(WIRE, fit_options=options).fit(X, y)
    del options["restarts"]
    model = GP2Regressor(WIRE, mean="force", n_restarts=1, fit_options=options)
    assert clone(model).get_params()["fit_options"] == options
    also = {"also": [gp2.SideInformation("unconstrained", gp2.Table({"x": [0.0]}))]}
    assert type(clone(GP2Regressor(WIRE, fit_options=also)).get_params()["fit_options"]["also"][0]) is gp2.SideInformation
    asked = model.fit(X, y).posterior_.options
    assert asked["robust"] is True and asked["hyperparameters"] == "optimise"
    with pytest.raises(TypeError, match="did you mean 'robust'"):
        GP2Regressor(WIRE, fit_options={"robst": True}).fit(X, y)


@pytest.mark.parametrize("scaler", [StandardScaler(), MinMaxScaler()])
def test_a_scaler_before_a_system_is_warned_of(data, scaler):
    X, y = data
    estimator = GP2Regressor(WIRE, n_restarts=1, max_iterations=0)
    with pytest.warns(UserWarning, match="X: every column is scaled alike"):
        make_pipeline(scaler, estimator).fit(X, y)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimator.fit(X, y)
        make_pipeline(scaler, GP2Regressor(n_restarts=1, max_iterations=0)).fit(X, y)  # without mechanics it may be


def test_an_input_that_acts_late_is_warned_of():
    cart = gp2.System(
        coordinates=["x"], inputs=[{"name": "u", "delay": {"estimate": True}}, {"name": "v", "lag": 0.1}, "w"], mass=[["1"]],
        force=["u + v + w"], latents=[{"features": ["dx"]}], noise=0.1)
    assert cart.late_inputs == ["u", "v"] and WIRE.late_inputs == []
    X = np.random.default_rng(1).normal(size=(20, len(cart.state_names)))
    with pytest.warns(UserWarning, match="^system: u, v: acts later than it is commanded. Rows of X are taken as what acts"):
        GP2Regressor(cart, max_iterations=0, n_restarts=1).fit(X, X[:, 1])


# ---------------------------------------------------------------- what is refused


def test_faults_of_the_user_are_told(data):
    X, y = data
    with pytest.raises(NotFittedError):
        GP2Regressor(WIRE).predict(X)
    regressor = GP2Regressor(WIRE, max_iterations=3).fit(X, y)
    with pytest.raises(gp2.InputError):
        regressor.set_params(n_restarts=-1).fit(X, y)
    with pytest.raises(NotFittedError):  # neither what an earlier fit found nor half of this one
        regressor.predict(X)
    with pytest.raises(gp2.InputError, match=r"^X: expected 6 columns, x, z, dx, dz, t, push; got 5 feature"):
        GP2Regressor(WIRE).fit(X[:, :5], y)
    with pytest.raises(gp2.InputError, match=r"^y: expected columns ddx, ddz; got shape \(40,\)"):
        GP2Regressor(WIRE).fit(X, y[:, 0])
    with pytest.raises(gp2.InputError, match="^observe: ddw: no acceleration of 'bead on a wire': ddx, ddz"):
        GP2Regressor(WIRE, observe=["ddw"]).fit(X, y[:, 0])
    with pytest.raises(gp2.InputError, match="^observe: goes with a system$"):
        GP2Regressor(observe="ddx").fit(X, y[:, 0])
    with pytest.raises(gp2.InputError, match="^y: a, b: no acceleration of 'bead on a wire': ddx, ddz"):
        GP2Regressor(WIRE).fit(X, pd.DataFrame(y, columns=["a", "b"]))
    with pytest.raises(gp2.InputError, match="^y: no column ddx; it has: ddz"):
        GP2Regressor(WIRE, observe=["ddx"]).fit(X, pd.DataFrame(y[:, 1:], columns=["ddz"]))
    with pytest.raises(gp2.InputError, match="^X: height: no part of a state of 'bead on a wire': x, z, dx, dz, t, push"):
        GP2Regressor(WIRE).fit(pd.DataFrame({"x": X[:, 0], "height": X[:, 1]}), y)
    with pytest.raises(gp2.InputError, match="mean: expected one of 'zero', 'force', got 'none'"):
        GP2Regressor(WIRE, mean="none").fit(X, y)
    with pytest.raises(TypeError, match=r"^system: expected a gp2.System, the path of a model file or None, got 3$"):
        GP2Regressor(3).fit(X, y)
    with pytest.raises(TypeError, match=r"^n_restarts: expected a whole number, got 'many'$"):
        GP2Regressor(WIRE, n_restarts="many").fit(X, y)
    with pytest.raises(gp2.InputError, match=r"^n_restarts: "):
        GP2Regressor(WIRE, n_restarts=-1).fit(X, y)
    with pytest.raises(gp2.InputError, match="missing column 'dz'"):
        GP2Regressor(WIRE).fit(pd.DataFrame({"x": X[:, 0], "dx": X[:, 2]}), y)
