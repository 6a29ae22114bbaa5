"""The page of gp2 report, from Python."""

import json
import re

import numpy as np
import pytest

import gp2


def data_of(page):
    return json.loads(re.search(r'<script type="application/json" id="report">(.*?)</script>', page, re.S)[1])[0]


def test_a_posterior_and_its_file_have_the_page_of_the_command(posterior, arm, command, tmp_path):
    posterior.save(tmp_path / "fit.json")
    (tmp_path / "arm.toml").write_text(arm.text)
    assert command("generate", "arm.toml", "--n", "12", "--seed", "7", "-o", "test.csv").returncode == 0
    outcome = command("report", "fit.json", "--data", "test.csv", "-o", "command.html")
    assert outcome.returncode == 0, outcome.stderr
    wanted = data_of((tmp_path / "command.html").read_text())
    page = gp2.report(tmp_path / "fit.json", tmp_path / "python.html", data=gp2.read_csv(tmp_path / "test.csv"))
    assert (tmp_path / "python.html").read_text() == page
    assert page.startswith("<!doctype html>")
    at_hand = data_of(gp2.report(posterior, data=tmp_path / "test.csv"))
    for found in [data_of(page), at_hand]:
        assert found["hyperparameters"] == wanted["hyperparameters"]
        for one, other in zip(found["data"], wanted["data"], strict=True):
            assert one["name"] == other["name"]
            np.testing.assert_allclose(one["figures"]["rmse"], other["figures"]["rmse"], rtol=1e-9)
    assert data_of(page)["date"] == wanted["date"] and at_hand["date"] == ""


def test_what_grew_is_on_the_page_and_options_have_pythons_names(posterior, arm):
    grown = gp2.fit(arm, arm.generate(30, seed=1), max_iterations=0)
    grown.update(arm.generate(5, seed=9))
    found = data_of(gp2.report(grown))
    assert found["data"][0]["n"] == 35
    assert any("max_iterations=0" in one["mend"] for one in found["advice"])


def test_several_fits_stand_side_by_side_under_their_names(posterior, arm, arm_fit_file):
    def labels(page):
        found = re.search(r'<script type="application/json" id="report">(.*?)</script>', page, re.S)[1]
        return [one["label"] for one in json.loads(found)]

    assert labels(gp2.report({"a": posterior, "b": arm_fit_file})) == ["a", "b"]
    assert labels(gp2.report([posterior, arm_fit_file])) == [arm.name, str(arm_fit_file)]
    with pytest.raises(gp2.InputError, match="there is no fit"):
        gp2.report([])


def test_columns_and_a_system_without_data_are_refused(posterior, arm, tmp_path):
    with pytest.raises(gp2.InputError, match="columns names columns of data, which is not given"):
        gp2.report(posterior, columns={"q1": "theta"})
    with pytest.raises(gp2.InputError, match="system is that of data, which is not given"):
        gp2.report(posterior, system=arm)
    with pytest.raises(gp2.InputError, match="nowhere.json"):
        gp2.report(tmp_path / "nowhere.json", tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_file_remembers_the_notes_of_its_fit(arm, arm_log, tmp_path):
    fitted = gp2.fit(arm, arm_log, restarts=1)
    fitted.save(tmp_path / "fit.json")
    loaded = gp2.load(tmp_path / "fit.json")
    assert loaded.notes == [note for note in fitted.notes if note in loaded.notes]
    assert json.loads(gp2.show(loaded, json=True))["fit"]["notes"] == loaded.notes
    advice = [(one["text"] + " " + one["mend"]).strip() for one in data_of(gp2.report(loaded))["advice"]]
    for note in loaded.notes:
        assert note.removeprefix("warning: ").rstrip(".") + "." in advice


def test_a_picture_is_svg_whatever_it_is_called(posterior, tmp_path):
    with pytest.raises(gp2.InputError, match="the picture is SVG"):
        gp2.plot(posterior, tmp_path / "tip.png")
    assert not (tmp_path / "tip.png").exists()
