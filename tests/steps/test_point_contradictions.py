"""Known loads beside those of `apply`, and zeros in another unit, contradict the loads: they are flagged and named."""

import csv

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.calibration.result import Calibration
from balance_cli.cli import balance
from balance_cli.io.artefacts import load_artefact

LINEAR = np.eye(6) + 0.1 * np.random.default_rng(1).normal(size=(6, 6))
ZERO = np.array([0.2, -0.3, 0.1, 0.4, -0.15, 0.25])
NAMES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
HEADS = ["series", "point", *(f"{name} [{'N' if name[0] == 'F' else 'N m'}]" for name in NAMES)]


def _write(path, series, loads, rng, stated=None, unit="mV/V"):
    """Write rows of loads (m, 6) [N, N m] of a linear balance of 100 N and 100 N m, of which others may be stated."""
    zeros = ZERO + 3e-4 * rng.normal(size=(max(series) + 1, 6))
    read = zeros[series] + loads / 100.0 @ LINEAR + 2e-5 * rng.normal(size=loads.shape)
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*HEADS, *(f"B{c} [{unit}]" for c in range(6))])
        kinds = np.where(loads.any(axis=1), "load", "tare")
        for number, kind, row, values in zip(series, kinds, loads if stated is None else stated, read, strict=True):
            own = [f"{value:.7f}" for value in (*row, *values)]
            table.writerow([number, kind, *own])


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("apply"), np.random.default_rng(2)
    parts = [np.outer([0.0, 50.0, 100.0, -100.0, -50.0, 0.0], axis) for axis in np.eye(6)]
    _write(folder / "points.csv", np.repeat(np.arange(6), 6), np.vstack(parts), rng)
    channels = [{"name": f"B{c}", "unit": "mV/V"} for c in range(6)]
    (folder / "g.yaml").write_text(
        yaml.safe_dump({"format": "balance-geometry/1", "name": "a", "rig": "r", "channels": channels})
    )
    made = _invoke("calibrate", "-g", folder / "g.yaml", folder / "points.csv", "-o", folder / "cal.h5")
    assert made.exit_code == 0
    return folder


def _invoke(*words):
    return CliRunner().invoke(balance, [str(word) for word in words])


def _apply(folder, change=lambda loads: None, **more):
    """The warnings, and the flags of 20 rows, of a test with known loads after a `change` of these."""
    rng = np.random.default_rng(3)
    loads = np.vstack([np.zeros(6), rng.uniform(-80.0, 80.0, (20, 6))])
    stated = loads.copy()
    change(stated)
    _write(folder / "t.csv", np.zeros(21, int), loads, rng, stated, **more)
    done = _invoke("apply", folder / "cal.h5", folder / "t.csv", "-o", folder / "l.csv")
    assert done.exit_code == 0
    with (folder / "l.csv").open() as file:
        return done.stderr, [row["flag"] for row in csv.DictReader(file)]


def test_known_loads_that_hold_contradict_nothing(calibrated):
    said, flags = _apply(calibrated)
    assert "differ from the known" not in said and not any("contradicted" in flag for flag in flags)


@pytest.mark.parametrize(("factor", "cause"), [(-1.0, "of the other sign"), (1.0 / 4.4482216, "in lbf")])
def test_a_known_load_that_contradicts_is_named_with_its_cause(calibrated, factor, cause):
    def spoil(loads):
        loads[:, 1] *= factor

    said, flags = _apply(calibrated, spoil)
    assert "differ from the known Fy by" in said and f"the known Fy seems to be {cause}" in said
    assert said.count("differ from the known") == 1 and all("model contradicted Fy" in flag for flag in flags)


def test_zeros_tell_a_wrong_unit_of_the_readings(calibrated):
    said, flags = _apply(calibrated, lambda loads: loads.fill(0.0), unit="uV/V")
    assert "the zeros of its channels are a thousandth of those of the calibration" in said
    assert all("model contradicted Fx Fy Fz Mx My Mz" in flag for flag in flags)


def test_a_calibration_that_does_not_describe_its_own_loads_says_so_first_and_flags_loads(calibrated, tmp_path):
    """Fy of every other series is 0.8 of the true one: sigma contains it, but nothing had said so."""
    rng = np.random.default_rng(4)
    series = np.repeat(np.arange(8), 10)
    loads = rng.uniform(-100.0, 100.0, (80, 6))
    loads[::10] = 0.0
    stated = loads * np.where((series % 2 == 1)[:, None], [1.0, 0.8, 1.0, 1.0, 1.0, 1.0], 1.0)
    _write(tmp_path / "points.csv", series, loads, rng, stated)
    made = _invoke("calibrate", "-g", calibrated / "g.yaml", tmp_path / "points.csv", "-o", tmp_path / "cal.h5")
    words = "the calibration does not describe its own loads"
    assert made.exit_code == 0 and made.stdout.startswith(words) and words in made.stderr
    stored = load_artefact(tmp_path / "cal.h5", {"balance-calibration/1": Calibration}).content
    assert stored.consistency[0].startswith(words)
    _write(tmp_path / "t.csv", np.zeros(21, int), loads[:21], rng)
    done = _invoke("apply", tmp_path / "cal.h5", tmp_path / "t.csv", "-o", tmp_path / "l.csv")
    assert words in done.stderr
    with (tmp_path / "l.csv").open() as file:
        assert all("model contradicted Fy" in row["flag"] for row in csv.DictReader(file))
