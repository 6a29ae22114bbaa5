"""Long calls: Ctrl-C, progress, other Python threads."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings

import numpy as np
import pytest

import gp2
from conftest import MODELS

PATIENCE = 2  # seconds; what is asked for takes a twentieth of one, but machines may be busy


@pytest.fixture(scope="module")
def surface():
    return gp2.System.load(MODELS / "surface.toml")


@pytest.fixture(scope="module")
def long_job(surface):
    """A fit of minutes."""
    data = surface.generate(400, seed=1)
    return lambda **options: gp2.fit(surface, data, restarts=200, threads=1, **options)


def interrupted(script):
    """The outcome of a Python script that is sent Ctrl-C when it says 'ready', and the seconds it then took."""
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), str(MODELS)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # where the tests' shell ignores it
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "ready\n", process.stderr.read()
        sent = time.monotonic()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    return out, err, process.returncode, time.monotonic() - sent


def test_ctrl_c_ends_a_fit_with_the_best_so_far():
    out, err, status, seconds = interrupted(
        """
        import sys, gp2
        system = gp2.System.load(sys.argv[1] + "/surface.toml")
        data = system.generate(300, seed=1)
        said = []
        def progress(p):
            if p.iteration >= 3 and not said:
                said.append(p)
                print("ready", flush=True)
        try:
            gp2.fit(system, data, restarts=200, threads=1, progress=progress)
        except KeyboardInterrupt as stop:
            posterior = stop.posterior
            assert not posterior.report.converged, posterior.report
            assert posterior.report.termination == "interrupted"
            assert posterior.report.objective <= said[0].best
            assert posterior.predict(data).mean.shape == (300, 3)
            posterior.update(system.generate(2, seed=5))
            print("usable")
        """
    )
    assert (status, out) == (0, "usable\n"), err
    assert seconds < PATIENCE


def test_ctrl_c_ends_a_simulation():
    out, err, status, seconds = interrupted(
        """
        import threading, gp2
        system = gp2.System(
            coordinates=["x"], mass=[["1"]], force=["-100*x"], latents=[{"features": ["x"]}], noise=0.1, truth=["0"],
            sampling={"x": [-1, 1], "dx": [-1, 1]},
        )
        posterior = gp2.fit(system, system.generate(50), mean="force", max_iterations=0)
        threading.Timer(0.3, print, ["ready"], {"flush": True}).start()
        try:
            posterior.simulate([0.5, 0], [0, 1e-2, 1e5], rtol=1e-10)
        except KeyboardInterrupt as stop:
            assert stop.motion.t[1] == 1e-2 < stop.motion.t[2] < 1e5
            print("stopped")
        """
    )
    assert (status, out) == (0, "stopped\n"), err
    assert seconds < PATIENCE


# indented as the programs that begin with it
OF_A_CART = """
        import threading, gp2
        system = gp2.System(
            coordinates=["x"], inputs=["u"], mass=[["1"]], force=["u"], latents=[{"features": ["dx"]}], noise=0.1, truth=["0"],
            sampling={"x": [-1, 1], "dx": [-1, 1], "u": [-1, 1]},
        )
        posterior = gp2.fit(system, system.generate(5), mean="force", max_iterations=0)
        threading.Timer(2, print, ["ready"], {"flush": True}).start()"""


def test_ctrl_c_ends_a_search_with_the_best_motion_so_far():
    out, err, status, seconds = interrupted(
        OF_A_CART + """
        try:
            gp2.excite(posterior, {"x": 0}, 1, {"u": (-1, 1)}, n_rows=40, n_motions=100_000_000)
        except KeyboardInterrupt as stop:
            plan = stop.excitation
            assert plan.factor < 1 and len(plan.motion.t) == 40
            print("stopped")
        """
    )
    assert (status, out) == (0, "stopped\n"), err
    assert seconds < PATIENCE


def test_ctrl_c_ends_a_search_that_has_found_no_motion_within_the_limits():
    out, err, status, seconds = interrupted(
        OF_A_CART + """
        limits = {"inputs_within": {"u": (-1, 1)}, "within": {"x": (-0.5, 0.5)}}
        try:
            gp2.excite(posterior, {"x": 0, "dx": 50}, 1, **limits, n_rows=40, n_motions=100_000_000)
        except KeyboardInterrupt:
            print("stopped")
        """
    )
    assert (status, out) == (0, "stopped\n"), err
    assert seconds < PATIENCE


@pytest.mark.parametrize(
    "work",
    [
        "posterior.shoot(log, stretches=100_000)",
        'gp2.derive(system, {"t": t, "x": log["x"], "episode": np.arange(len(t)) // 1000})',
        "gp2.resample(system, log, 100_000)",
    ],
)
def test_ctrl_c_ends_what_goes_through_a_long_log(work):
    out, err, status, seconds = interrupted(
        f"""
        import threading, numpy as np, gp2
        system = gp2.System(
            coordinates=["x"], parameters={{"k": {{"value": 90, "bounds": [50, 200], "estimate": True}}}}, mass=[["1"]], force=["-k*x"],
            latents=[{{"features": ["x", "dx"]}}], noise=0.1, truth=["0"], sampling={{"x": [-1, 1], "dx": [-10, 10]}},
        )
        t = np.arange(200_000) * 1e-3
        noise = 1e-3 * np.random.default_rng(1).standard_normal(len(t))
        log = {{"t": t, "x": np.cos(10 * t) + noise, "dx": -10 * np.sin(10 * t)}}
        posterior = gp2.fit(system, system.generate(30), mean="force", restarts=1, hyperparameters="optimise")
        threading.Timer(1, print, ["ready"], {{"flush": True}}).start()
        try:
            {work}
        except KeyboardInterrupt:
            print("stopped")
        """
    )
    assert (status, out) == (0, "stopped\n"), err
    assert seconds < PATIENCE


@pytest.mark.parametrize("work", ["posterior.predict(states, threads=1)", "posterior.evaluate(log, threads=1)"])
def test_ctrl_c_ends_a_large_prediction(work):
    out, err, status, seconds = interrupted(
        f"""
        import sys, threading, numpy as np, gp2
        system = gp2.System.load(sys.argv[1] + "/surface.toml")
        posterior = gp2.fit(system, system.generate(200), max_iterations=0)
        states = np.tile(system.states(system.generate(100)), (3000, 1))
        states[:, system.state_names.index("t")] = 0
        log = dict(zip(system.state_names, states.T)) | {{f"ddq{{k}}": states[:, 0] for k in (1, 2, 3)}}
        threading.Timer(0.3, print, ["ready"], {{"flush": True}}).start()
        try:
            {work}
        except KeyboardInterrupt:
            print("stopped")
        """
    )
    assert (status, out) == (0, "stopped\n"), err
    assert seconds < PATIENCE


def share_of_another_thread(work):
    """How often another thread got its turn while work() ran, as a share of how often it asked."""
    ticks, done = [], threading.Event()

    def tick():
        while not done.wait(0.005):
            ticks.append(time.monotonic())

    ticker = threading.Thread(target=tick)
    ticker.start()
    begin = time.monotonic()
    while time.monotonic() - begin < 0.3:  # however fast the machine is
        work()
    seconds = time.monotonic() - begin
    done.set()
    ticker.join()
    return len([t for t in ticks if begin < t < begin + seconds]) * 0.005 / seconds


def test_other_python_threads_run_during_a_fit(surface):
    data = surface.generate(250, seed=1)
    assert share_of_another_thread(lambda: gp2.fit(surface, data, restarts=1, max_iterations=40, threads=1)) > 0.02


def test_other_python_threads_run_while_files_are_read_and_a_fit_is_prepared(surface, tmp_path):
    log = surface.generate(700, seed=1)
    posterior = gp2.fit(surface, log, max_iterations=0, threads=1)
    posterior.save(tmp_path / "fit.json")
    rows = np.column_stack([log[name] for name in log])
    np.savetxt(tmp_path / "log.csv", np.tile(rows, (40, 1)), delimiter=",", header=",".join(log), comments="")
    for what, work in {
        "read_csv": lambda: gp2.read_csv(tmp_path / "log.csv"),
        "load": lambda: gp2.load(tmp_path / "fit.json").negative_log_likelihood,
        "save": lambda: posterior.save(tmp_path / "again.json"),
        "resample": lambda: gp2.resample(surface, tmp_path / "log.csv", 50),
    }.items():
        assert share_of_another_thread(work) > 0.02, what


def test_progress_is_told_while_the_fit_runs(surface):
    told = []
    posterior = gp2.fit(surface, surface.generate(200, seed=1), restarts=2, max_iterations=60, threads=1, progress=told.append)
    assert told
    assert all(isinstance(p, gp2.Progress) and p.n_restarts == 2 for p in told)
    assert all(a.seconds <= b.seconds and a.best >= b.best for a, b in zip(told, told[1:]))
    assert told[-1].best >= posterior.report.objective - 1e-9 * abs(posterior.report.objective)
    assert 0 <= told[-1].fraction <= 1


def test_what_progress_raises_ends_the_fit_and_carries_the_best_so_far(long_job, surface):
    def progress(p):
        if p.iteration >= 2:
            raise LookupError(f"enough at iteration {p.iteration}")

    begin = time.monotonic()
    with pytest.raises(LookupError, match="enough at iteration") as caught:
        long_job(progress=progress)
    assert time.monotonic() - begin < PATIENCE
    mean = caught.value.posterior.predict(surface.generate(4, seed=8)).mean
    assert np.isfinite(mean).all()


def test_a_warning_that_is_an_error_carries_the_fit(surface):
    log = {name: surface.generate(30, seed=1)[name] for name in surface.generate(30, seed=1)}
    log["ddq1"] = log["ddq1"] + 30 * (np.arange(30) % 10 == 0)  # values far from what all others predict
    options = dict(restarts=1, max_iterations=3, noise_std=0.1, hyperparameters="optimise", discrepancy=False)
    with pytest.warns(UserWarning):
        fitted = gp2.fit(surface, log, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning) as caught:
            gp2.fit(surface, log, **options)
    assert caught.value.posterior.report.objective == fitted.report.objective


def test_a_warning_that_is_an_error_carries_the_motion(posterior):
    start = {"shoulder": 0.9, "dshoulder": 50.0}
    with pytest.warns(UserWarning, match="leaves the region of the data"):
        motion = posterior.simulate(start, [0, 0.1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning) as caught:
            posterior.simulate(start, [0, 0.1])
    np.testing.assert_array_equal(caught.value.motion.q, motion.q)


def test_what_is_no_function_is_no_progress(surface, tmp_path):
    for call in (lambda: gp2.fit(surface, 3, progress=3), lambda: gp2.fit_raw(surface, 3, progress=3),
                 lambda: gp2.fit_again(tmp_path, progress=3)):  # before anything is read  # fmt: skip
        with pytest.raises(TypeError, match="^progress: expected a function, got <class 'int'>$"):
            call()


def test_a_fit_in_a_thread_can_be_stopped_through_its_progress(long_job):
    stop, raised = threading.Event(), []

    def progress(_):
        if stop.is_set():
            raise InterruptedError

    def work():
        try:
            long_job(progress=progress)
        except InterruptedError as error:
            raised.append(error.posterior)

    thread = threading.Thread(target=work)
    thread.start()
    time.sleep(0.3)
    stop.set()
    thread.join(timeout=PATIENCE)
    assert raised


def test_the_same_seed_gives_the_same_bits_for_any_number_of_threads(surface):
    data = surface.generate(40, seed=1)
    one, three = (gp2.fit(surface, data, restarts=3, max_iterations=5, seed=4, threads=n) for n in (1, 3))
    assert [h.value for h in one.report.hyperparameters] == [h.value for h in three.report.hyperparameters]
    other = gp2.fit(surface, data, restarts=3, max_iterations=5, seed=5, threads=1)
    assert [r.objective for r in other.report.restarts] != [r.objective for r in one.report.restarts]


def test_a_fit_in_a_child_process_works(surface):
    """After fork: no thread or lock of the parent is waited for."""
    data = surface.generate(20, seed=1)
    gp2.fit(surface, data, restarts=2, max_iterations=2)
    child = os.fork()
    if child == 0:
        try:
            gp2.fit(surface, data, restarts=2, max_iterations=2)
            os._exit(0)
        finally:
            os._exit(1)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            assert os.waitstatus_to_exitcode(status) == 0
            return
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    pytest.fail("the child process hangs")
