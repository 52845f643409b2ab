"""Run files whose readings are in mV, in mV/V, or in volts beside the excitation of their bridges."""

import json

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import open_run, read_run, write_run
from balance_cli.cli import balance

GEOMETRY = "format: balance-geometry/1\nname: a\nrig: r\nchannels: [{name: B1%s}, {name: B2%s}]\ncomponents: [Fx, Fz]\n"
C = np.array([[1e-5, 2e-7], [3e-7, 4e-6]])
VOLTS = 10.0 + 0.5 * np.sin(np.arange(24.0))
"""Excitation that wanders by 5 %: readings in V are of no use without it."""


def ratios():
    ramp = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0, -0.5, -1.0, -0.5])
    loads = np.zeros((24, 6))
    loads[:12, 0], loads[12:, 2] = 100.0 * ramp, 400.0 * ramp
    return loads, loads[:, [0, 2]] @ C.T + 5e-8 * np.random.default_rng(3).normal(size=(24, 2))


def write(path, readings, unit, excitation=None, constant=None, kind="static"):
    """A run file of these stored readings; `excitation` is a dataset, `constant` an attribute."""
    loads, _ = ratios()
    rest = {"trim": "a"} if kind == "static" else {"sample_rate": 10.0}
    source = MemorySource(readings, loads if kind == "static" else None)
    write_run(path, Run(path.stem, "r", kind, ("B1", "B2"), 24, source, has_loads=kind == "static", **rest))
    with h5py.File(path, "r+") as file:
        file["channels"].attrs["unit"] = unit
        if excitation is not None:
            file["bridge_excitation"] = excitation
            file["bridge_excitation"].attrs["unit"] = "V"
        if constant is not None:
            file["channels"].attrs["bridge_excitation"] = constant
    return path


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result.output


def calibrate(tmp_path, path, unit=", unit: mV/V"):
    (tmp_path / "g.yaml").write_text(GEOMETRY % (unit, unit))
    words = ("calibrate", "-g", tmp_path / "g.yaml", path, "-o", tmp_path / "c.h5", "--json", tmp_path / "c.json")
    call(*words)
    C0 = json.loads((tmp_path / "c.json").read_text())["trims"]["a"]["C0"]
    return np.array([[C0[channel][name]["value"] for name in ("Fx", "Fz")] for channel in ("B1", "B2")])


FORMS = {
    "mV/V": lambda path, r, kind: write(path, 1e3 * r, "mV/V", kind=kind),
    "one unit each": lambda path, r, kind: write(path, r * [1e3, 1e6], ["mV/V", "uV/V"], kind=kind),
    "measured": lambda path, r, kind: write(path, 1e3 * r * VOLTS[:, None], "mV", VOLTS, kind=kind),
    "constant": lambda path, r, kind: write(path, r * [10.0, 5.0], "V", constant=[10.0, 5.0], kind=kind),
    "one bridge": lambda path, r, kind: write(path, r * [2.5, 1.0], ["V", "V/V"], constant=2.5, kind=kind),
}


@pytest.mark.parametrize(("form", "unit"), [*((form, ", unit: mV/V") for form in FORMS), ("measured", "")])
def test_static_runs_of_ratios_are_calibrated_and_applied(form, unit, tmp_path):
    _, readings = ratios()
    path = FORMS[form](tmp_path / "r.h5", readings, "static")
    assert calibrate(tmp_path, path, unit) == pytest.approx(C, rel=2e-3, abs=2e-9)
    call("apply", tmp_path / "c.h5", path, "-o", tmp_path / "l.csv", "--zero", "first")


def test_an_import_keeps_ratios(tmp_path):
    loads, readings = ratios()
    rows = [f"{fx:g},{fz:g},{a:.9g},{b:.9g}" for (fx, fz), (a, b) in zip(loads[:, [0, 2]], 1e3 * readings, strict=True)]
    (tmp_path / "t.csv").write_text("\n".join(["Fx,Fz,k1,k2", *rows]))
    channels = "channels: {k1: {name: B1, unit: mV/V}, k2: {name: B2, unit: mV/V}}\n"
    loads_text = "loads: {Fx: {component: Fx, unit: N}, Fz: {component: Fz, unit: N}}\n"
    runs = "runs: [{file: '*.csv', kind: static, trim: a}]\n"
    (tmp_path / "m.yaml").write_text(f"format: balance-import/1\nrig: r\n{channels}{loads_text}{runs}")
    call("import", tmp_path / "m.yaml", tmp_path / "t.csv", "-o", tmp_path / "runs")
    assert calibrate(tmp_path, tmp_path / "runs" / "t.h5") == pytest.approx(C, rel=2e-3, abs=2e-9)


def test_all_forms_of_a_sampled_run_are_the_same_record(tmp_path):
    _, readings = ratios()
    runs = [open_run(FORMS[form](tmp_path / f"{i}.h5", readings, "zero")) for i, form in enumerate(FORMS)]
    for run in runs:
        assert run.reading_units == {"B1": "V/V", "B2": "V/V"}
        np.testing.assert_allclose(run.read().channels, readings, rtol=1e-6)
    write_run(tmp_path / "again.h5", runs[0])
    assert open_run(tmp_path / "again.h5").digest == runs[0].digest


def test_millivolts_are_volts(tmp_path):
    _, readings = ratios()
    run = open_run(write(tmp_path / "r.h5", 1e3 * readings, "mV"))
    assert run.reading_units == {}
    np.testing.assert_allclose(run.read().channels, readings, rtol=1e-6)


def test_a_bridge_without_supply_reads_nothing(tmp_path):
    _, readings = ratios()
    volts = np.where(np.arange(24) == 5, 0.0, VOLTS)
    run = open_run(write(tmp_path / "r.h5", readings * VOLTS[:, None], "V", volts, kind="static"))
    assert run.samples == 23 and run.bridged


@pytest.mark.parametrize(
    ("stored", "declared", "words"),
    [
        ("V", ", unit: mV/V", ["is in V", "declares it in V/V", "bridge_excitation"]),
        ("mV/V", ", unit: V", ["is in V/V", "declares it in V", "`unit` of the channel"]),
        ("count", ", unit: mV/V", ["is in 1", "declares it in V/V"]),
    ],
)
def test_a_run_in_another_unit_than_its_calibration_is_refused(stored, declared, words, tmp_path):
    _, readings = ratios()
    calibrate(tmp_path, write(tmp_path / "r.h5", readings, "V" if declared == ", unit: V" else "V/V"), declared)
    other = write(tmp_path / "w.h5", readings, stored)
    text = call("apply", tmp_path / "c.h5", other, "-o", tmp_path / "l.csv", "--zero", "first", status=2)
    assert all(word in " ".join(text.split()) for word in [*words, "w.h5", "B1"])
    assert not (tmp_path / "l.csv").exists()


@pytest.mark.parametrize(
    ("unit", "excitation", "constant", "words"),
    [
        ("N", None, None, "its unit is N"),
        (["V", "V", "V"], None, None, "3 units for 2 channels"),
        ("V", VOLTS[:9], None, "9 rows, but 24 rows"),
        ("V", np.ones((24, 3)), None, "0 names for 3 columns"),
        ("V", VOLTS, 10.0, "as dataset and as attribute"),
        ("V", None, -10.0, "is no voltage"),
        ("V", None, [10.0, 10.0, 10.0], "3 values for 2 channels"),
        ("V", np.array([b"ten"] * 24), None, "is not a complete table"),
    ],
)
def test_faults_of_units_and_excitations_are_named(unit, excitation, constant, words, tmp_path):
    run, faults = read_run(write(tmp_path / "r.h5", ratios()[1], unit, excitation, constant))
    assert run is None and any(words in str(fault) for fault in faults)
