"""Tables as laboratories write them, with their mistakes, through `calibrate` and `apply`.

Synthetic: a six-axis rig in lbf with units in a second row, a three-axis cell in counts with semicolons and decimal
commas, an eight-channel sensor in uV with absolute outputs, an external balance in kN with combined loads.
"""

import csv
import json
from dataclasses import dataclass

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance

LBF, IN_LBF = 4.4482216152605, 0.1129848290276167


@dataclass(frozen=True)
class Laboratory:
    """A table as text, the rows that are wrong, and what the geometry has to say."""

    text: str
    rows: int
    channels: tuple[str, ...]
    unit: str
    wrong: tuple[int, ...] = ()
    components: tuple[object, ...] = ()


def ramps(components, steps, sides=(1,)):
    """Each load up and down after a tare point: loads (m, k) over their range, and series (m,)."""
    up = np.arange(1, steps + 1) / steps
    values = np.r_[0.0, up, up[-2::-1]]
    parts = [np.outer(side * values, np.eye(components)[j]) for j in range(components) for side in sides]
    return np.vstack(parts), np.repeat(np.arange(len(parts)), len(values))


def read_channels(x, series, channels, rng):
    """Readings (m, c) with curvature, hysteresis, zeros of the series and noise, of a balance by chance."""
    k = x.shape[1]
    linear = rng.standard_normal((k, channels))
    while np.linalg.cond(linear) > 8.0:
        linear = rng.standard_normal((k, channels))
    squares = 2e-3 * rng.standard_normal((k, channels)) * (rng.random((k, channels)) < 0.4)
    direction = np.sign(np.diff(x, axis=0, prepend=x[:1]))
    zeros = 3e-3 * rng.standard_normal((series[-1] + 1, channels))
    noise = 2e-4 * rng.standard_normal((len(x), channels))
    return x @ linear + x**2 @ squares + 2e-4 * direction @ linear + zeros[series] + noise


def exchange(loads, i, j):
    """Loads with two rows exchanged."""
    swapped = loads.copy()
    swapped[[i, j]] = loads[[j, i]]
    return swapped


def six_axis_rig():
    """lbf and in-lbf, units in a second row, comments; two weights are entered in each other's rows."""
    rng = np.random.default_rng(21)
    x, series = ramps(6, 5)
    volts = 1.2 * read_channels(x, series, 6, rng)
    loads = exchange(x * [200, 200, 400, 600, 600, 300], 6, 8)
    lines = ["# bench 2, 12 March", "Series,Fx,Fy,Fz,Mx,My,Mz," + ",".join(f"B{i}" for i in range(1, 7))]
    lines.append(",lbf,lbf,lbf,in-lbf,in-lbf,in-lbf" + ",mV/V" * 6)
    for number, row, reading in zip(series, loads, volts, strict=True):
        lines.append(",".join([str(number + 1), *(f"{v:.2f}" for v in row), *(f"{v:.5f}" for v in reading)]))
    return Laboratory("\n".join(lines), len(x), tuple(f"B{i}" for i in range(1, 7)), "mV/V", (7, 9))


def three_axis_cell():
    """Counts about half of their range, decimal commas, a column of zeros."""
    rng = np.random.default_rng(22)
    x, series = ramps(3, 4, (1, -1))
    counts = 1e5 * read_channels(x, series, 3, rng) + 2**23
    lines = ["Kraftmessdose, 04.05.2021", "Series;Fx [N];Fy [N];Fz [N];Mx [Nm];K1 [count];K2 [count];K3 [count]"]
    for number, row, reading in zip(series, x * [50, 50, 100], counts, strict=True):
        cells = [str(number + 1), *(f"{v:.3f}" for v in row), "0,0", *(f"{v:.0f}" for v in reading)]
        lines.append(";".join(cells).replace(".", ","))
    return Laboratory("\n".join(lines), len(x), ("K1", "K2", "K3"), "count", (), ("Fx", "Fy", "Fz"))


def eight_channel_sensor():
    """Poses without order in uV, tabs, absolute outputs; in one row a decimal point has slipped."""
    rng = np.random.default_rng(23)
    x = np.vstack([np.zeros((3, 6)), rng.uniform(-1, 1, (90, 6)), np.zeros((2, 6))])
    volts = 500.0 * read_channels(x, np.zeros(len(x), np.intp), 8, rng) + 1500.0
    volts[40, 4] *= 10.0
    lines = ["\t".join(["Pose", "Fx (N)", "Fy (N)", "Fz (N)", "Mx (N-m)", "My (N-m)", "Mz (N-m)"])]
    lines[0] += "".join(f"\tch{i} (uV)" for i in range(1, 9))
    for number, (row, reading) in enumerate(zip(x * [100, 100, 200, 5, 5, 5], volts, strict=True), 1):
        lines.append("\t".join([str(number), *(f"{v:.4f}" for v in row), *(f"{v:.2f}" for v in reading)]))
    return Laboratory("\n".join(lines), len(x), tuple(f"ch{i}" for i in range(1, 9)), "V", (41,))


def external_balance():
    """kN and kN m of named components, both directions and combined loads; two rows of different series exchanged."""
    rng = np.random.default_rng(24)
    x, series = ramps(6, 4, (1, -1))
    for i in range(6):
        rows = np.outer([0.25, 0.5, 0.75, 1.0], np.eye(6)[i]) + 0.6 * np.eye(6)[(i + 1) % 6]
        x, series = np.vstack([x, np.zeros((1, 6)), rows]), np.r_[series, np.full(5, series[-1] + 1)]
    volts = 5.0 * read_channels(x, series, 6, rng)
    loads = exchange(x * [2, 2, 6, 0.8, 0.8, 0.8], 21, 51)
    names = ("Drag", "Side", "Lift", "Roll", "Pitch", "Yaw")
    units = ["kN"] * 3 + ["kN m"] * 3
    lines = [
        "% weights by hand",
        "Run,Series,Point," + ",".join(f"{n} [{u}]" for n, u in zip(names, units, strict=True)),
    ]
    lines[1] += "".join(f",R{i} [mV]" for i in range(1, 7))
    for number, applied, row, reading in zip(series, x, loads, volts, strict=True):
        kind = "load" if applied.any() else "tare"
        lines.append(
            ",".join(["ext", str(number + 1), kind, *(f"{v:.4f}" for v in row), *(f"{v:.5f}" for v in reading)])
        )
    axes = [("direction" if q < 3 else "moment", np.eye(3)[q % 3].tolist()) for q in range(6)]
    components = tuple({"name": name, kind: axis} for name, (kind, axis) in zip(names, axes, strict=True))
    return Laboratory("\n".join(lines), len(x), tuple(f"R{i}" for i in range(1, 7)), "V", (22, 52), components)


@pytest.mark.parametrize("make", [six_axis_rig, three_axis_cell, eight_channel_sensor, external_balance])
def test_tables_of_laboratories_are_read_and_their_mistakes_are_named(make, tmp_path):
    laboratory = make()
    (tmp_path / "t.csv").write_text(laboratory.text)
    geometry = {"format": "balance-geometry/1", "name": "g", "rig": "g"}
    geometry["channels"] = [{"name": name, "unit": laboratory.unit} for name in laboratory.channels]
    geometry |= {"components": list(laboratory.components)} if laboratory.components else {}
    (tmp_path / "g.yaml").write_text(yaml.safe_dump(geometry))
    words = ["calibrate", "-g", str(tmp_path / "g.yaml"), str(tmp_path / "t.csv"), "-o", str(tmp_path / "c.h5")]
    done = CliRunner().invoke(balance, [*words, "--json", str(tmp_path / "c.json")])
    assert done.exit_code == 0, done.output
    summary = json.loads((tmp_path / "c.json").read_text())
    outliers = summary["all_trims"]["outliers"]
    assert {each["row"] for each in outliers} == set(laboratory.wrong)
    if len(laboratory.wrong) == 2:
        assert {each["exchanged_with"] for each in outliers} == set(laboratory.wrong)
    elif laboratory.wrong:
        assert "seems to read" in outliers[0]["cause"]
    (trim,) = summary["trims"].values()
    assert max(trim["residual_percent_fs"].values()) < 0.3
    words = ["apply", str(tmp_path / "c.h5"), str(tmp_path / "t.csv"), "-o", str(tmp_path / "l.csv"), "--zero", "first"]
    assert CliRunner().invoke(balance, words).exit_code == 0
    with (tmp_path / "l.csv").open() as stream:
        rows = [*csv.DictReader(stream)]
    assert len(rows) == laboratory.rows
    assert all(row["run"] in ("t", "ext") for row in rows)


@pytest.mark.parametrize(
    ("factor", "rated", "words"),
    [
        (1000.0, None, "by a factor of"),
        (0.001, None, "by a factor of"),
        (1000.0, {"Fx": 50, "Fy": 50, "Fz": 100}, "1e+03 times its rated load of 100 N"),
        (1.0, {"Fx": 50, "Fy": 50, "Fz": 100}, ""),
        (1.0, None, ""),
    ],
)
def test_all_loads_of_a_component_in_another_unit_are_doubted(factor, rated, words, tmp_path):
    rng = np.random.default_rng(25)
    x, series = ramps(3, 4)
    volts = read_channels(x, series, 3, rng)
    lines = ["Series,Fx [N],Fy [N],Fz [N],K1 [V],K2 [V],K3 [V]"]
    for number, row, reading in zip(series, x * [50, 50, 100 * factor], volts, strict=True):
        lines.append(",".join([str(number + 1), *(f"{v:.6f}" for v in (*row, *reading))]))
    (tmp_path / "t.csv").write_text("\n".join(lines))
    geometry = {"format": "balance-geometry/1", "name": "g", "rig": "g", "components": ["Fx", "Fy", "Fz"]}
    geometry |= {"channels": [{"name": f"K{i}"} for i in (1, 2, 3)]} | ({"rated_loads": rated} if rated else {})
    (tmp_path / "g.yaml").write_text(yaml.safe_dump(geometry))
    call = ["calibrate", "-g", str(tmp_path / "g.yaml"), str(tmp_path / "t.csv"), "-o", str(tmp_path / "c.h5")]
    done = CliRunner().invoke(balance, call)
    assert done.exit_code == 0, done.output
    assert ("scale not verified by anything" in done.output) == (rated is None)
    doubts = [line for line in done.stderr.splitlines() if "right?" in line]
    assert len(doubts) == bool(words) and all(words in line and "Fz" in line for line in doubts)
