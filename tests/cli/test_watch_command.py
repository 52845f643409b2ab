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


@pytest.fixture(scope="module")
def rts(tmp_path_factory):
    """Calibration and computed model of the sample rig, its zero and a wind run."""
    folder = tmp_path_factory.mktemp("rts")
    data, rig = RIG.parents[1] / "sample_data", RIG.with_name("rts-6.yaml")
    call("calibrate", "-g", rig, data / "static-bare.h5", "-o", folder / "cal.h5")
    call("identify", "-g", rig, "--method", "computed", "-o", folder / "model.h5")
    shutil.copy(data / "wind-1.h5", folder / "wind.h5")
    shutil.copy(folder / "wind.h5", folder / "zero.h5")
    with h5py.File(folder / "zero.h5", "r+") as file:
        noise = np.random.default_rng(1).standard_normal(file["channels"].shape)
        file["channels"][:] = 1e-4 * noise
        file.attrs["kind"], file.attrs["rotor_speed"] = "zero", 0.0
        del file["rotor"]
    return folder


def put(rts, folder, kind, name, recorded, offset, file_time):
    """A zero or wind run with an offset of all channels [V]."""
    path = folder / f"{name}.h5"
    shutil.copy(rts / f"{kind}.h5", path)
    with h5py.File(path, "r+") as file:
        file["channels"][:] += offset
        file.attrs["run"] = name
        if recorded:
            file.attrs["recorded"] = recorded
    os.utime(path, (1e9 + file_time, 1e9 + file_time))


def watch_zeros(rts, folder):
    words = ("--calibration", rts / "cal.h5", "--model", rts / "model.h5", "-o", folder / "out")
    return call("watch", folder / "in", *words, "--once", "--every", 0.05, "--harmonics", 2)


SERIES = (  # kind, name, recorded, offset [V]: the zeros of the channels change before zero zB
    ("zero", "zA", "2026-03-01T08:00:00", 0.0),
    ("wind", "wA", "2026-03-01T09:00:00", 0.0),
    ("zero", "zB", "2026-03-01T10:00:00", 0.05),
    ("wind", "wB", "2026-03-01T11:00:00", 0.05),
)


@pytest.mark.parametrize("file_times", [(0, 2, 1, 3), (3, 2, 1, 0)])
def test_runs_have_the_zero_that_was_recorded_before_them(rts, tmp_path, file_times):
    """A copy that changes the times of files gave a run a zero recorded after it, 32 sigma off."""
    (tmp_path / "in").mkdir()
    for item, time in zip(SERIES, file_times, strict=True):
        put(rts, tmp_path / "in", *item, time)
    output = watch_zeros(rts, tmp_path).output
    assert "h5 left out" not in output
    runs = loads(tmp_path).runs
    np.testing.assert_allclose(runs["wA"].amplitude[0], runs["wB"].amplitude[0], rtol=1e-3, atol=0.1)
    served = {entry["run"]: entry["zero"] for entry in journal(tmp_path) if entry["kind"] == "wind"}
    assert served == {"wA": "zA", "wB": "zB"}
    count = len(journal(tmp_path))
    put(rts, tmp_path / "in", "wind", "wC", "2026-03-01T09:30:00", 0.0, 9)
    output = watch_zeros(rts, tmp_path).output
    assert ("its zero is zA, the last recorded before it, not zB" in output) == (file_times[0] == 0)
    assert len(journal(tmp_path)) == count + 1  # neither zeros nor runs again
    np.testing.assert_allclose(loads(tmp_path).runs["wC"].amplitude[0], runs["wA"].amplitude[0], rtol=1e-3, atol=0.1)


def test_without_stated_times_a_zero_serves_the_files_after_it(rts, tmp_path):
    (tmp_path / "in").mkdir()
    for time, (kind, name, _, offset) in enumerate(SERIES):
        put(rts, tmp_path / "in", kind, name, None, offset, time)
    watch_zeros(rts, tmp_path)
    served = {entry["run"]: entry["zero"] for entry in journal(tmp_path) if entry["kind"] == "wind"}
    assert served == {"wA": "zA", "wB": "zB"}
