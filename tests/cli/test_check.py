"""`balance check`: every file is recognized by its content, and all that is wrong with it is said."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli import balance
from balance_cli.io.artefacts import make_provenance, save_artefact
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve

ROOT = Path(__file__).parents[2]
RIG = ROOT / "configs" / "rts-6.yaml"
HEXAPOD = ROOT / "configs" / "hexapod.yaml"
WIND = ROOT / "sample_data" / "wind-1.h5"


@dataclass(frozen=True)
class Made:
    geometry: Geometry
    value: float = 1.0


def check(*words: object) -> Result:
    return CliRunner().invoke(balance, ["check", *map(str, words)], prog_name="balance")


def found(*words: object) -> dict[str, Any]:
    result = check(*words, "--json", "-")
    assert result.exit_code in (0, 2), result.output
    summary: dict[str, Any] = json.loads(result.stdout)
    assert summary["faulty"] == sum(bool(file["faults"]) for file in summary["files"].values())
    assert result.exit_code == (2 if summary["faulty"] else 0)
    return dict(summary["files"])


def faults(path: Path, *words: object) -> list[tuple[str, str]]:
    return [(fault["place"], fault["fault"]) for fault in found(path, *words)[str(path)]["faults"]]


@pytest.fixture
def artefact(tmp_path: Path) -> Path:
    path = tmp_path / "model.h5"
    save_artefact(path, "balance-model/1", Made(load_geometry(RIG)), make_provenance("identify", {}, ()))
    return path


def test_the_sample_campaign_and_its_geometry_have_no_fault() -> None:
    files = sorted((ROOT / "sample_data").glob("*.h5"))
    result = check("-g", RIG, RIG, *files)
    assert result.exit_code == 0, result.output
    assert "sweep run `sweep-Fx-high` of rig `RTS-6`: 15 channels, 28 s at 800 Hz, rotor at 0 Hz, " in result.stdout
    assert "multisine of Fx 40 N rms" in result.stdout
    assert "static run `static-bare` of rig `RTS-6`: 8 channels, 121 load points, trim `bare`" in result.stdout
    assert result.stdout.endswith(f"{len(files) + 1} files, 0 with faults\n")


def test_files_are_known_by_their_content(tmp_path: Path, artefact: Path) -> None:
    table = tmp_path / "loads.txt"
    header = "run,component,unit,harmonic,frequency_hz,cosine,sine,amplitude,phase_deg,sigma_cosine,sigma_sine,flag"
    table.write_text(f"{header}\n", encoding="utf-8")
    geometry = Path(shutil.copy(RIG, tmp_path / "geometry.txt"))
    run = Path(shutil.copy(WIND, tmp_path / "run.dat"))
    files = found(table, geometry, run, artefact)
    kinds = {Path(name).name: (file["kind"], file["name"], file["rig"]) for name, file in files.items()}
    assert kinds == {
        "loads.txt": ("loads", "", ""),
        "geometry.txt": ("geometry", "rts-1", "RTS-6"),
        "run.dat": ("run", "wind-1", "RTS-6"),
        "model.h5": ("balance-model/1", "model.h5", "RTS-6"),
    }


def test_truth_of_simulated_runs_is_no_fault(tmp_path: Path) -> None:
    words = ("-g", str(RIG), "--plan", "short", "--only", "static-bare", "-o", str(tmp_path / "runs"))
    assert CliRunner().invoke(balance, ["simulate", *words]).exit_code == 0
    files = found(*sorted((tmp_path / "runs").iterdir()))
    assert {file["kind"] for file in files.values()} == {"run", "balance-truth/1"}


def test_what_is_not_known_is_a_fault(tmp_path: Path) -> None:
    other = tmp_path / "other.txt"
    other.write_text("hello", encoding="utf-8")
    assert faults(other) == [("", "is not an HDF5 file")]
    assert faults(tmp_path) == [("", "is a folder")]
    assert faults(tmp_path / "missing") == [("", "there is no such file")]


def test_all_faults_of_a_run_are_listed(tmp_path: Path) -> None:
    path = Path(shutil.copy(WIND, tmp_path))
    with h5py.File(path, "a") as file:
        file.attrs["sample_rate"] = 0.0
        del file.attrs["rig"]
        del file["rotor"]
    places = [place for place, _ in faults(path)]
    assert places == ["attribute rig", "attribute sample_rate", "rotor/pulse_times"]


def test_dead_clipped_and_absent_channels_are_listed(tmp_path: Path) -> None:
    path = Path(shutil.copy(WIND, tmp_path))
    with h5py.File(path, "a") as file:
        names = list(file["channels"].attrs["names"])
        samples = file["channels"][()]
        samples[:, names.index("torque")] = 1.0
        samples[:, names.index("z1.piezo")] = np.clip(samples[:, names.index("z1.piezo")], -4.0, 4.0)
        file["channels"][...] = samples
        names[names.index("y1.piezo")] = "spare"
        file["channels"].attrs["names"] = names
    expected = {"channel torque": "dead", "channel z1.piezo": "clipped"}
    assert {place: fault.split(":")[0] for place, fault in faults(path)} == expected
    with_geometry = {place: fault.split(":")[0] for place, fault in faults(path, "-g", RIG)}
    assert with_geometry == expected | {"channel y1.piezo": "absent from the run"}


def test_a_file_of_another_rig_or_geometry_does_not_match(tmp_path: Path, artefact: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(RIG.read_text(encoding="utf-8").replace("rig: RTS-6", "rig: RTS-7"), encoding="utf-8")
    assert faults(WIND, "-g", other)[0][0] == "rig"
    assert "RTS-7" in faults(WIND, "-g", other)[0][1]
    assert "another geometry" in faults(artefact, "-g", other)[0][1]
    assert "differs from" in faults(other, "-g", RIG)[0][1]
    assert faults(artefact, "-g", RIG) == faults(RIG, "-g", RIG) == []


def test_an_artefact_that_was_changed_is_faulty(artefact: Path) -> None:
    with h5py.File(artefact, "a") as file:
        file["content/value"][()] = 2.0
    assert "digest" in faults(artefact)[0][1]


def test_a_broken_geometry_is_recognized_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("fromat: balance-geometry/1\nname: [\n", encoding="utf-8")
    assert "not YAML" in faults(path)[0][1]


def test_run_names_must_differ(tmp_path: Path) -> None:
    copy = Path(shutil.copy(WIND, tmp_path / "copy.h5"))
    files = found(WIND, copy)
    assert files[str(WIND)]["faults"] == []
    assert f"{WIND} has the same run name" in files[str(copy)]["faults"][0]["fault"]


def test_the_summary_is_written_although_there_are_faults(tmp_path: Path) -> None:
    summary = tmp_path / "check.json"
    assert check(tmp_path / "missing", "--json", summary).exit_code == 2
    assert json.loads(summary.read_text(encoding="utf-8"))["faulty"] == 1


def test_without_a_readable_geometry_nothing_is_checked(tmp_path: Path) -> None:
    result = check(WIND, "-g", tmp_path / "missing.yaml")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"balance: error: {tmp_path / 'missing.yaml'}: there is no such file")


@pytest.mark.parametrize(
    ("text", "kind", "place"),
    [
        ("runs:\n- {run: a, kind: zero, duration: 10}\n", "balance-plan/1", None),
        ("runs:\n- {run: a, kind: zero, duratio: 10}\n", "balance-plan/1", "runs.0.zero.duratio"),
        ("rig: P8\nchannels:\n  A: B\nruns:\n- {file: x, kind: wind}\n", "balance-import/1", "format"),
        ("name: a\nrig: P8\n", "geometry", "format"),
    ],
)
def test_a_file_without_a_format_is_what_its_keys_say(tmp_path: Path, text: str, kind: str, place: str | None) -> None:
    """A plan as in the tutorial was said to be a geometry without a `format`."""
    path = tmp_path / "file.yaml"
    path.write_text(text)
    finding = found(path)[str(path)]
    assert finding["kind"] == kind and [fault["place"] for fault in finding["faults"]][:1] == ([place] if place else [])


@pytest.mark.parametrize(("turns", "said"), [(9, True), (10, False)])
def test_a_record_of_fewer_revolutions_than_reduce_needs(tmp_path: Path, turns: int, said: bool) -> None:
    path = tmp_path / "wind-1.h5"
    shutil.copy(WIND, path)
    with h5py.File(path, "r+") as file:
        pulses = file["rotor/pulse_times"][: turns + 1]
        samples = int(np.ceil(pulses[-1] * file.attrs["sample_rate"])) + 1
        for name, values in (("channels", file["channels"]), ("rotor/pulse_times", pulses)):
            attributes, kept = dict(file[name].attrs), np.asarray(values)[:samples]
            del file[name]
            file[name] = kept
            file[name].attrs.update(attributes)
    fault = ("rotor/pulse_times", f"holds {turns} revolutions; at least 10 are needed")
    assert faults(path) == ([fault] if said else [])


def test_pulses_that_reduce_cannot_repair(tmp_path: Path) -> None:
    path = tmp_path / "wind-1.h5"
    shutil.copy(WIND, path)
    with h5py.File(path, "r+") as file:
        pulses = file["rotor/pulse_times"][:]
        third = len(pulses) // 3
        del file["rotor/pulse_times"]
        file["rotor/pulse_times"] = np.delete(pulses, np.arange(third, 2 * third))
    ((place, fault),) = faults(path)
    assert place == "rotor/pulse_times" and "the pulses cannot be repaired" in fault


def test_missing_pulses_do_not_contradict_the_lines_of_the_channels(tmp_path: Path) -> None:
    path = tmp_path / "wind-1.h5"
    shutil.copy(WIND, path)
    with h5py.File(path, "r+") as file:
        pulses = file["rotor/pulse_times"][:]
        del file["rotor/pulse_times"]
        file["rotor/pulse_times"] = np.delete(pulses, np.arange(5, len(pulses) - 5, 10))
    assert faults(path) == []


def test_point_tables_are_compared_with_the_geometry(tmp_path: Path) -> None:
    """Two channels whose cables are exchanged, in a table whose loads and readings are sound otherwise."""
    geometry = load_geometry(HEXAPOD)
    system = balance_model(geometry).system()
    T = response(system, solve(system, np.zeros(1)))[0].real
    names = [channel.name for channel in geometry.channels]
    steps = np.tile([0.0, 0.5, 1.0, 0.5, 0.0], 6)
    loads = np.repeat(np.diag([300.0, 300.0, 900.0, 90.0, 90.0, 60.0]), 5, axis=0) * steps[:, None]
    head = [f"{name} [{'N' if name[0] == 'F' else 'N m'}]" for name in COMPONENTS] + [f"{name} [V]" for name in names]
    volts = loads @ T.T + 1e-6 * np.random.default_rng(1).standard_normal((len(loads), len(names)))
    for order, faulty in (([0, 1, 2, 3, 4, 5], False), ([3, 1, 2, 0, 4, 5], True)):
        table = tmp_path / "points.csv"
        np.savetxt(table, np.hstack([loads, volts[:, order]]), delimiter=",", header=",".join(head), comments="")
        listed = faults(table, "-g", HEXAPOD)
        assert bool(listed) == faulty
        assert not faulty or "l1.strain and l4.strain are exchanged in points" in listed[0][1]
