"""`balance watch`: runs are reduced as they appear, bad files are passed over, and the same call goes on."""

import json
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.io.artefacts import load_artefact
from balance_cli.reduction.result import HubLoads

RIG = Path(__file__).parents[2] / "configs" / "dynamometer.yaml"
RECORD = {"rotor_speed": 80.0, "duration": 2.0, "sample_rate": 4096.0, "harmonics": {"Fz": [50, 30, 10, 100]}}
PLAN = {
    "runs": [
        {"run": "check", "kind": "check", **RECORD},
        {"run": "wind", "kind": "wind", **RECORD, "harmonics": {"Fx": [40, 10]}},
    ]
}


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    (folder / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    call("simulate", "-g", RIG, "--plan", folder / "plan.yaml", "-o", folder / "runs")
    call("identify", "-g", RIG, "--method", "computed", "-o", folder / "model.h5")
    return folder


@pytest.fixture
def watch(made, tmp_path):
    """A function that watches tmp_path/in once, and returns the summary."""
    (tmp_path / "in").mkdir()

    def watch_once(status=0):
        words = ("--model", made / "model.h5", "-o", tmp_path / "out", "--once", "--every", 0.05, "--json", "-")
        return json.loads(call("watch", tmp_path / "in", *words, status=status).stdout)

    return watch_once


def journal(folder):
    return [json.loads(line) for line in (folder / "out" / "journal.jsonl").read_text().splitlines()]


def loads(folder):
    return load_artefact(folder / "out" / "loads.h5", {"balance-loads/1": HubLoads}).content


def test_runs_are_reduced_as_reduce_does_it(made, watch, tmp_path):
    for name in ("check", "wind"):
        shutil.copy(made / "runs" / f"{name}.h5", tmp_path / "in")
    assert set(watch()["files"].values()) == {"reduced"}
    call("reduce", "--model", made / "model.h5", made / "runs" / "wind.h5", "-o", tmp_path / "wind.h5")
    expected = load_artefact(tmp_path / "wind.h5", {"balance-loads/1": HubLoads}).content.runs["wind"]
    np.testing.assert_array_equal(loads(tmp_path).runs["wind"].amplitude, expected.amplitude)
    entry = next(entry for entry in journal(tmp_path) if entry["run"] == "wind")
    quick = entry["loads"]["Fx"]
    assert quick["amplitude"] == pytest.approx(abs(expected.amplitude[quick["harmonic"], 0]), rel=1e-12)
    assert entry["verdict"]
    page = (tmp_path / "out" / "page.html").read_text()
    assert "location.reload" in page
    assert "wind" in page


def test_a_file_of_the_user_is_not_replaced(made, watch, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "loads.h5").write_text("mine")
    call("watch", tmp_path / "in", "--model", made / "model.h5", "-o", tmp_path / "out", "--once", status=2)
    assert [(path.name, path.read_text()) for path in (tmp_path / "out").iterdir()] == [("loads.h5", "mine")]
    (tmp_path / "out" / "loads.h5").unlink()
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in")
    assert watch()["files"] == watch()["files"] == {"wind.h5": "reduced"}


def test_bad_files_are_passed_over_and_named(made, watch, tmp_path):
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in")
    (tmp_path / "in" / "cut.h5").write_bytes((made / "runs" / "check.h5").read_bytes()[:3000])
    (tmp_path / "in" / "text.h5").write_text("no HDF5")
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in" / "copy.h5")
    os.utime(tmp_path / "in" / "copy.h5", (2e9, 2e9))
    summary = watch(status=4)
    assert summary["files"]["wind.h5"] == "reduced"
    assert set(summary["skipped"]) == {"cut.h5", "text.h5", "copy.h5"}
    assert "as wind.h5 has" in summary["skipped"]["copy.h5"]
    assert "cut.h5" in summary["skipped"]["cut.h5"]


def test_a_file_that_is_still_recorded_is_waited_for(made, watch, tmp_path):
    (tmp_path / "in" / "wind.h5").write_bytes((made / "runs" / "wind.h5").read_bytes()[:30000])
    words = ("--model", made / "model.h5", "-o", tmp_path / "out", "--idle", 0.3, "--every", 0.05)
    assert "nothing" in call("watch", tmp_path / "in", *words).output
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in")
    assert "1 reduced" in call("watch", tmp_path / "in", *words).output


def test_the_same_call_goes_on_where_it_was(made, watch, tmp_path):
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in")
    watch()
    shutil.copy(made / "runs" / "check.h5", tmp_path / "in")
    assert watch()["files"] == {"wind.h5": "reduced", "check.h5": "reduced"}
    assert [entry["run"] for entry in journal(tmp_path)] == ["wind", "check"]  # the first was not reduced again
    assert set(loads(tmp_path).runs) == {"wind", "check"}


def test_a_run_that_changes_is_reduced_again(made, watch, tmp_path):
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in")
    watch()
    before = loads(tmp_path).runs["wind"].amplitude
    with h5py.File(tmp_path / "in" / "wind.h5", "r+") as file:
        file["channels"][:] *= 2.0
    watch()
    np.testing.assert_allclose(loads(tmp_path).runs["wind"].amplitude[1:], 2.0 * before[1:], rtol=1e-9)
    assert [entry["run"] for entry in journal(tmp_path)] == ["wind", "wind"]


def test_another_response_begins_again(made, watch, tmp_path):
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in")
    watch()
    words = ("--model", made / "model.h5", "--harmonics", 2, "-o", tmp_path / "out", "--once", "--every", 0.05)
    call("watch", tmp_path / "in", *words)
    assert loads(tmp_path).runs["wind"].amplitude.shape[0] == 3
    assert len(journal(tmp_path)) == 2


def test_a_run_without_rotor_loads_is_left_out(made, watch, tmp_path):
    shutil.copy(made / "runs" / "wind.h5", tmp_path / "in" / "zero.h5")
    with h5py.File(tmp_path / "in" / "zero.h5", "r+") as file:
        file.attrs["kind"] = "zero"
        file.attrs["rotor_speed"] = 0.0
        del file["rotor"]
    summary = watch()
    assert summary["left_out"] == {"zero.h5": "zero of the mean loads"}
    assert summary["loads"] is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nowhere", "-o", "out"), "is not a folder"),
        ((".", "-o", "out"), "exactly one response is needed"),
        ((".", "-o", ".", "--model", "model.h5"), "is the watched folder itself"),
    ],
)
def test_calls_that_cannot_be_meant_are_refused(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in call("watch", *words, status=2).output


def test_a_given_zero_that_was_made_under_load_is_not_used(tmp_path):
    """A wind run as --zero takes its own mean loads from those of each run, without a trace in their sigma."""
    folder = RIG.parents[1] / "sample_data"
    rig = RIG.with_name("rts-6.yaml")
    call("calibrate", "-g", rig, folder / "static-bare.h5", "-o", tmp_path / "cal.h5")
    call("identify", "-g", rig, "--method", "computed", "-o", tmp_path / "model.h5")
    (tmp_path / "in").mkdir()
    shutil.copy(folder / "wind-1.h5", tmp_path / "in")
    shutil.copy(folder / "wind-2.h5", tmp_path / "loaded.h5")
    with h5py.File(tmp_path / "loaded.h5", "r+") as file:
        file.attrs["kind"] = "zero"
    given = ("--calibration", tmp_path / "cal.h5", "--model", tmp_path / "model.h5", "--zero", tmp_path / "loaded.h5")
    call("watch", tmp_path / "in", *given, "-o", tmp_path / "out", "--once", "--every", 0.05)
    (entry,) = journal(tmp_path)
    assert any("is no wind-off record and is not used" in text for text in entry["warnings"])
    assert all("no zero" in flag for flag in loads(tmp_path).runs["wind-1"].flags[0])
