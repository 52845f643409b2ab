"""A file for each weight: the tables are one load series, and not as many zeros."""

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.campaign.recording.load_table import read_load_table, runs_of_table
from balance_cli.campaign.recording.single_load_tables import joined_single_loads
from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.io.errors import UserError

CHANNELS = [{"name": name, "unit": "mV/V"} for name in ("B1", "B2")]
RIG = {"format": "balance-geometry/1", "name": "g", "rig": "r", "channels": CHANNELS, "components": ["Fx", "My"]}
C0 = np.array([[2e-3, 1e-4], [-3e-4, 5e-3]])
"""[mV/V] per N and N m."""
LOADS = [(0, 0), (50, 0), (-50, 0), (0, 20), (0, -20), (30, 15), (-30, 15)]


def write_tables(folder, head="Fx [N],My [N m],B1 [mV/V],B2 [mV/V]", change=0.0):
    rng = np.random.default_rng(8)
    for k, load in enumerate(LOADS):
        rows = [(*load, *(C0 @ load + [0.1, -0.2] + 1e-6 * rng.standard_normal(2))) for _ in range(5)]
        rows[-1] = (rows[-1][0] + change, *rows[-1][1:])
        (folder / f"load-{k}.csv").write_text(
            head + "\n" + "".join(",".join(map(repr, map(float, r))) + "\n" for r in rows)
        )
    return sorted(folder.glob("load-*.csv"))


def test_tables_of_one_load_each_are_calibrated_with_one_zero(tmp_path):
    calibration = bal.calibrate(write_tables(tmp_path), geometry_from_dict(RIG))
    (trim,) = calibration.trims.values()
    np.testing.assert_allclose(trim.C0, 1e-3 * C0, rtol=1e-3, atol=1e-9)
    assert trim.runs == ("load-0..load-6",) and trim.rows == len(LOADS)


def test_runs_of_one_load_each_are_told_to_have_a_zero_each(tmp_path):
    """Run files are not joined: nothing says in which order they were recorded."""
    geometry = geometry_from_dict(RIG)
    runs = [run for path in write_tables(tmp_path) for run in runs_of_table(read_load_table(path, geometry), geometry)]
    with pytest.raises(UserError, match="each of 7 runs has one load and a zero of its own") as caught:
        bal.calibrate(runs, geometry)
    assert "load-2.csv, 4 more" in str(caught.value) and "load-3" not in str(caught.value)


@pytest.mark.parametrize("how", ["a load that changes within a table", "two tables", "labels"])
def test_other_tables_keep_their_zeros(tmp_path, how):
    paths = write_tables(tmp_path, change=5.0 if how.startswith("a load") else 0.0)
    if how == "labels":
        for path in paths:
            head, *rows = path.read_text().splitlines()
            path.write_text("\n".join([f"series,{head}", *(f"a,{row}" for row in rows)]) + "\n")
    tables = [read_load_table(path, geometry_from_dict(RIG)) for path in paths]
    assert joined_single_loads(tables[:2] if how == "two tables" else tables) is None
