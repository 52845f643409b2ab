"""`balance report` as a command: what it writes, what it refuses."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.cli import balance
from balance_cli.io.artefacts import Provenance, save_artefact
from tests.support.report_content import campaign, loads, model

MADE = Provenance("some-command", {}, (), {"numpy": "2.0"}, "2026-01-02T03:04:05+00:00")


def call(*arguments: object):
    return CliRunner().invoke(balance, ["report", *map(str, arguments)])


@pytest.fixture
def files(tmp_path):
    save_artefact(tmp_path / "model.h5", "balance-model/1", model(), MADE)
    save_artefact(tmp_path / "loads.h5", "balance-loads/1", loads(), MADE)
    return tmp_path / "model.h5", tmp_path / "loads.h5"


def test_page_summary_and_picture(files, tmp_path):
    page, summary, picture = (tmp_path / name for name in ("r.html", "s.json", "p.png"))
    result = call(*files, "-o", page, "--json", summary, "--picture", picture)
    assert result.exit_code == 0, result.output
    written = json.loads(summary.read_text())
    assert list(written["sections"]) == [
        "summary",
        "wind-on",
        "eigenfrequencies",
        "shapes",
        "parameters",
        "check-runs",
        "provenance",
    ]
    assert "check-runs" in written["figures"]
    assert written["artefacts"] == {"model.h5": "rigid model (LS+ML)", "loads.h5": "static matrix"}
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_every_artefact_survives_its_file(tmp_path):
    for path, item in campaign():
        save_artefact(tmp_path / path.name, item.format, item.content, item.provenance)
    result = call(*sorted(tmp_path.glob("*.h5")), "-o", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    assert "7 artefacts, 10 sections" in result.output


def refused(result, tmp_path, *words: str) -> None:
    assert result.exit_code == 2, result.output
    for word in words:
        assert word in result.output
    assert "Traceback" not in result.output
    assert not list(tmp_path.glob("r.*"))


def test_what_is_no_artefact_is_refused(files, tmp_path):
    other = tmp_path / "loads.csv"
    other.write_text("run,component\n")
    refused(call(*files, other, "-o", tmp_path / "r.html"), tmp_path, "loads.csv", "balance-loads/1")
    refused(call(tmp_path / "none.h5", "-o", tmp_path / "r.html"), tmp_path, "none.h5")


def test_a_changed_artefact_is_refused(files, tmp_path):
    import h5py

    with h5py.File(files[0], "r+") as file:
        file["content/quality/chi2"][()] = 1.0
    refused(call(*files, "-o", tmp_path / "r.html"), tmp_path, "model.h5", "digest")


def test_other_names_than_html_are_refused(files, tmp_path):
    refused(call(*files, "-o", tmp_path / "r.pdf"), tmp_path, "r.pdf", ".html")
    page = tmp_path / "r.html"
    refused(call(*files, "-o", page, "--picture", tmp_path / "r.gif"), tmp_path, "r.gif", ".png")


def test_a_picture_without_check_runs_is_refused(files, tmp_path):
    result = call(files[0], "-o", tmp_path / "r.html", "--picture", tmp_path / "r.png")
    refused(result, tmp_path, "--picture", "check runs")


def test_a_mistyped_figure_is_refused_with_the_names_of_all(files, tmp_path):
    page = tmp_path / "r.html"
    wrong = call(files[1], "-o", page, "--picture", tmp_path / "azimut.svg")
    refused(wrong, tmp_path, "no figure `azimut`", "azimuth", "check-runs", "redundancy")
    refused(call(files[1], "-o", page, "--picture", tmp_path / "azimut.pdf"), tmp_path, "as .svg", "check-runs")
    assert not (tmp_path / "azimut.pdf").exists()


def test_one_run_makes_a_page_of_its_own(files, tmp_path):
    result = call(files[1], "-o", tmp_path / "one.html", "--run", "check-2")
    assert result.exit_code == 0, result.output
    html = (tmp_path / "one.html").read_text(encoding="utf-8")
    assert "check-2" in html and "wind-1" not in html
    refused(call(files[1], "-o", tmp_path / "r.html", "--run", "chek-2"), tmp_path, "--run chek-2", "check-2")


def write_wind_run(path, rate=512.0, speed=10.0):
    time = np.arange(2048) / rate
    samples = np.stack([np.sin(2 * np.pi * speed * time), 0.5 + 0.1 * np.cos(2 * np.pi * 4 * speed * time)], axis=1)
    source = MemorySource(samples, None)
    pulses = np.arange(0.0, time[-1], 1.0 / speed)
    run = Run("wind-9", "any", "wind", ("a", "b"), len(time), source, False, rate, speed, pulse_times=pulses)
    write_run(path, run)


def test_run_files_add_their_channels_and_spectra(files, tmp_path):
    write_wind_run(tmp_path / "run.h5")
    summary, figure = tmp_path / "s.json", tmp_path / "run-spectra.svg"
    result = call(*files, tmp_path / "run.h5", "-o", tmp_path / "r.html", "--json", summary, "--picture", figure)
    assert result.exit_code == 0, result.output
    assert "runs" in json.loads(summary.read_text())["sections"]
    drawn = figure.read_text(encoding="utf-8")
    assert ">1/rev<" in drawn and "amplitude [V]" in drawn
    twice = call(files[0], tmp_path / "run.h5", tmp_path / "run.h5", "-o", tmp_path / "t.html")
    assert twice.exit_code == 2 and "wind-9" in twice.output


def test_a_pdf_without_a_browser_is_refused(files, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    result = call(files[0], "-o", tmp_path / "r.html", "--pdf", tmp_path / "r.pdf")
    refused(result, tmp_path, "--pdf", "Install Chromium")
