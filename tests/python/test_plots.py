"""Pictures: gp2.plot, and those that matplotlib draws."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import gp2

pytest.importorskip("matplotlib").use("Agg")
pyplot = pytest.importorskip("matplotlib.pyplot")


def points_of(svg, kind):
    root = ElementTree.fromstring(svg)
    found = [one for one in root.iter() if one.get("class") == kind]
    assert len(found) == 1
    return np.array([[float(part) for part in point.split(",")] for point in found[0].get("points").split()])


def test_plot_is_the_picture_of_the_command(posterior, arm, command, tmp_path):
    posterior.save(tmp_path / "fit.json")
    svg = gp2.plot(posterior, tmp_path / "python.svg", what="friction of the tip", force="elbow")
    assert (tmp_path / "python.svg").read_text() == svg
    outcome = command("plot", "fit.json", "--what", "friction of the tip", "--force", "elbow", "-o", "command.svg")
    assert outcome.returncode == 0, outcome.stderr
    assert "command.svg: force_elbow@friction of the tip along " in outcome.stderr
    there = (tmp_path / "command.svg").read_text()
    np.testing.assert_allclose(points_of(there, "mean"), points_of(svg, "mean"), atol=0.11)
    assert gp2.plot(tmp_path / "fit.json") == gp2.plot(gp2.load(tmp_path / "fit.json"))


def test_units_stand_at_the_axes():
    cart = gp2.System(
        coordinates=["x"], mass=[["1"]], latents=[{"name": "drag", "features": ["dx"], "directions": "force"}], noise=0.05,
        truth=["-dx"], sampling={"dx": [-1, 1]}, units={"x": "m"},
    )
    assert cart.units["ddx"] == "m/s²" and cart.units["force_x"] == "N"
    ax = gp2.fit(cart, cart.generate(20), restarts=1).plot_learned("drag")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("dx [m/s]", "force_x [N]")


def test_band_and_marks_are_what_the_posterior_says(posterior, arm_log):
    svg = gp2.plot(posterior, what="friction of the tip", along="dshoulder", force="shoulder")
    mean, band = points_of(svg, "mean"), points_of(svg, "band")
    n = len(mean)
    upper, lower = band[:n], band[n:][::-1]
    np.testing.assert_allclose((upper + lower) / 2, mean, atol=0.11)
    assert (upper[:, 1] < lower[:, 1]).all()  # y points down
    assert svg.count("v-8") == len(arm_log) + 3  # three are the legend's
    # the scale by two numbers along the axis gives back the values
    curve = gp2._gp2._learned_curve(posterior, what="friction of the tip", along="dshoulder", force="shoulder")
    slope, shift = np.polyfit(curve["mean"], mean[:, 1], 1)
    np.testing.assert_allclose(slope * (curve["mean"] + 1.96 * curve["std"]) + shift, upper[:, 1], atol=0.3)
    np.testing.assert_allclose([curve["at"].min(), curve["at"].max()], [np.min(arm_log["dshoulder"]), np.max(arm_log["dshoulder"])])


def test_what_is_not_there_is_named_with_what_is(posterior):
    for keywords, text in [
        ({"what": "friction of the tipp"}, "what: 'friction of the tipp' is not .*did you mean.*friction of the tip"),
        ({"along": "t"}, "along: 't' is not .*there are: .*dshoulder"),
        ({"force": "wrist"}, "force: 'wrist' is not .*there are: shoulder, elbow"),
    ]:
        with pytest.raises(gp2.InputError, match=text):
            gp2.plot(posterior, **keywords)
    with pytest.raises(TypeError, match="did you mean 'along'"):
        gp2.plot(posterior, alng="t")


def test_names_stay_text_in_the_picture():
    system = gp2.System(name="<b>&", coordinates=["x"], mass=[["1"]], latents=[{"name": "a<b", "features": ["dx"]}], noise=0.1)
    rng = np.random.default_rng(1)
    fit = gp2.fit(system, {"dx": rng.normal(size=20), "ddx": rng.normal(size=20)}, max_iterations=0)
    assert "a&lt;b – &lt;b&gt;&amp;" in gp2.plot(fit)


def test_matplotlib_draws_what_was_learned(posterior):
    ax = posterior.plot_learned("friction of the tip", along="dshoulder", force="shoulder")
    assert ax.get_xlabel() == "dshoulder [rad/s]" and ax.get_ylabel() == "force_shoulder [N m]"
    assert posterior.plot_learned(ax=ax) is ax


def test_matplotlib_draws_predictions_and_calibration(posterior, arm, arm_log):
    test = arm.generate(40, seed=8)
    axes = posterior.plot_predictions(test)
    assert [one.get_xlabel() for one in axes] == ["measured ddshoulder", "measured ddelbow"]
    drawn = axes[0].lines[0].get_xydata()
    np.testing.assert_allclose(drawn[:, 0], test["ddshoulder"])
    predicted = posterior.predict(test)
    np.testing.assert_allclose(drawn[:, 1], predicted.mean[:, 0])
    (bars,) = axes[0].collections
    half = [np.ptp(segment[:, 1]) / 2 for segment in bars.get_segments()]
    assert (half > 1.96 * predicted.std[:, 0]).all(), "with the noise of a measurement, as the coverage counts it"
    below = pyplot.subplots(2, 1, squeeze=False)[1]
    assert list(posterior.plot_predictions(test, ax=below)) == list(below[:, 0])
    line = posterior.plot_calibration(test).lines[-1]
    at95 = line.get_ydata()[np.argmin(np.abs(line.get_xdata() - 0.95))]
    assert at95 == pytest.approx(posterior.evaluate(test).coverage95)


def test_matplotlib_draws_a_motion(arm):
    start = {"shoulder": 1.2, "elbow": -1.5}
    motion = gp2.simulate(arm, start, np.linspace(0, 0.2, 5), project=True)
    ax = motion.plot()
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["shoulder", "elbow"]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), motion.q[:, 1])
