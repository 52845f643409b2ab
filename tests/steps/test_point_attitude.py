"""Attitudes in point tables: they tell the weight of the metric part, which is taken off the loads, or are named."""

import csv
import json

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance

WEIGHT, CENTER = 80.0, np.array([0.03, -0.02, 0.1])
ATTITUDES = [(0, 30), (0, -30), (20, 0), (-20, 0), (15, 90), (0, 60)]
ATTITUDE_RANGE = np.array([200.0, 200.0, 500.0, 40.0, 40.0, 30.0])


def invoke(*words):
    return CliRunner().invoke(balance, [str(word) for word in words])


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def tilted_table(path, points, seed=1, angles=("pitch [deg]", "roll [deg]")):
    """Write points (series, kind, pitch, roll, loads) of a balance that carries a weight; angles in deg."""
    rng = np.random.default_rng(seed)
    linear = np.linalg.qr(np.random.default_rng(5).standard_normal((6, 6)))[0]
    heads = ",".join(f"{name} [{'N' if name[0] == 'F' else 'N m'}]" for name in COMPONENTS)
    lines = [f"series,point,{','.join(angles)},{heads},{','.join(f'B{i} [mV/V]' for i in range(6))}"]
    for series, kind, pitch, roll, loads in points:
        theta, phi = np.radians([pitch, roll])
        g = np.array([np.sin(theta), -np.cos(theta) * np.sin(phi), -np.cos(theta) * np.cos(phi)])
        x = (loads + np.r_[WEIGHT * g, np.cross(WEIGHT * CENTER, g)]) / ATTITUDE_RANGE
        reading = x @ linear + 0.01 * x**2 + 2e-4 * rng.standard_normal(6) + 0.3
        own = [f"{value:.6f}" for value in (pitch, roll, *loads, *reading)]
        lines.append(",".join([str(series), kind, *own]))
    path.write_text("\n".join(lines))


def test_attitudes_of_a_table_tell_the_weight_and_take_it_off_the_loads(tmp_path):
    loads = ATTITUDE_RANGE * np.eye(6)
    ramps = [
        (f"{j}{side}", kind, 0, 0, side * share * loads[j])
        for j in range(6)
        for side in (1, -1)
        for kind, share in (("tare", 0.0), ("load", 0.25), ("load", 0.5), ("load", 0.75), ("load", 1.0))
    ]
    tilts = [(f"a{i}", "tare", *angles, np.zeros(6)) for i, angles in enumerate(ATTITUDES)]
    applied = [(10, 0, np.zeros(6)), (10, 0, 0.4 * loads[2]), (-5, 20, 0.3 * loads[0]), (0, 0, 0.5 * loads[4])]
    tilted_table(tmp_path / "cal.csv", ramps + tilts)
    tilted_table(tmp_path / "level.csv", ramps)
    tilted_table(tmp_path / "t.csv", [("t", "tare", 0, 0, np.zeros(6)), *(("t", "load", *each) for each in applied)], 2)
    tilted_table(tmp_path / "r.csv", [("t", "load", *each) for each in applied], 3)
    tilted_table(tmp_path / "z.csv", [("z", "tare", 10, 0, np.zeros(6))] * 3, 4)
    for name in ("cal", "level"):
        made = invoke(
            "calibrate", tmp_path / f"{name}.csv", "-o", tmp_path / f"{name}.h5", "--json", tmp_path / "c.json"
        )
        tares = json.loads((tmp_path / "c.json").read_text())["all_trims"]["tares"]
        assert made.exit_code == 0 and (tares is None) == (name == "level")
        if tares is not None:
            assert abs(tares["weight"]["value"] - WEIGHT) < 0.1 and "columns not used" not in made.stderr
    for words in ((tmp_path / "t.csv",), (tmp_path / "r.csv", "--zero", tmp_path / "z.csv")):
        assert invoke("apply", tmp_path / "cal.h5", *words, "-o", tmp_path / "l.csv").exit_code == 0
        table = rows_of(tmp_path / "l.csv")
        errors = np.array([[float(row[key]) for key in row if key.startswith("error_")] for row in table])
        sigma = np.array([[float(row[key]) for key in row if key.startswith("sigma_")] for row in table])
        assert np.all(np.abs(errors) < 4.5 * sigma) and not any("weight" in row["flag"] for row in table)
    lines = [line.split(",") for line in (tmp_path / "t.csv").read_text().splitlines()]
    (tmp_path / "n.csv").write_text("\n".join(",".join([*cells[:2], *cells[4:]]) for cells in lines))
    unstated = invoke("apply", tmp_path / "cal.h5", tmp_path / "n.csv", "-o", tmp_path / "l.csv")
    assert (
        "n.csv states no attitude and counts as level" in unstated.stderr and "another attitude" not in unstated.stderr
    )
    assert all("no weight" in row["flag"] for row in rows_of(tmp_path / "l.csv"))
    plain = invoke("apply", tmp_path / "level.h5", tmp_path / "t.csv", "-o", tmp_path / "l.csv")
    flags = [row["flag"] for row in rows_of(tmp_path / "l.csv")]
    assert "3 of 5 rows were read in another attitude than their zero" in plain.stderr
    assert ["no weight" in flag for flag in flags] == [False, True, True, True, False]


@pytest.mark.parametrize(
    ("angles", "said"),
    [
        (("pitch [deg]", "yaw [deg]"), "no roll, which is taken as 0"),
        (("pitch [deg]", "yaw [deg]"), "`yaw [deg]` not used: yaw turns the rig about the vertical"),
        (("pitch", "roll [deg]"), "has no unit"),
        (("pitch [N m]", "roll [N m]"), "columns not used: pitch [N m], roll [N m]"),
    ],
)
def test_what_a_table_says_of_its_attitude_is_used_or_named(tmp_path, angles, said):
    points = [("a", "tare", 1, 2, np.zeros(6)), *(("a", "load", 1, 2, row) for row in ATTITUDE_RANGE * np.eye(6))]
    tilted_table(tmp_path / "t.csv", points, angles=angles)
    geometry = {"format": "balance-geometry/1", "name": "g", "rig": "g", "components": list(COMPONENTS)}
    geometry["channels"] = [{"name": f"B{i}", "unit": "mV/V"} for i in range(6)]
    (tmp_path / "g.yaml").write_text(yaml.safe_dump(geometry))
    result = invoke("calibrate", "-g", tmp_path / "g.yaml", tmp_path / "t.csv", "-o", tmp_path / "c.h5")
    assert said in result.stderr
