"""Systems whose mechanics are Python functions."""

import concurrent.futures
import pickle
import sys
import time
import types

import gp2
import numpy as np
import pytest

from conftest import MODELS, run

SURFACE_KEYS = {
    "coordinates": ["q1", "q2", "q3"],
    "inputs": ["u1", "u2", "u3"],
    "latents": [{"kernel": "se", "features": ["q1", "q2", "q3", "dq1", "dq2", "dq3", "u1", "u2", "u3"]}],
    "noise": 0.1,
}


@pytest.fixture(scope="module")
def surface():
    return gp2.System.load(MODELS / "surface.toml")


@pytest.fixture(scope="module")
def log(surface):
    return surface.generate(40, noise_std=0.1)


def parameters(**other):
    return {"m": 3.0, "g": 9.81, "p1": 0.08, "p2": 0.05, "p3": 0.05, "p4": 0.1, "p5": 3.0, **other}


def as_functions(surface, constraints=("surface",), mechanics=None, **keywords):
    """The surface again, its equations evaluated by a function."""

    def evaluate(states, values):
        at = surface.evaluate(states, values)
        return at.M, at.A, at.b, at.F

    names = surface.state_names
    reads = [name for name in names if name != "t"]
    keywords = {"parameters": parameters(), "reads": reads, **SURFACE_KEYS, **keywords}
    return gp2.System.from_callables(mechanics or evaluate, constraints, **keywords)


def test_rows_of_constraints_that_nobody_names_are_refused(surface, log):
    with pytest.raises(gp2.InputError, match="mechanics: A is not empty, but no constraint is named: give constraints="):
        gp2.fit(as_functions(surface, constraints=()), log, max_iterations=0)
    for rows in ([[1.0], [1.0, 2.0]], 0.0, np.array(0.0)):

        def mechanics(states, values, rows=rows):
            at = surface.evaluate(states, values)
            return at.M, rows, None, at.F

        with pytest.raises(gp2.InputError, match="mechanics: A is not empty"):
            gp2.fit(as_functions(surface, (), mechanics), log, max_iterations=0)


def test_functions_give_the_same_fit_as_text(surface, log):
    system = as_functions(surface)
    options = {"mean": "force", "restarts": 2, "estimate": []}
    by_text, by_functions = gp2.fit(surface, log, **options), gp2.fit(system, log, **options)
    assert by_functions.report.objective == by_text.report.objective
    states = surface.states(surface.generate(20, seed=2, noise_std=0))
    for view in ["constrained", "unconstrained", "constraint-force", "multipliers"]:
        a, b = by_text.predict(states, view), by_functions.predict(states, view)
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.cov, b.cov)
    # exact in the text, central differences of the function: step³ᐟ² of rounding
    exact = gp2.Predictor(by_text).mean_and_jacobian(states[0])[1]
    differences = gp2.Predictor(by_functions).mean_and_jacobian(states[0])[1]
    np.testing.assert_allclose(differences, exact, atol=1e-7 * np.abs(exact).max())


def test_parameter_is_estimated_with_exact_derivatives_and_without(surface, log):
    """M, A, b, F are linear in p1 for this surface: differences are exact but for rounding."""

    def derivatives(states, values, name):
        assert name == "p1"
        step = 0.01
        low, high = (surface.evaluate(states, {**values, name: values[name] + s}) for s in (-step, step))
        return tuple((getattr(high, part) - getattr(low, part)) / (2 * step) for part in "MAbF")

    bounded = parameters(p1={"value": 0.07, "bounds": [0.04, 0.12]})
    options = {"mean": "force", "restarts": 1, "estimate": ["p1"]}
    given = gp2.fit(as_functions(surface, parameters=bounded, derivatives=derivatives), log, **options)
    differenced = gp2.fit(as_functions(surface, parameters=bounded), log, **options)
    assert given.report.objective == pytest.approx(differenced.report.objective, abs=1e-4)
    assert given.parameters["p1"] == pytest.approx(differenced.parameters["p1"], abs=1e-4)
    assert given.parameters["p1"] == pytest.approx(0.08, abs=0.005)


def test_latents_may_come_one_by_one():
    def speed(states):
        return states[:, 1:2]

    latents = [{"features": {"names": ["speed"], "function": speed, "reads": ["dx"]}}]
    keys = {"coordinates": ["x"], "mass": [["1"]], "noise": 0.1, "truth": ["-dx"], "sampling": {"x": [-1, 1], "dx": [-1, 1]}}
    system = gp2.System(**keys, latents=(latent for latent in latents))
    log = system.generate(5)
    expected = gp2.fit(gp2.System(**keys, latents=latents), log, max_iterations=0)
    np.testing.assert_array_equal(gp2.fit(system, log, max_iterations=0).predict(log).cov, expected.predict(log).cov)


def test_simulate_stays_on_constraints_with_residuals(surface):
    h = 0.5

    def mechanics(states, values):
        x, dx = states[:, 0], states[:, 2]
        n = len(states)
        mass = np.broadcast_to(0.2 * np.eye(2), (n, 2, 2))
        rows = np.stack([-2 * h * x, np.ones(n)], axis=1)[:, None, :]
        force = np.broadcast_to([0.0, -9.81 * 0.2], (n, 2))
        return mass, rows, (2 * h * dx**2)[:, None], force

    def residuals(states, values):
        x, z, dx, dz = states[:, :4].T
        return np.stack([z - h * x**2, dz - 2 * h * x * dx], axis=1)

    wire = gp2.System.from_callables(
        mechanics, {"position": ["wire"]}, residuals=residuals, coordinates=["x", "z"], truth=["0", "0"]
    )
    motion = gp2.simulate(wire, {"x": 0.9}, np.linspace(0, 5, 11))
    assert motion.q[0, 1] == pytest.approx(h * 0.81, abs=1e-12)  # from the constraint
    assert motion.max_position_drift < 1e-12
    text = gp2.System(
        coordinates=["x", "z"],
        mass=[["0.2", "0"], ["0", "0.2"]],
        force=["0", "-9.81*0.2"],
        constraints=[f"z - {h}*x^2"],
        truth=["0", "0"],
    )
    np.testing.assert_allclose(motion.q, gp2.simulate(text, {"x": 0.9}, np.linspace(0, 5, 11)).q, atol=1e-9)


def test_redundant_constraints_are_recognised_at_measured_states_as_those_of_text():
    text = gp2.System.load(MODELS / "slider_crank.toml")
    values = {"Jc": 0.004, "Jr": 0.002, "ms": 0.8, "mr": 0.3, "r": 0.1, "l": 0.3, "d": 0.4}

    def mechanics(states, parameters):
        at = text.evaluate(states, parameters)
        return at.M, at.A, at.b, at.F

    def residuals(states, p):
        q1, q2, q3, dq1, dq2, dq3 = states[:, :6].T
        r, l = p["r"], p["l"]
        x, y = r * np.cos(q1), r * np.sin(q1)
        dx, dy = -y * dq1, x * dq1
        pin_x, dpin_x = x + l * np.cos(q2) - q3, dx - l * np.sin(q2) * dq2 - dq3
        pin_y, dpin_y = y + l * np.sin(q2), dy + l * np.cos(q2) * dq2
        rod, drod = (q3 - x) ** 2 + y**2 - l**2, 2 * (q3 - x) * (dq3 - dx) + 2 * y * dy
        return np.stack([pin_x, dpin_x, pin_y, dpin_y, rod, drod], axis=1)

    code = gp2.System.from_callables(
        mechanics,
        constraints={"position": ["pin x", "pin y", "rod"]},
        residuals=residuals,
        reads=["q1", "q2", "q3", "dq1", "dq2", "dq3", "u1"],
        name="crank in code",
        coordinates=[{"name": "q1", "angle": True}, {"name": "q2", "angle": True}, "q3"],
        inputs=["u1"],
        parameters=values,
        latents=[{"name": "f", "kernel": "se", "features": ["q1", "q3", "dq1", "dq3", "u1"], "directions": "force"}],
        noise=[0.5, 0.2, 0.05],
    )
    log = text.generate(30, seed=1)
    log = {name: np.array(log[name]) if name.startswith("dd") else np.round(log[name], 6) for name in log.columns}
    test = np.round(text.states(text.generate(20, seed=2, noise_std=0)), 6)
    options = {"mean": "force", "restarts": 1, "max_iterations": 0, "threads": 1}
    expected, got = (gp2.fit(system, log, **options).predict(test) for system in (text, code))
    np.testing.assert_allclose(got.mean, expected.mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(got.std, expected.std, rtol=1e-6, atol=1e-9)
    assert expected.std.mean() > 0.1


# A body on a rail that docks at t = 5 s. The rows are independent where both are there, whatever the states at which redundancy is looked for.
def docking(interrupt=None):
    def mechanics(states, _):
        if interrupt is not None and len(states) == 1:
            raise interrupt
        x, y, z, dx, dy, dz, t, u = states.T
        n, docked = len(states), t > 5
        A = np.zeros((n, 2, 3))
        A[:, 0, :2] = -0.5, 1
        A[:, 1, 2] = docked
        return np.broadcast_to(np.eye(3), (n, 3, 3)), A, np.zeros((n, 2)), np.stack([u, 0 * u, 0 * u - 9.81], axis=1)

    def residuals(states, _):
        x, y, z, dx, dy, dz, t, u = states.T
        return np.stack([y - 0.5 * x, dy - 0.5 * dx, z * (t > 5), dz * (t > 5)], axis=1)

    return gp2.System.from_callables(
        mechanics,
        constraints={"position": ["rail", "dock"]},
        residuals=residuals,
        name="docking",
        coordinates=["x", "y", "z"],
        inputs=["u"],
        latents=[{"kernel": "se", "features": ["x", "dx"], "directions": "force"}],
        noise=0.01,
    )


def docking_log(n=40):
    random = np.random.default_rng(0)
    x, dx, u = random.normal(size=(3, n))
    t = np.linspace(0, 10, n)
    ddx = (u - 0.3 * dx) / 1.25
    return {"x": x, "y": 0.5 * x, "z": np.where(t > 5, 0, 1), "dx": dx, "dy": 0.5 * dx, "dz": 0 * t, "t": t, "u": u,
            "ddx": ddx + 0.01 * random.normal(size=n), "ddy": 0.5 * ddx, "ddz": np.where(t > 5, 0, -9.81)}


OPTIONS = {"mean": "force", "restarts": 1, "max_iterations": 0, "threads": 1}


def test_a_row_that_code_switches_off_elsewhere_is_not_redundant():
    log = docking_log()
    predicted = gp2.fit(docking(), log, **OPTIONS).predict(log | {"u": log["u"] + 3}).mean
    np.testing.assert_allclose(predicted[:, 1], 0.5 * predicted[:, 0], atol=1e-12)
    np.testing.assert_allclose(predicted[log["t"] > 5, 2], 0, atol=1e-12)


@pytest.mark.parametrize("interrupt", [KeyboardInterrupt, SystemExit])
def test_what_ends_python_is_not_taken_for_a_state_without_mechanics(interrupt):
    with pytest.raises(interrupt):
        gp2.fit(docking(interrupt()), docking_log(), **OPTIONS)


def test_a_predictor_of_another_system_of_functions_may_have_many_threads(surface, log):
    posterior = gp2.fit(surface, log, max_iterations=0)
    predictor = gp2.Predictor(posterior, system=as_functions(surface))
    states = surface.states(surface.generate(200, seed=3, noise_std=0))
    expected = [predictor.mean(state) for state in states]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        np.testing.assert_array_equal(list(pool.map(predictor.mean, states)), expected)


def test_a_fit_that_learned_from_a_system_of_functions_cannot_be_pickled(surface, log):
    posterior = gp2.fit(surface, [log, gp2.Log(log, as_functions(surface))], max_iterations=0)
    with pytest.raises(TypeError, match="cannot be pickled: that system has functions"):
        pickle.dumps(posterior)


def test_rows_of_constraints_come_by_level_whatever_the_order_of_the_names():
    def mechanics(states, _):
        n = len(states)
        return np.tile(np.eye(3), (n, 1, 1)), np.tile(np.eye(3)[:2], (n, 1, 1)), np.zeros((n, 2)), np.zeros((n, 3))

    system = gp2.System.from_callables(
        mechanics, {"velocity": ["rolls"], "position": ["wire"]}, coordinates=["x", "y", "z"], noise=0.1
    )
    assert system.constraints == ["wire", "rolls"]


def test_what_functions_read_without_declaring_it_is_found(surface, log):
    reads = ["q1", "q2", "dq1", "dq2", "u1", "u2", "u3"]

    def findings(reads):
        return [finding.text for finding in gp2.check(as_functions(surface, reads=reads), log) if "declared reads" in finding.text]

    assert findings(reads) == []
    found = findings([name for name in reads if name != "dq2"])
    assert len(found) == 1 and found[0].startswith("declared reads: M, A or b depend on dq2, which mechanics_reads (in Python reads) ")


def test_functions_that_return_one_array_for_all_states_are_found():
    mass = np.zeros((1, 1))

    def mechanics(states, parameters):
        masses = []
        for q in states[:, 0]:
            mass[:] = 2 + np.cos(q)
            masses.append(mass)
        return masses, None, None, np.zeros((len(states), 1))

    joint = gp2.System.from_callables(mechanics, coordinates=["q"], reads=["q"], noise=0.1)
    states = {"q": [0.1, 0.7, 1.3], "dq": [0.0, 0.0, 0.0], "ddq": [0.0, 0.0, 0.0]}
    mixes = "differ between a call with it alone and a call with several"
    assert any(mixes in one.text for one in gp2.check(joint, states))
    with pytest.raises(gp2.InputError, match=f"M, A or b of one state {mixes}"):
        gp2.fit(joint, states)


def test_functions_whose_rounding_depends_on_the_number_of_states_do_not_mix_rows():
    def mechanics(states, _):
        rounding = 1e-7 if len(states) > 1 else 0.0  # sums in single precision
        return np.full((len(states), 1, 1), 2 + rounding), None, None, np.full((len(states), 1), rounding)

    joint = gp2.System.from_callables(mechanics, coordinates=["q"], reads=["q"], noise=0.1)
    states = {"q": [0.1, 0.7, 1.3], "dq": [0.0, 0.0, 0.0], "ddq": [0.0, 0.0, 0.0]}
    assert not any("differ between a call" in one.text for one in gp2.check(joint, states))


def test_start_that_is_not_named_whole_is_told_of_without_residuals():
    def mechanics(states, _):
        x, dx = states[:, 0], states[:, 2]
        n = len(states)
        return np.tile(0.2 * np.eye(2), (n, 1, 1)), np.stack([-x, np.ones(n)], 1)[:, None], dx[:, None] ** 2, np.zeros((n, 2))

    wire = gp2.System.from_callables(mechanics, constraints=["wire"], reads=["x", "dx"], coordinates=["x", "z"])
    with pytest.warns(UserWarning, match="z = 0, dz = 0, as .* has no residuals"):
        gp2.simulate(wire, {"x": 0.7, "dx": 1.0}, [0, 0.5])


def test_fit_is_saved_without_the_functions_and_loaded_with_them(surface, log, tmp_path):
    system = as_functions(surface)
    posterior = gp2.fit(system, log, max_iterations=0)
    posterior.save(tmp_path / "fit.json")
    states = surface.states(log)
    for loaded in [gp2.load(tmp_path / "fit.json", system), gp2.load(tmp_path / "fit.json", system=posterior.system)]:
        np.testing.assert_array_equal(loaded.predict(states).cov, posterior.predict(states).cov)
    with pytest.raises(gp2.InputError, match="are code, which a file cannot hold"):
        gp2.load(tmp_path / "fit.json")


def test_fit_is_not_loaded_with_other_functions_than_it_had(surface, log, tmp_path):
    gp2.fit(as_functions(surface), log, mean="force", max_iterations=0).save(tmp_path / "fit.json")

    def other(part, factor):
        def mechanics(states, values):
            at = surface.evaluate(states, values)
            return tuple(factor * value if name == part else value for name, value in zip("MAbF", (at.M, at.A, at.b, at.F), strict=True))

        return as_functions(surface, mechanics=mechanics)

    for part, name in {"M": "M", "A": "A", "b": "b", "F": "the prior mean"}.items():
        said = f"the code given is not that of this fit: at state 1 of its data an entry of {name} is "
        with pytest.raises(gp2.InputError, match=said):
            gp2.load(tmp_path / "fit.json", other(part, 1.001))
        gp2.load(tmp_path / "fit.json", other(part, 1 + 1e-12))  # as another machine rounds


def test_fit_of_a_latent_in_every_direction_is_loaded_with_its_functions(tmp_path):
    """Each of its directions has a process of its own, all of one name."""
    system = gp2.System.from_callables(
        lambda states, _: (np.tile(np.diag([1.0, 2.0]), (len(states), 1, 1)), None, None, -states[:, :2]),
        coordinates=["x", "y"], reads=["x", "y"], noise=0.1, latents=[{"features": ["dx", "dy"]}],
    )  # fmt: skip
    rows = np.random.default_rng(1).normal(size=(8, 6))
    log = dict(zip(["x", "y", "dx", "dy", "ddx", "ddy"], rows.T, strict=True))
    posterior = gp2.fit(system, log, mean="force", max_iterations=0)
    posterior.save(tmp_path / "fit.json")
    again = gp2.load(tmp_path / "fit.json", system)
    np.testing.assert_array_equal(again.predict(log).mean, posterior.predict(log).mean)


def test_several_threads_take_turns_in_the_functions(surface, log):
    """Functions with a state of their own, which give wrong numbers if another thread comes in between."""
    buffer = {}

    def through_a_buffer(states, values):
        buffer["states"], buffer["values"] = states.copy(), dict(values)
        time.sleep(0)  # lets go of the interpreter's lock
        at = surface.evaluate(buffer["states"], buffer["values"])
        return at.M, at.A, at.b, at.F

    bounded = parameters(p1={"value": 0.08, "bounds": [0.06, 0.1]})
    systems = [as_functions(surface, mechanics=through_a_buffer, parameters=bounded) for _ in range(2)]
    options = {"estimate": ["p1"], "restarts": 3, "max_iterations": 5}
    one, two = (gp2.fit(systems[0], log, threads=threads, **options) for threads in (1, 2))
    assert one.report.objective == two.report.objective
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        at_once = list(pool.map(lambda system: gp2.fit(system, log, threads=2, **options), systems))
    assert [fit.report.objective for fit in at_once] == [one.report.objective] * 2


def test_a_function_may_evaluate_another_system_of_functions(surface, log):
    inner = as_functions(surface)

    def mechanics(states, values):
        at = inner.evaluate(states, values)
        return at.M, at.A, at.b, at.F

    outer = as_functions(surface, mechanics=mechanics)
    likelihoods = [gp2.fit(system, log, max_iterations=0, threads=2).negative_log_likelihood for system in (inner, outer)]
    assert likelihoods[0] == likelihoods[1]


def test_masked_entries_of_what_a_function_returns_are_not_numbers():
    def mechanics(states, values):
        n = len(states)
        force = np.ma.masked_array(np.full((n, 1), 7.0), mask=np.arange(n)[:, None] == 1)
        return np.ones((n, 1, 1)), None, None, force

    system = gp2.System.from_callables(mechanics, coordinates=["x"], noise=0.1, reads=["x", "dx"])
    with pytest.raises(gp2.InputError, match="force F with a number that is not finite at state 2"):
        system.evaluate(np.zeros((3, 3)))


def test_what_is_wrong_with_the_call_is_said_whatever_keywords_the_system_has():
    with pytest.raises(TypeError, match="^reads: expected a list of names, got 'x'$"):
        gp2.System.from_callables(returning(None), reads="x", coordinates=["x"], noise=0.1)
    with pytest.raises(TypeError, match=r"^from_callables\(\) is missing the argument 'mechanics'$"):
        gp2.System.from_callables(coordinates=["x"], noise=0.1)
    free = gp2.System.from_callables(
        lambda states, _: (np.ones((len(states), 1, 1)), None, None, np.zeros((len(states), 1))), coordinates=["x"], latents=None)
    assert free.coordinates == ["x"]


def test_what_a_function_raises_carries_that_there_is_no_fit_yet(surface, log):
    def stops(states, values):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stop:
        gp2.fit(as_functions(surface, mechanics=stops), log, mean="force")
    assert stop.value.posterior is None


def test_more_rows_than_a_thread_takes_are_added():
    """In a process of its own, which can be ended where threads wait for each other."""
    script = """if True:
        import numpy as np, gp2
        x = np.linspace(-1, 1, 900)
        log = {"x": x, "dx": np.cos(3 * x), "ddx": -1.5 * x}
        def mechanics(states, parameters):
            n = len(states)
            return np.full((n, 1, 1), 2.0), None, None, -3 * states[:, :1]
        system = gp2.System.from_callables(
            mechanics, coordinates=["x"], reads=["x", "dx"], latents=[{"features": ["x", "dx"]}], noise=0.1)
        posterior = gp2.fit(system, {name: values[::20] for name, values in log.items()}, mean="force", max_iterations=0)
        posterior.update(log)
        posterior.remove_oldest(45)
        print(posterior.n_data)
    """
    outcome = run(sys.executable, "-c", script)
    assert (outcome.returncode, outcome.stdout) == (0, "900\n"), outcome.stderr


def returning(values):
    return lambda states, parameters: values(len(states))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (lambda n: None, "mechanics: expected (M, A, b, F), got <class 'NoneType'>"),
        (lambda n: (np.eye(3), None, None, None), "M must be numbers of shape (n, nq, nq) = (40, 3, 3), got (3, 3)"),
        (lambda n: (np.ones((n, 3, 3)), None, None, None), "A must be numbers of shape (n, nc, nq) = (40, 1, 3), got"),
        (lambda n: (np.full((n, 3, 3), "x"), None, None, None), "M must be numbers of shape"),
    ],
)
def test_wrong_returns_are_named(surface, log, values, text):
    system = as_functions(surface, mechanics=returning(values))
    with pytest.raises(gp2.InputError) as error:
        gp2.fit(system, log)
    assert text in str(error.value)


def test_exceptions_of_functions_arrive_as_they_are(surface, log):
    calls = []

    def fails_later(states, values):
        calls.append(len(states))
        if len(calls) > 5:
            raise LookupError("of my own")
        at = surface.evaluate(states, values)
        return at.M, at.A, at.b, at.F

    bounded = parameters(p1={"value": 0.08, "bounds": [0.06, 0.1]})
    with pytest.raises(LookupError, match="of my own"):
        gp2.fit(as_functions(surface, mechanics=fails_later, parameters=bounded), log, estimate=["p1"])
    assert len(calls) > 5


def test_what_is_no_system_is_refused(surface):
    with pytest.raises(TypeError, match="mechanics: expected a function, got <class 'int'>"):
        as_functions(surface, mechanics=3)
    with pytest.raises(gp2.InputError, match="mass: the mechanics are code here; leave it out"):
        as_functions(surface, mass=[["1"]])
    with pytest.raises(gp2.InputError, match="expected 'position', 'velocity' or 'acceleration', got 'loop'"):
        as_functions(surface, constraints={"loop": ["x"]})
    with pytest.raises(TypeError, match="^constraints: expected a list of names, got 'wire'$"):
        as_functions(surface, constraints="wire")
    with pytest.raises(TypeError, match=r"^constraints\['position'\]: expected a list of names, got 3$"):
        as_functions(surface, constraints={"position": 3})


# ---- latents


def bead(**latent):
    return gp2.System(
        coordinates=["x", "z"],
        parameters={"h": {"value": 0.5, "bounds": [0.1, 2], "estimate": True}},
        mass=[["2", "0"], ["0", "2"]],
        force=["0", "-9.81*2"],
        constraints=["z - h*x^2"],
        noise=0.05,
        truth=["-0.8*dx", "0"],
        sampling={"x": [-1, 1], "dx": [-2, 2]},
        latents=[{"name": "contact", "kernel": "se + linear", **latent}],
    )


def features(states):
    return np.stack([states[:, 0], np.sin(states[:, 2])], axis=1)


def directions(states, values):
    x, dx, h = states[:, 0], states[:, 2], values["h"]
    return np.stack([h * x, 1 + h * dx**2], axis=1)[:, :, None]


def directions_derivatives(states, values, name):
    assert name == "h"
    return np.stack([states[:, 0], states[:, 2] ** 2], axis=1)[:, :, None]


TEXT = {"features": ["x", "sin(dx)"], "directions": {"force": [["h*x"], ["1 + h*dx^2"]]}}
CODE = {
    "features": {"names": ["x", "sin(dx)"], "function": features, "reads": ["x", "dx"]},
    "directions": {
        "force": {
            "names": ["normal"],
            "function": directions,
            "derivatives": directions_derivatives,
            "reads": ["x", "dx"],
        }
    },
}


def test_functions_of_a_latent_give_the_same_fit_as_text(tmp_path):
    text, code = bead(**TEXT), bead(**CODE)
    log = text.generate(40, seed=1)
    options = {"mean": "force", "restarts": 1, "max_iterations": 5, "hyperparameters": "optimise"}
    by_text = gp2.fit(text, log, **options)
    # at the same hyperparameters: on the way there rounding grows
    options["max_iterations"] = 0
    names = [h.name for h in gp2.fit(code, log, **options).report.hyperparameters]
    start = dict(zip(names, (h.value for h in by_text.report.hyperparameters)))
    by_code = gp2.fit(code, log, start=start, **options)
    assert by_code.report.objective == pytest.approx(by_text.report.objective, rel=1e-9)
    states = text.states(text.generate(20, seed=2, noise_std=0))
    np.testing.assert_allclose(by_code.predict(states).mean, by_text.predict(states).mean, rtol=1e-6, atol=1e-6)
    by_code.save(tmp_path / "fit.json")
    again = gp2.load(tmp_path / "fit.json", system=code)
    np.testing.assert_array_equal(again.predict(states).mean, by_code.predict(states).mean)
    np.testing.assert_array_equal(
        gp2.Predictor(again).mean(np.ascontiguousarray(states[0])), gp2.Predictor(by_code).mean(states[0])
    )
    with pytest.raises(gp2.InputError, match="latents of its model .* are code"):
        gp2.load(tmp_path / "fit.json")


@pytest.mark.parametrize(
    ("part", "given", "text"),
    [
        ("features", {"function": features}, "latent 'contact': features: missing 'names'"),
        ("features", {"names": ["a"], "function": features, "derivatives": features}, "leave out 'derivatives'"),
        ("features", {"names": ["a"], "function": features, "reads": []}, r"features must be numbers of shape \(n, names\) = \(40, 1\)"),
        (
            "features",
            {"names": ["a"], "function": features, "read": ["x"]},
            "'names', 'function', 'derivatives' or 'reads', got 'read'",
        ),
        ("features", {"names": ["a"], "function": features, "reads": ["y"]}, "'y' is no entry of the state"),
        (
            "features",
            {"names": ["a"], "function": lambda states: states[:, :1] - states[:, :1].mean(), "reads": ["x"]},
            "latent 'contact': features of one state differ between a call with it alone and a call with several",
        ),
        ("directions", {"force": {"names": ["a", "b"], "function": directions, "reads": []}}, r"\(n, nq, names\) = \(40, any, 2\)"),
        (
            "directions",
            {"names": ["a"], "function": lambda states, _: np.ones((len(states), 3, 1)), "reads": []},
            "3 × 40, expected 2 × 40",
        ),
    ],
)
def test_functions_of_a_latent_are_refused_where_they_do_not_fit(part, given, text):
    log = bead(**TEXT).generate(40, seed=1)
    with pytest.raises(gp2.InputError, match=text):
        gp2.fit(bead(**{**TEXT, part: given}), log, restarts=1, max_iterations=1)


def test_functions_of_a_latent_may_be_in_any_mapping():
    def shown(latent):
        return gp2.fit(bead(**latent), bead(**TEXT).generate(10, seed=1), max_iterations=0).negative_log_likelihood

    force = types.MappingProxyType({"force": types.MappingProxyType(CODE["directions"]["force"])})
    assert shown({"features": types.MappingProxyType(CODE["features"]), "directions": force}) == shown(CODE)


def test_functions_get_parameters_by_name_where_others_follow_from_them():
    given = {"half": "m/2", "m": {"value": 2.0, "bounds": [1, 3], "estimate": True}, "twice": "2*m", "h": 0.5}
    seen = []

    def along(states, values):
        seen.append(values)
        return np.ones((len(states), 1, 1))

    force = {"force": {"names": ["along"], "function": along, "reads": []}}
    system = gp2.System(coordinates=["x"], parameters=given, mass=[["m"]], noise=0.1, latents=[{"features": ["dx"], "directions": force}])
    gp2.fit(system, {"x": [0.0, 1.0], "dx": [1.0, 0.5], "ddx": [0.1, 0.2]}, estimate=[], max_iterations=0)
    assert seen[0] == system.parameters == {"m": 2.0, "h": 0.5}


@pytest.mark.parametrize("key", ["names", "reads"])
def test_names_of_a_function_are_a_list(key):
    with pytest.raises(TypeError, match=f"^latent 'contact': features: {key}: expected a list of names, got 'slip'$"):
        bead(**{**CODE, "features": {**CODE["features"], key: "slip"}})


def test_what_is_no_function_is_a_type_error():
    with pytest.raises(TypeError, match="latent 'contact': features: expected a function, got"):
        bead(**{**CODE, "features": {"names": ["a"], "function": 3}})
