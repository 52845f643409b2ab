"""Static loads of point tables: closed forms, zeros, sigma against its own scatter, flags, and the command."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.steps.point_loads import point_loads
from balance_cli.steps.point_readings import _part_tares_between, point_readings, table_of_run

FULL = np.array([500.0, 2000.0, 150.0])
NAMES = ("Fx", "Fz", "My")
UNITS = ("N", "N", "N m")
GEOMETRY = """format: balance-geometry/1
name: g
rig: r
channels: [{name: B1, unit: mV/V}, {name: B2, unit: mV/V}, {name: B3, unit: mV/V}, {name: B4, unit: mV/V}]
components: [Fx, Fz, My]
"""
C = np.array([[1.0, 0.05, -0.02], [0.03, 1.2, 0.04], [-0.05, 0.02, 0.9], [0.6, 0.5, 0.7]]) * 1e-3 / FULL
NOISE = 2e-7


def schedule() -> np.ndarray:
    """Tare first, up and down, one load at a time, at two values of the others."""
    rows = []
    for j in range(3):
        for other in (0.0, 0.4):
            steps = np.array([0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0])
            x = np.zeros((len(steps), 3))
            x[:, j] = steps
            x[:, (j + 1) % 3] = other
            rows.append(x)
    return np.vstack(rows) * FULL


def write_table(path: Path, loads: np.ndarray, rng, zero=0.0, known=True, kinds=None, quadratic=0.0) -> Path:
    x = loads / FULL
    readings = (
        loads @ C.T
        + zero
        + quadratic * np.outer(x[:, 1] ** 2, [0, 0, 1e-3, 0])
        + NOISE * rng.normal(size=(len(loads), 4))
    )
    columns = {
        f"{name} [{unit}]": loads[:, j] for j, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)) if known
    }
    columns |= {f"B{j + 1} [mV/V]": 1e3 * readings[:, j] for j in range(4)}
    table = pd.DataFrame(columns)
    if kinds is not None:
        table.insert(0, "point", kinds)
    table.to_csv(path, index=False)
    return path


def call(*words) -> str:
    done = CliRunner().invoke(balance, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("apply")
    (folder / "g.yaml").write_text(GEOMETRY)
    write_table(folder / "cal.csv", schedule(), np.random.default_rng(1))
    call("calibrate", "-g", folder / "g.yaml", folder / "cal.csv", "--terms", "linear", "-o", folder / "cal.h5")
    return folder


def apply(folder: Path, table: Path, *words) -> pd.DataFrame:
    call("apply", folder / "cal.h5", table, "-o", folder / "loads.csv", *words)
    return pd.read_csv(folder / "loads.csv", keep_default_na=False)


def test_loads_come_back_with_their_sigma(calibrated: Path) -> None:
    """The scatter of the errors over sigma is 1; 42 degrees of freedom tell sigma to 11 %, one standard deviation."""
    rng = np.random.default_rng(2)
    loads = rng.uniform(-0.9, 0.9, (400, 3)) * FULL
    loads[:40] = 0.0
    table = write_table(calibrated / "a.csv", loads, rng, zero=3e-5, kinds=["tare"] * 40 + ["load"] * 360)
    found = apply(calibrated, table)
    for name, unit in zip(NAMES, UNITS, strict=True):
        ratio = found[f"error_{name} [{unit}]"][40:] / found[f"sigma_{name} [{unit}]"][40:]
        assert ratio.std() == pytest.approx(1.0, abs=0.33)
    # The 99.9 % point of the residual test lets one row in a thousand through by chance.
    assert (found["flag"] != "").sum() <= 2


def test_the_zero_may_be_the_first_row_or_a_file_or_unknown(calibrated: Path) -> None:
    rng = np.random.default_rng(3)
    loads = np.vstack([np.zeros(3), rng.uniform(-0.5, 0.5, (5, 3)) * FULL])
    table = write_table(calibrated / "b.csv", loads, rng, zero=5e-5, known=False)
    zero = write_table(calibrated / "zero.csv", np.zeros((9, 3)), rng, zero=5e-5, known=False)
    for words in (("--zero", "first"), ("--zero", zero)):
        found = apply(calibrated, table, *words)
        assert found["Fz [N]"].to_numpy(float) == pytest.approx(loads[:, 1], abs=5.0)
        assert "error_Fz [N]" not in found
        assert (found["flag"] == "").all()
    without = apply(calibrated, table)
    assert without["flag"].str.startswith("no zero").all()
    assert np.abs(without["Fz [N]"].to_numpy(float) - loads[:, 1]).min() > 20.0


def test_sigma_holds_where_the_first_row_is_no_zero_of_the_other_load_series(tmp_path: Path) -> None:
    """Zeros that shift between load series: those of the other series may differ by what the calibration's scatter."""
    (tmp_path / "g.yaml").write_text(GEOMETRY)
    rng = np.random.default_rng(11)
    labels = np.repeat(np.arange(6), 9)
    for path in ("cal.csv", "again.csv"):
        zero = 2e-5 * rng.normal(size=(6, 4))[labels]
        table = pd.read_csv(write_table(tmp_path / path, schedule(), rng, zero=zero))
        table.insert(0, "series", labels)
        table.to_csv(tmp_path / path, index=False)
    words = ("calibrate", "-g", tmp_path / "g.yaml", "--terms", "linear", "-o", tmp_path / "cal.h5")
    call(*words, tmp_path / "cal.csv")
    for stated in (True, False):
        table = pd.read_csv(tmp_path / "again.csv")
        (table if stated else table.drop(columns="series")).to_csv(tmp_path / "t.csv", index=False)
        found = apply(tmp_path, tmp_path / "t.csv", "--zero", "first")
        ratios = np.abs(found.filter(like="error_").to_numpy(float) / found.filter(like="sigma_").to_numpy(float))
        # The one zero of the first series is in all of these errors.
        assert np.mean(ratios[9:]) < 2.0
        assert found["sigma_Fz [N]"][40] > 5 * found["sigma_Fz [N]"][4]


def test_rows_outside_the_calibration_are_flagged_and_kept(calibrated: Path) -> None:
    loads = np.array([[0, 0, 0], [0, 1.5, 0], [0, 0.99, 0]]) * FULL
    found = apply(calibrated, write_table(calibrated / "c.csv", loads, np.random.default_rng(4)), "--zero", "first")
    assert list(found["flag"]) == ["", "extrapolated Fz", ""]
    assert float(found["Fz [N]"][1]) == pytest.approx(3000.0, rel=5e-3)


def test_a_row_without_zero_is_outside_however_uncertain_it_is(tmp_path: Path) -> None:
    """Zeros of the calibration that scatter by a sixth of the range are in sigma, and leave 1.3 times it outside."""
    (tmp_path / "g.yaml").write_text(GEOMETRY)
    rng, labels = np.random.default_rng(12), np.repeat(np.arange(6), 9)
    path = write_table(tmp_path / "far.csv", schedule(), rng, zero=2e-4 * rng.normal(size=(6, 4))[labels])
    call("calibrate", "-g", tmp_path / "g.yaml", "--terms", "linear", "-o", tmp_path / "cal.h5", path)
    found = apply(tmp_path, write_table(tmp_path / "h.csv", np.array([[0, 1.5, 0], [0, 0.3, 0]]) * FULL, rng))
    outside = float(found["Fz [N]"][0]) - FULL[1]
    assert 0.1 * FULL[1] < outside < 2.0 * float(found["sigma_Fz [N]"][0])
    assert "extrapolated Fz" in found["flag"][0] and "extrapolated" not in found["flag"][1]


def test_a_faulty_channel_contradicts_the_others(calibrated: Path) -> None:
    loads = np.array([[0, 0, 0], [0.2, 0.3, 0.1], [0.3, 0.3, 0.1]]) * FULL
    path = write_table(calibrated / "d.csv", loads, np.random.default_rng(5))
    table = pd.read_csv(path)
    table.loc[2, "B4 [mV/V]"] += 0.01
    table.to_csv(path, index=False)
    found = apply(calibrated, path, "--zero", "first")
    assert list(found["flag"]) == ["", "", "redundancy"]
    good, bad = found["sigma_Fx [N]"][1], found["sigma_Fx [N]"][2]
    assert float(bad) > 10 * float(good)


def test_a_channel_may_be_absent(calibrated: Path) -> None:
    loads = np.array([[0, 0, 0], [0.2, 0.3, 0.1]]) * FULL
    path = write_table(calibrated / "e.csv", loads, np.random.default_rng(6))
    pd.read_csv(path).drop(columns="B4 [mV/V]").to_csv(path, index=False)
    found = apply(calibrated, path, "--zero", "first")
    assert list(found["flag"]) == ["untested", "untested"]
    assert float(found["Fx [N]"][1]) == pytest.approx(100.0, abs=1.5)
    pd.read_csv(path).drop(columns="B3 [mV/V]").to_csv(path, index=False)
    done = CliRunner().invoke(
        balance, ["apply", str(calibrated / "cal.h5"), str(path), "-o", str(calibrated / "x.csv")]
    )
    assert done.exit_code == 2
    assert "do not determine the loads (absent: B3, B4)" in done.output


def test_units_and_moment_center_of_the_output(calibrated: Path) -> None:
    """A force Fz at x = 0.1 m has My = -0.1 Fz about the hub, and none about that point."""
    loads = np.array([[0.0, 0, 0], [0.0, 1000, -100.0]])
    path = write_table(calibrated / "f.csv", loads, np.random.default_rng(7), known=False)
    found = apply(calibrated, path, "--zero", "first", "--load-units", "lbf,in-lbf", "--moment-center", 0.1, 0, 0)
    assert float(found["Fz [lbf]"][1]) == pytest.approx(1000 / 4.4482216, rel=5e-3)
    assert abs(float(found["My [lbf in]"][1])) < 5 * float(found["sigma_My [lbf in]"][1])


def test_summary_and_bad_calls(calibrated: Path) -> None:
    path = write_table(calibrated / "g.csv", schedule(), np.random.default_rng(8))
    apply(calibrated, path, "--zero", "first", "--json", calibrated / "s.json")
    summary = json.loads((calibrated / "s.json").read_text())["runs"]["g"]
    assert summary["rows"] == len(schedule())
    assert summary["method"] == "linear"
    assert summary["error"]["Fx"] < 1.0
    for words, fault in [
        (("-o", "x.h5"), "written as .csv"),
        (("-o", "x.csv", "--method", "non-iterative"), "no non-iterative model"),
        (("-o", "x.csv", "--load-units", "mm"), "--load-units: `mm`"),
        (("-o", "x.csv", "--zero", str(path)), "it is no reading of the unloaded balance"),
    ]:
        done = CliRunner().invoke(balance, ["apply", str(calibrated / "cal.h5"), str(path), *words])
        assert done.exit_code == 2
        assert fault in done.output


def test_a_matrix_of_readings_per_supply_gives_the_same_loads(calibrated: Path) -> None:
    """It states that its readings are in V/V: taken for volts, loads would be off by the supply."""
    rng, g, matrix = np.random.default_rng(9), calibrated / "g.yaml", calibrated / "m.csv"
    call(
        "calibrate", "-g", g, calibrated / "cal.csv", "--terms", "linear", "--matrix", matrix, "-o", calibrated / "x.h5"
    )
    call("calibrate", "-g", g, "--from-matrix", matrix, "-o", calibrated / "read.h5")
    assert "V/V" in matrix.read_text()
    loads = np.vstack([np.zeros(3), rng.uniform(-0.5, 0.5, (8, 3)) * FULL])
    table = write_table(calibrated / "m-points.csv", loads, rng)
    found = []
    for calibration in ("x.h5", "read.h5"):
        call("apply", calibrated / calibration, table, "-o", calibrated / "m-loads.csv")
        found.append(pd.read_csv(calibrated / "m-loads.csv"))
    for name, unit in zip(NAMES, UNITS, strict=True):
        one, other = (each[f"{name} [{unit}]"] for each in found)
        np.testing.assert_allclose(other, one, atol=1e-6 * np.ptp(one))


def test_an_unloaded_row_between_two_series_may_belong_to_either():
    """With the first row as the zero its error was 80 times its sigma where the later series had another attitude."""
    series = np.array([0, 0, 0, 0, 1, 1, 1])
    unloaded = np.array([True, False, False, True, False, False, False])
    assert _part_tares_between(series, unloaded).tolist() == [0, 0, 0, 2, 1, 1, 1]


def test_a_load_that_rests_on_one_sensor_is_untested(campaign, calibration) -> None:
    """The torque meter beside the plate alone tells Mz, and one cell Fx, of which the mean of My contains a part."""
    table = table_of_run(campaign.runs_of_kind("static")[0], campaign.geometry)
    loads = point_loads(point_readings(table, calibration, first_is_zero=False), calibration)
    untested = [word.split()[1:] for flag in loads.flags for word in flag.split("; ") if word.startswith("untested")]
    assert len(untested) == len(loads.flags)
    assert all({"Fx", "Mz"} <= set(names) <= {"Fx", "My", "Mz"} for names in untested)


def test_a_zero_that_drifts_between_its_rows_is_in_sigma(calibrated: Path) -> None:
    """First and last row are marked as the zero, and the bridges have crept by 20 times their noise in between."""
    rng, errors = np.random.default_rng(8), []
    for number in range(6):
        loads = rng.uniform(-0.8, 0.8, (40, 3)) * FULL
        loads[[0, -1]] = 0.0
        creep = np.linspace(0.0, 20.0 * NOISE, 40)[:, None] * rng.normal(size=4)
        kinds = ["tare", *["load"] * 38, "tare"]
        table = write_table(calibrated / f"creep{number}.csv", loads, rng, zero=creep, kinds=kinds)
        found = apply(calibrated, table)
        columns = [f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True)]
        errors += [found[f"error_{column}"] / found[f"sigma_{column}"] for column in columns]
    assert np.mean(np.abs(np.concatenate(errors)) < 1.96) > 0.9
