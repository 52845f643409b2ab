"""Point tables of static loads: columns, units, labels, moment centers, and faults with their place."""

from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.recording.load_table import TableReading, read_load_table, runs_of_table
from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.campaign.rig.load_components import moment_transfer
from balance_cli.io.errors import UserError
from balance_cli.io.units import parse_unit

CHANNELS = [{"name": "B1", "unit": "mV/V"}, {"name": "B2", "unit": "mV/V"}]


def geometry(**keys):
    base = {"format": "balance-geometry/1", "name": "g", "rig": "r", "channels": CHANNELS, "components": ["Fx", "My"]}
    return geometry_from_dict({**base, **keys})


def read(tmp_path: Path, text: str, reading: TableReading | None = None, **keys):
    path = tmp_path / "points.csv"
    path.write_text(text)
    return read_load_table(path, geometry(**keys), reading)


@pytest.mark.parametrize(
    "head",
    [
        "Fx [lbf],My [in-lbf],B1 [mV/V],B2 [mV/V]",
        "fx (lbf),my (in-lbf),b1 (mV/V),b2 (mV/V)",
        "FX / lbf,MY / in-lbf,B1/mV/V,B-2 (mV/V)",
        "Fx_lbf,My lbf.in,B1 in mV/V,B2_mV/V",
        "Fx,My,B1,B2\nlbf,in-lbf,mV/V,mV/V",
        "Effort Fx (lbf),Moment My (in-lbf),B1 (mV/V),B2 (mV/V)",
        "applied_Fx [lbf],My_load [in-lbf],B1 (mV/V),B2 (mV/V)",
        "known_Fx [lbf],Known_My [in-lbf],B1 (mV/V),B2 (mV/V)",
        "LOAD_FX_lbf,applied_my_in-lbf,B_1_mV/V,B_2 in mV/V",
    ],
)
def test_units_are_converted(tmp_path: Path, head: str) -> None:
    table = read(tmp_path, f"{head}\n0,0,0.5,0.25\n10,-100,1.5,-0.25\n")
    assert table.hub_loads[1] == pytest.approx([44.482216, 0, 0, 0, -11.298483, 0])
    assert table.channels == pytest.approx(np.array([[5e-4, 2.5e-4], [1.5e-3, -2.5e-4]]))
    assert table.unused == ()


def test_weights_on_lever_arms_are_hub_loads(tmp_path: Path) -> None:
    """A rope pulls in two axes, a weight hangs on an arm, beside a load at the hub."""
    points = {
        "arm": {"position": [0.3, 0.0, 0.1], "direction": [0, 0, -2]},
        "rope": {"position": [0.0, 0.2, 0.5], "direction": [0.6, 0.0, 0.8]},
        "mark": {"position": [0.0, 0.0, 0.0]},
    }
    text = "Fx [N],My [N m],arm [kgf],Rope / N,mark [N],B1 [mV/V],B2 [mV/V]\n0,0,0,0,0,1,1\n5,0,2,10,7,2,1\n"
    table = read(tmp_path, text, load_points=points, hub=[0.0, 0.0, 0.1])
    weight = 2 * 9.80665
    # r x F about the hub: (0.3, 0, 0) x (0, 0, -w) = (0, 0.3 w, 0), (0, 0.2, 0.4) x (6, 0, 8) = (1.6, 2.4, -1.2).
    assert table.hub_loads[1] == pytest.approx([11.0, 0.0, 8.0 - weight, 1.6, 0.3 * weight + 2.4, -1.2])
    assert table.unused == ("mark [N]",)
    alone = read(tmp_path, "arm [N],B1 [mV/V]\n0,1\n10,2\n", load_points=points, hub=[0.0, 0.0, 0.1])
    assert alone.hub_loads[1] == pytest.approx([0.0, 0.0, -10.0, 0.0, 3.0, 0.0])
    with pytest.raises(UserError, match="kg"):
        read(tmp_path, "arm [kg],B1 [mV/V]\n0,1\n10,2\n", load_points=points)


def test_default_units_and_labels(tmp_path: Path) -> None:
    reading = TableReading(tuple(map(parse_unit, ("kN", "N m", "mV/V"))))
    text = "No,run,trim,series,point,Fx,My,B1,B2,weather\n1,a,t1,s1,tare,0,0,1,1,3\n2,b,t2,s2,Load,1,0,2,1,4\n"
    table = read(tmp_path, text, reading)
    assert table.hub_loads[1, 0] == 1000.0
    assert table.labels["point"] == ("tare", "load")
    assert table.unused == ("No", "weather")
    runs = runs_of_table(table, geometry())
    assert [(run.name, run.trim, run.samples) for run in runs] == [("a", "t1", 1), ("b", "t2", 1)]
    assert [(run.series_labels, run.point_kinds) for run in runs] == [(("s1",), ("tare",)), (("s2",), ("load",))]


def test_numbered_points_are_no_kinds(tmp_path: Path) -> None:
    table = read(tmp_path, "Point,Fx [N],My [N m],B1 [mV/V],B2 [mV/V]\n1,0,0,1,1\n2,1,0,2,1\n")
    assert "point" not in table.labels


def test_readings_without_loads(tmp_path: Path) -> None:
    table = read(tmp_path, "B1 [mV/V],B2 [mV/V]\n1,2\n")
    assert table.hub_loads is None


@pytest.mark.parametrize("name", ["Excitation", "U_exc", "Speisespannung"])
def test_excitation_makes_a_ratio(tmp_path: Path, name: str) -> None:
    table = read(tmp_path, f"B1 [mV],B2 [mV],{name} [V]\n10,20,5\n10,20,10\n")
    assert table.channels == pytest.approx(np.array([[2e-3, 4e-3], [1e-3, 2e-3]]))


def test_moment_center_is_transferred(tmp_path: Path) -> None:
    """A force Fz = 10 N at x = 0.5 m has My = -5 N m about the origin and none about its own point."""
    assert (moment_transfer((0.5, 0, 0), (0, 0, 0)) @ [0, 0, 10.0, 0, 0, 0])[4] == pytest.approx(-5.0)
    text = "Fz [N],My [N m],B1 [mV/V],B2 [mV/V]\n10,0,1,1\n"
    table = read(tmp_path, text, TableReading(moment_center=(0.5, 0, 0)), components=["Fz", "My"])
    assert table.hub_loads[0] == pytest.approx([0, 0, 10, 0, -5, 0])


def test_components_at_stations(tmp_path: Path) -> None:
    components = [{"name": f"N{i}", "direction": [0, 0, -1], "position": [x, 0, 0]} for i, x in ((1, 0.1), (2, -0.1))]
    text = "N1 [N],N2 [N],B1 [mV/V],B2 [mV/V]\n10,0,1,1\n0,10,1,1\n"
    table = read(tmp_path, text, components=components)
    assert table.hub_loads == pytest.approx(np.array([[0, 0, -10, 0, 1, 0], [0, 0, -10, 0, -1, 0]]))
    hub = read(tmp_path, "Fz [N],My [N m],B1 [mV/V],B2 [mV/V],Fx [N]\n-10,1,1,1,0\n", components=components)
    assert hub.hub_loads[0] == pytest.approx([0, 0, -10, 0, 1, 0])


def test_the_name_alone_goes_before_the_name_with_words(tmp_path: Path) -> None:
    table = read(tmp_path, "Fx applied [N],Fx [N],My [N m],sigma_My [N m],B1 [mV/V],B2 [mV/V]\n9,1,2,8,3,4\n")
    assert table.hub_loads[0] == pytest.approx([1, 0, 0, 0, 2, 0])
    assert table.unused == ("Fx applied [N]", "sigma_My [N m]")


def test_missing_values_are_left_to_the_reader_of_runs(tmp_path: Path) -> None:
    text = HEAD + "1,2,3,4\n1,2,NA,4\n1,2,3,\n1,-,3,4\n1,2,9.9E37,4\n"
    table = read(tmp_path, text, TableReading(allow_missing=True))
    assert np.argwhere(np.isnan(table.channels)).tolist() == [[1, 0], [2, 1], [4, 0]]
    assert np.isnan(table.hub_loads[3]).any() and np.isfinite(table.hub_loads[[0, 1, 2, 4]]).all()
    with pytest.raises(UserError, match="line 3, column `B1"):
        read(tmp_path, text)


HEAD = "Fx [N],My [N m],B1 [mV/V],B2 [mV/V]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "Fx [%],My [N m],B1 [mV/V],B2 [mV/V]\n1,2,3,4\n",
            r"column `Fx \[%\]`: `%` is a unit of 1, where one of N is needed",
        ),
        ("Fx,My [N m],B1 [mV/V],B2 [mV/V]\n1,2,3,4\n", r"points.csv, column `Fx`: has no unit. Write `Fx \[N\]`"),
        ("Fx [mm],My [N m],B1 [mV/V],B2 [mV/V]\n1,2,3,4\n", r"column `Fx \[mm\]`: `mm` is a unit of m"),
        ("Fx [Nn],My [N m],B1 [mV/V],B2 [mV/V]\n1,2,3,4\n", r"column `Fx \[Nn\]`: unknown unit `Nn`"),
        ("Fx [N],Mj [N m],B1 [mV/V],B2 [mV/V]\n1,2,3,4\n", r"has no column of `My`. Is it `Mj \[N m\]`"),
        ("Fx [N],My [N m],C1 [V],C2 [V]\n1,2,3,4\n", "has no column of a channel"),
        ("Fx [N],My [N m],B1 [mV],B2 [mV]\n1,2,3,4\n", "is in mV, but the geometry declares channel `B1` in V/V"),
        ("Fx [N],fx [kN],My [N m],B1 [mV/V]\n1,1,2,3\n", r"`Fx \[N\]` is `Fx` too"),
        (HEAD + "1,2,3,4\n1,x,3,4\n", r"line 3, column `My \[N m\]`: `x` is not a number"),
        ("point," + HEAD + "loading,1,2,3,4\n", "line 2, column `point`: `loading` is no kind"),
        ("series," + HEAD + "a,1,2,3,4\n,1,2,3,4\n", "line 3, column `series`: the label is empty"),
    ],
)
def test_faults_name_line_and_column(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        read(tmp_path, text)


def test_excitation_must_be_positive(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"line 3, column `excitation \[V\]`: an excitation of 0 V"):
        read(tmp_path, "B1 [mV],B2 [mV],excitation [V]\n1,2,5\n1,2,0\n")


@pytest.mark.parametrize("filler", ["-999", "999", "-9999"])
def test_loads_of_nines_far_from_all_others_are_missing(tmp_path: Path, filler: str) -> None:
    rows = "\n".join(f"{fx},0,1,2" for fx in (0, 200, -400, filler, 400))
    table = read(tmp_path, f"Fx [N],My [N m],B1 [mV/V],B2 [mV/V]\n{rows}\n", TableReading(allow_missing=True))
    np.testing.assert_array_equal(table.hub_loads[:, 0], [0, 200, -400, np.nan, 400])
    steps = "\n".join(f"{fx},0,1,2" for fx in (0, 333, 666, 999))
    table = read(tmp_path, f"Fx [N],My [N m],B1 [mV/V],B2 [mV/V]\n{steps}\n", TableReading(allow_missing=True))
    assert table.hub_loads[3, 0] == 999.0


@pytest.mark.parametrize(
    "head",
    [
        "Fx,My,known_Fx,Known_My",
        "Fx,My,Fx [N],My [N m]",
        "Fx [mV/V],My [mV/V],true Fx [N],true My [N m]",
    ],
)
def test_a_channel_with_the_name_of_a_load_is_not_read_as_that_load(tmp_path: Path, head: str) -> None:
    """A column that was both would calibrate itself: residual zero, and loads equal to the readings."""
    reading = TableReading(tuple(map(parse_unit, ("N", "N m", "mV/V"))))
    names = [{"name": "Fx", "unit": "mV/V"}, {"name": "My", "unit": "mV/V"}]
    table = read(tmp_path, f"{head}\n0.1,0.2,0,0\n1.1,0.3,10,-5\n", reading, channels=names)
    assert table.channels == pytest.approx(np.array([[1e-4, 2e-4], [1.1e-3, 3e-4]]))
    assert table.hub_loads is not None
    assert table.hub_loads[1] == pytest.approx([10, 0, 0, 0, -5, 0])


def test_readings_with_the_names_of_loads_are_no_loads(tmp_path: Path) -> None:
    reading = TableReading((parse_unit("mV/V"),))
    names = [{"name": "Fx", "unit": "mV/V"}, {"name": "My", "unit": "mV/V"}]
    assert read(tmp_path, "Fx,My\n0.1,0.2\n", reading, channels=names).hub_loads is None


def test_notes_beside_a_table_in_columns_without_a_name_are_left_out_and_counted(tmp_path: Path) -> None:
    """Spreadsheets write all lines equally long, with empty cells in the head above the notes."""
    text = "Fx [N],My [N m],B1 [mV/V],B2 [mV/V],,,\n0,0,0.1,0.2,,z up,0\n1,0,0.3,0.2,,,\n"
    table = read(tmp_path, text)
    assert table.hub_loads is not None
    assert table.hub_loads[:, 0] == pytest.approx([0.0, 1.0])
    assert table.unused == ("2 without a name in the head",)
    with pytest.raises(UserError, match=r"has 6 columns, the head .line 1. has 4"):
        read(tmp_path, "Fx [N],My [N m],B1 [mV/V],B2 [mV/V]\n0,0,0.1,0.2,,5\n1,0,0.3,0.2,,6\n")


def test_a_unit_in_the_name_of_a_component_is_its_unit(tmp_path: Path) -> None:
    """`--units N` made newtons of it."""
    component = {"name": "pull_lbf", "direction": [0, 0, 1]}
    channel = {"name": "B1", "unit": "V"}
    text = "pull_lbf,B1\n0,0.5\n10,1.5\n"
    table = read(tmp_path, text, TableReading((parse_unit("mV"),)), components=[component], channels=[channel])
    assert table.hub_loads is not None and table.hub_loads[1, 2] == pytest.approx(44.482216)
    reading = TableReading((parse_unit("N"), parse_unit("mV")))
    with pytest.raises(UserError, match="its name ends with the unit lbf, where `--units` says N"):
        read(tmp_path, text, reading, components=[component], channels=[channel])
    component["name"] = "mass_kg"
    with pytest.raises(UserError, match="A mass is no load: write kgf"):
        read(tmp_path, text.replace("pull_lbf", "mass_kg"), reading, components=[component], channels=[channel])


@pytest.mark.parametrize(("unit", "symbol"), [("V", "V"), ("mV/V", "V/V"), ("count", "count")])
def test_the_remedy_names_the_quantity_that_the_geometry_declares(tmp_path: Path, unit: str, symbol: str) -> None:
    channel = {"name": "volts_per_volt", "unit": unit}
    text = "Fx [N],My [N m],volts_per_volt\n0,0,0.5\n"
    with pytest.raises(UserError, match=rf"Write `volts_per_volt \[{symbol}\]`"):
        read(tmp_path, text, channels=[channel])
