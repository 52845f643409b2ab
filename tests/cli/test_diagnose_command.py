"""The command `balance diagnose`: what it reads, writes, prints and refuses, with a diagnosis made by hand."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance
from balance_cli.cli.diagnosis_text import diagnosis_text
from balance_cli.diagnosis.result import (
    CONTRADICTED,
    EXPLAINED,
    NOTHING_MISSING,
    PARTLY_EXPLAINED,
    UNEXPLAINED,
    Diagnosis,
    ModelFreeTest,
)
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import load_artefact
from tests.support.channels import with_channel
from tests.support.diagnosis_content import FakeDiagnose, diagnosis, fake_diagnose_module, hold_out, trials

SWEEPS = ("sweep-Fx", "sweep-Fz", "sweep-Mz")


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    assert "Traceback" not in result.output
    return result


@pytest.fixture(scope="module")
def folder(campaign, tmp_path_factory):
    """Run files of the simulated campaign, half of its sweeps, and the rigid model that was identified from them."""
    folder = tmp_path_factory.mktemp("diagnose")
    save_geometry(folder / "geometry.yaml", campaign.geometry)
    for run in campaign.runs:
        if run.kind != "sweep" or run.name in SWEEPS:
            write_run(folder / f"{run.name}.h5", run)
    call("identify", "-g", folder / "geometry.yaml", *fitted(folder), "-o", folder / "rigid.model")
    return folder


def fitted(folder):
    return sorted([*folder.glob("sweep-*.h5"), *folder.glob("static-*.h5")])


@pytest.fixture
def engine(monkeypatch):
    """An engine that returns a diagnosis made by hand."""
    made = FakeDiagnose()
    monkeypatch.setitem(sys.modules, "balance_cli.steps.diagnose", fake_diagnose_module(made))
    return made


@pytest.fixture
def diagnose(folder, engine, tmp_path):
    """A call with its outputs in `tmp_path`; returns what was said and the summary."""

    def run(*words, runs=None, held=("check-1",), status=0):
        files = fitted(folder) if runs is None else runs
        hold = [word for name in held for word in ("--hold-out", folder / f"{name}.h5")]
        out = ("-o", tmp_path / "d.h5", "--model-out", tmp_path / "updated.h5", "--json", tmp_path / "d.json")
        result = call("diagnose", folder / "rigid.model", *files, *hold, *out, *words, status=status)
        summary = tmp_path / "d.json"
        return result, json.loads(summary.read_text()) if summary.exists() else None

    return run


def test_the_summary_has_the_keys_of_the_contract(diagnose):
    _, output = diagnose()
    assert output["verdict"] == EXPLAINED
    first = output["effects"][0]
    assert {"name", "where", "parameters", "evidence", "indistinguishable_from"} <= set(first)
    assert first["where"] == ["x", "theta"]
    assert first["parameters"]["mass"] == {"value": 512.0, "sigma": 23.0, "unit": "kg"}
    assert first["parameters"]["compliance_x"]["interval_95"] == [1.9e-8, 2.9e-8]
    assert first["parameters"]["damping_ratio"]["sigma"] is None
    assert first["indistinguishable_from"] == ["mast-bending@x"]
    assert output["not_testable"][0].keys() == {"name", "why"}
    assert output["chi2_per_dof"] == {"before": 2300.0, "after": 1.04}
    run = output["hold_out"]["check-1"]
    assert run["before"].keys() == run["after"].keys() == {"load_error", "interaction", "frf_error"}
    assert run["after"]["load_error"].keys() | run["after"]["interaction"].keys() == set(COMPONENTS)
    assert 0 < run["after"]["frf_error"] < 0.01
    assert output["trials"][0]["decision"] == "accepted"
    assert len(output["modes"]["before"]) == 7


def test_artefacts_come_back_as_they_were(diagnose, folder, tmp_path):
    diagnose(held=("check-1", "sweep-Mz"), runs=[path for path in fitted(folder) if "Mz" not in path.name])
    stored = load_artefact(tmp_path / "d.h5", {"balance-diagnosis/1": Diagnosis})
    expected = diagnosis()
    assert stored.content.effects == expected.effects
    assert stored.content.data_tests == expected.data_tests
    assert stored.content.untestable_effects == expected.untestable_effects
    assert list(stored.content.hold_out) == ["check-1", "sweep-Mz"]
    np.testing.assert_array_equal(stored.content.residual.before, expected.residual.before)
    assert stored.content.hold_out["sweep-Mz"].after.load_error == {}
    roles = {item.name: item.role for item in stored.provenance.inputs}
    assert roles["check-1"] == "hold-out" and roles["sweep-Fx"] == "run" and roles["rigid.model"] == "model"
    updated = load_artefact(tmp_path / "updated.h5", {"balance-model/1": IdentifiedModel}).content
    rigid = load_artefact(folder / "rigid.model", {"balance-model/1": IdentifiedModel}).content
    np.testing.assert_array_equal(updated.parameters.value, rigid.parameters.value)
    call("check", tmp_path / "d.h5", tmp_path / "updated.h5")


def test_the_report_takes_what_was_written(diagnose, tmp_path):
    diagnose()
    page, summary = tmp_path / "r.html", tmp_path / "r.json"
    call("report", tmp_path / "d.h5", tmp_path / "updated.h5", "-o", page, "--json", summary)
    output = json.loads(summary.read_text())
    assert "diagnosis" in output["sections"]
    assert {"hold-out", "residual"} <= set(output["figures"])
    assert "support-flexibility" in page.read_text(encoding="utf-8")


def test_other_kinds_among_the_runs_are_left_out_and_never_fitted(diagnose, engine, folder):
    others = [folder / f"{name}.h5" for name in ("wind-1", "check-1")]
    result, output = diagnose(runs=[*fitted(folder), *others], held=())
    assert set(output["left_out"]) == {"wind-1"}
    assert set(output["hold_out"]) == {"check-1"}
    assert "check-1 kept aside" in result.stderr
    assert "wind-1 left out" in result.stderr
    seen = {item.run for item in (*engine.spectra.lines, *engine.spectra.statics)}
    assert seen == {path.stem for path in fitted(folder)}


def test_the_lines_are_those_of_the_identification_or_of_a_band(diagnose, folder, tmp_path):
    assert diagnose()[1]["band"] is None
    assert diagnose("--band", 10, 40)[1]["band"] == [10.0, 40.0]
    updated = load_artefact(tmp_path / "updated.h5", {"balance-model/1": IdentifiedModel}).content
    assert updated.band == (10.0, 40.0)
    result, _ = diagnose("--band", 40, 10, status=2)
    assert "--band: no line lies between 40 and 10 Hz" in result.stderr
    model, summary = tmp_path / "narrow.model", tmp_path / "narrow.json"
    call("identify", "-g", folder / "geometry.yaml", *fitted(folder), "--band", 20, 40, "-o", model, "--json", summary)
    assert json.loads(summary.read_text())["band"] == [20.0, 40.0]
    assert load_artefact(model, {"balance-model/1": IdentifiedModel}).content.band == (20.0, 40.0)


def test_without_hold_out_it_warns_and_goes_on(diagnose):
    result, output = diagnose(held=())
    assert "no hold-out" in result.stderr
    assert output["hold_out"] == {}
    assert "Errors on runs" not in result.stdout


def test_a_hold_out_run_that_the_model_was_fitted_to_is_named(diagnose, folder):
    without = [path for path in fitted(folder) if "Mz" not in path.name]
    result, _ = diagnose(runs=without, held=("sweep-Mz",))
    assert "sweep-Mz is held out here, but the model was fitted to it" in result.stderr


@pytest.mark.parametrize(
    ("verdict", "status"),
    [(NOTHING_MISSING, 0), (EXPLAINED, 3), (PARTLY_EXPLAINED, 3), (UNEXPLAINED, 3), (CONTRADICTED, 3)],
)
def test_exit_status_by_verdict(diagnose, engine, folder, tmp_path, verdict, status):
    engine.verdict = verdict
    few = {"runs": [folder / "sweep-Fx.h5"], "held": ()}
    result, output = diagnose("--fail-on-discrepancy", status=status, **few)
    assert output["verdict"] == verdict
    assert result.stdout.startswith(f"Verdict: {verdict}:")
    assert (tmp_path / "updated.h5").exists()
    diagnose(status=0, **few)


# ---- what is refused -------------------------------------------------------------------------------------------------


def refused(result, tmp_path, *words):
    for word in words:
        assert word in result.stderr
    assert len(result.stderr.strip().splitlines()) <= 2
    assert list(tmp_path.iterdir()) == []


def test_a_run_in_both_lists_is_refused(diagnose, folder, tmp_path):
    result, _ = diagnose(runs=[*fitted(folder), folder / "check-1.h5"], status=2)
    refused(result, tmp_path, "check-1", "both lists")
    result, _ = diagnose(held=("sweep-Fx",), status=2)
    refused(result, tmp_path, "sweep-Fx", "both lists")


def test_a_hold_out_run_without_known_loads_is_refused_before_the_fit(diagnose, engine, folder, tmp_path):
    result, _ = diagnose(held=("wind-1",), status=2)
    refused(result, tmp_path, "wind-1", "check runs")
    assert engine.spectra is None
    result, output = diagnose("--skip-bad", held=("wind-1", "check-1"))
    assert list(output["hold_out"]) == ["check-1"]
    assert "wind-1" in str(output["skipped"])


def test_a_check_run_whose_loads_cannot_be_determined_is_refused_before_the_fit(
    diagnose, engine, campaign, folder, tmp_path
):
    """A torque meter that reads a constant: a search of a minute is not lost to it."""
    check = next(run for run in campaign.runs if run.name == "check-1")
    silent = with_channel(check, "torque", lambda volts: 0.0 * volts)
    write_run(folder / "check-9.h5", replace(silent, name="check-9"))
    try:
        result, _ = diagnose(held=("check-9", "check-1"), status=2)
        refused(result, tmp_path, "check-9", "torque: dead")
        assert engine.spectra is None
    finally:
        (folder / "check-9.h5").unlink()


def test_the_papers_form_is_refused_with_what_to_do(diagnose, folder, tmp_path):
    paper = folder / "paper.model"
    call("identify", "-g", folder / "geometry.yaml", *fitted(folder), "--form", "paper", "-o", paper)
    out = ("-o", tmp_path / "d.h5", "--model-out", tmp_path / "updated.h5")
    result = call("diagnose", paper, *fitted(folder), *out, status=2)
    refused(result, tmp_path, "paper.model", "--form physical")


def test_no_sweep_and_no_model_are_refused(diagnose, folder, tmp_path):
    result, _ = diagnose(runs=sorted(folder.glob("static-*.h5")), status=2)
    refused(result, tmp_path, "no sweep run")
    out = ("-o", tmp_path / "d.h5", "--model-out", tmp_path / "updated.h5")
    result = call("diagnose", folder / "geometry.yaml", *fitted(folder), *out, status=2)
    refused(result, tmp_path, "geometry.yaml", "balance-model/1")


# ---- text ------------------------------------------------------------------------------------------------------------


def test_the_text_has_verdict_effects_evidence_and_errors():
    lines = list(diagnosis_text(diagnosis(hold_out=hold_out(), location="z3 at 118 Hz in My")))
    text = "\n".join(lines)
    assert lines[0].startswith("Verdict: explained: ")
    assert lines[1].startswith("chi2/dof 2.3e+03 -> 1.04")
    assert "Remaining residual: z3 at 118 Hz in My" in text
    assert "support-flexibility@x,theta: without it chi2 rises by about 1e+06 (3 parameters, p < 1e-99)" in text
    assert "m/N   95 %: 1.9e-08 to 2.9e-08" in text
    assert "cannot be distinguished from mast-bending@x" in text and "a tap on the support" in text
    assert "underestimated" not in text
    assert any("underestimated" in line for line in diagnosis_text(diagnosis(chi2_per_dof_after=3.0)))
    assert "time-delay@z1.piezo: without it chi2 rises by 812.3 (1 parameter, p < 1e-99)" in text
    assert "gyroscopic-coupling: all runs are at rest" in text
    (heads,) = (line.split() for line in lines if line.startswith("   check-1"))
    assert heads == ["check-1", "Fx", "Fz", "My", "Mz", "response"]
    (before, _) = (line.split() for line in lines if line.startswith("      before"))
    assert before == ["before", "(755)", "5.46", "1270", "(0.62)", "10.1"]


def test_what_was_found_and_not_kept_stands_beside_a_residual():
    removed = [
        replace(trials()[0], label=label, decision="removed", reason="what no effect explains is larger")
        for label in ("time-delay@z1.piezo", "load-offset@Fz", "load-offset@Fz", "free-play@z2")
    ]
    left = diagnosis(trials=tuple(removed), location="z3 at 118 Hz in My")
    line = "Found and not kept: load-offset@Fz, free-play@z2: what no effect explains is larger"
    assert line in list(diagnosis_text(left))
    assert line not in list(diagnosis_text(replace(left, location="")))


def test_what_the_data_show_without_a_model_stands_beside_a_residual():
    tests = [
        ModelFreeTest("low against high level", "a, b", 90.0, 30, 1e-9, "differ by 3 %"),
        ModelFreeTest("low against high level", "c, d", 900.0, 30, 0.0, "differ by 30 %"),
        ModelFreeTest("mains", "50 Hz and multiples", 3.0, 4, 0.5, "nothing"),
    ]
    left = diagnosis(data_tests=tuple(tests), location="z3 at 118 Hz in My")
    shown = [line for line in diagnosis_text(left) if line.startswith("Shown without a model")]
    assert shown == ["Shown without a model: low against high level, c, d: differ by 30 % (1 more)"]
    assert not any("without a model" in line for line in diagnosis_text(replace(left, location="")))


def test_a_bar_is_drawn_where_stderr_is_a_terminal(monkeypatch, capsys):
    from balance_cli.cli.progress import progress_bar

    with progress_bar() as progress:
        progress("residual", 0.5)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_bar() as progress:
        progress("refit of support-flexibility", 0.5)
    shown = capsys.readouterr().err
    assert "refit of support-flexibility" in shown and "50 %" in shown


def test_suspected_and_excluded_effects_reach_the_search(diagnose, engine):
    diagnose("--suspect", "time-delay@piezo", "--suspect", "crosstalk", "--exclude", "dry-friction@x")
    assert engine.settings.suspected == ("time-delay@piezo", "crosstalk")
    assert engine.settings.excluded == ("dry-friction@x",)


@pytest.mark.parametrize("option", ["--suspect", "--exclude"])
def test_an_unknown_suspect_is_refused_before_anything_is_read(diagnose, option):
    result, output = diagnose(option, "time-delai@x.piezo", status=2)
    assert output is None
    assert option in result.output and "Did you mean `time-delay`" in result.output
