"""A matrix of readings in mV/V or counts, written by a calibration and read back."""

import numpy as np
import pytest
from click.testing import CliRunner

import balance_cli as bal
from balance_cli.cli import balance

GEOMETRY = """format: balance-geometry/1
name: two
rig: two
channels: [{{name: B1, unit: {unit}}}, {{name: B2, unit: {unit}}}]
components: [Fx, My]
"""
BASE = {"V": 1.0, "mV/V": 1e-3, "count": 1.0}


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


def write_table(folder, unit, size):
    """Readings of two loads, one channel curved, in the unit that the geometry declares."""
    rng = np.random.default_rng(9)
    steps = [0, 50, 100, 50, 0, -50, -100, -50, 0]
    loads = [(step, 0) for step in steps] + [(0, 0.2 * step) for step in steps]
    rows = []
    for Fx, My in loads:
        b1, b2 = 0.02 * Fx + 0.003 * My + 1e-5 * Fx**2, -0.001 * Fx + 0.05 * My
        rows.append((Fx, My, *(size * (np.array([0.3 + b1, -0.2 + b2]) + 1e-5 * rng.standard_normal(2)))))
    head = f"Fx [N],My [N m],B1 [{unit}],B2 [{unit}]\n"
    (folder / "table.csv").write_text(head + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows))
    (folder / "geometry.yaml").write_text(GEOMETRY.format(unit=unit))


@pytest.mark.parametrize(("unit", "size"), [("V", 1.0), ("mV/V", 1.0), ("count", 4e6)])
def test_a_matrix_has_the_unit_of_its_readings(tmp_path, unit, size):
    write_table(tmp_path, unit, size)
    rig, matrix = tmp_path / "geometry.yaml", tmp_path / "matrix.csv"
    terms = ("--terms", "quadratic", "-o", tmp_path / "fit.h5", "--matrix", matrix)
    call("calibrate", "-g", rig, tmp_path / "table.csv", *terms)
    call("calibrate", "-g", rig, "--from-matrix", matrix, "-o", tmp_path / "read.h5")
    fit, read = (bal.load_artefact(tmp_path / name).all_trims.model for name in ("fit.h5", "read.h5"))
    for name in fit.terms:
        column = list(read.terms).index(name)
        np.testing.assert_allclose(read.coefficients[column], fit.coefficients[list(fit.terms).index(name)], rtol=1e-9)
    at_100 = 0.02 * 100 * size * BASE[unit]
    assert fit.coefficients[list(fit.terms).index("Fx")][0] == pytest.approx(at_100, rel=1e-3)


def test_a_matrix_in_another_unit_than_the_geometry_is_refused(tmp_path):
    write_table(tmp_path, "mV/V", 1.0)
    rig, matrix = tmp_path / "geometry.yaml", tmp_path / "matrix.csv"
    call("calibrate", "-g", rig, tmp_path / "table.csv", "-o", tmp_path / "fit.h5", "--matrix", matrix)
    rig.write_text(GEOMETRY.format(unit="V"))
    said = call("calibrate", "-g", rig, "--from-matrix", matrix, "-o", tmp_path / "read.h5", status=2)
    assert "`zero`: has readings in V/V, but the geometry declares `B1` in V" in said.output
