"""Calibration from what the head of a point table says: no geometry, or one without the units of the readings."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.load_table import TableReading
from balance_cli.campaign.recording.table_geometry import declare_table_units, geometry_of_table, read_table_head
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.cli import balance
from balance_cli.io.errors import UserError

GEOMETRY = "format: balance-geometry/1\nname: a\nrig: r\nchannels: [{name: B1}, {name: B2}]\ncomponents: [Fx, Fz]\n"
C = np.array([[1e-5, 2e-7], [3e-7, 4e-6]])


def write(path, head="Fx [N],Fz [N],B1 [mV/V],B2 [mV/V]", scale=(1.0, 1.0, 1e3, 1e3), extra=""):
    """Two loads one after the other, up and down, with noise of 0.05 uV/V."""
    ramp = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0, -0.5, -1.0, -0.5])
    loads = np.vstack([np.outer(ramp, [100.0, 0.0]), np.outer(ramp, [0.0, 400.0])])
    readings = loads @ C.T + 5e-8 * np.random.default_rng(3).normal(size=loads.shape)
    rows = np.hstack([loads, readings]) * scale
    path.write_text(head + "\n" + "\n".join(",".join(f"{v:.9g}" for v in row) + extra for row in rows) + "\n")
    return path


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result.output


def test_the_head_tells_loads_channels_and_labels(tmp_path):
    path = write(tmp_path / "p.csv", "Fx [N],Fz (N),B1 [mV/V],B2 mV/V,series,time [s],B1_std [mV/V]", extra=",1,5,2e-5")
    head = read_table_head(path)
    assert (head.hub_loads, head.loads, head.labels) == (("Fx", "Fz"), (), ("series",))
    assert head.channels == {"B1": "V/V", "B2": "V/V"} and head.rows == 24


def test_a_table_without_geometry_calibrates_like_one_with(tmp_path):
    """The same matrix to all digits, in V/V, and loads back from readings."""
    path = write(tmp_path / "p.csv")
    text = call("calibrate", path, "-o", tmp_path / "a.h5", "--json", tmp_path / "a.json")
    assert "B1, B2 of p.csv are the channels, Fx, Fz the loads" in text
    (tmp_path / "g.yaml").write_text(GEOMETRY.replace("B1}", "B1, unit: mV/V}").replace("B2}", "B2, unit: mV/V}"))
    call("calibrate", "-g", tmp_path / "g.yaml", path, "-o", tmp_path / "b.h5", "--json", tmp_path / "b.json")
    a, b = (json.loads((tmp_path / name).read_text())["trims"]["table"]["C0"] for name in ("a.json", "b.json"))
    assert a == b and a["B1"]["Fx"]["value"] == pytest.approx(1e-5, rel=1e-3)
    call("apply", tmp_path / "a.h5", path, "-o", tmp_path / "l.csv", "--zero", "first")


def test_units_in_the_head_declare_channels_that_have_none(tmp_path):
    """The result equals that of a geometry with `unit: mV/V`; a table in V then no longer fits."""
    path = write(tmp_path / "p.csv")
    (tmp_path / "g.yaml").write_text(GEOMETRY)
    call("calibrate", "-g", tmp_path / "g.yaml", path, "-o", tmp_path / "c.h5", "--json", tmp_path / "c.json")
    C0 = json.loads((tmp_path / "c.json").read_text())["trims"]["table"]["C0"]
    assert C0["B2"]["Fz"]["value"] == pytest.approx(4e-6, rel=1e-3)
    volts = write(tmp_path / "v.csv", "Fx [N],Fz [N],B1 [V],B2 [V]", (1, 1, 1, 1))
    assert "geometry declares channel `B1` in V/V" in call("apply", tmp_path / "c.h5", volts, "-o", "l.csv", status=2)


def test_a_cell_keeps_its_volts(tmp_path):
    """Its sensitivity is in V/N: a table in mV/V contradicts the geometry."""
    cell = {"name": "z", "position": [0, 0, 0], "axis": [0, 0, 1], "stiffness": 1e6, "full_range": 100.0}
    channels = [{"name": "B1", "cell": "z", "sensitivity": 1e-5}, {"name": "B2"}]
    made = {"format": "balance-geometry/1", "name": "a", "rig": "r", "cells": [cell], "channels": channels}
    geometry = declare_table_units(Geometry.model_validate(made), [write(tmp_path / "p.csv")], TableReading())
    assert [channel.reading_unit for channel in geometry.channels] == ["V", "V/V"]


def test_volts_beside_the_excitation_are_ratios(tmp_path):
    path = write(tmp_path / "p.csv", "Fx [N],Fz [N],B1 [mV],B2 [mV],excitation [V]", (1, 1, 1e4, 1e4), ",10.0")
    assert [channel.reading_unit for channel in geometry_of_table(path).channels] == ["V/V", "V/V"]
    call("calibrate", path, "-o", tmp_path / "a.h5", "--json", tmp_path / "a.json")
    C0 = json.loads((tmp_path / "a.json").read_text())["trims"]["table"]["C0"]
    assert C0["B1"]["Fx"]["value"] == pytest.approx(1e-5, rel=1e-3)


@pytest.mark.parametrize(
    ("head", "fault"),
    [
        ("N1 [N],N2 [N],B1 [mV/V],B2 [mV/V]", "direction of `N1`, `N2` is not known"),
        ("a,b,B1 [mV/V],B2 [mV/V]", "no column of a hub load"),
        ("Fx [N],Fz [N],B1,B2", "no column of readings"),
    ],
)
def test_what_the_head_does_not_tell_is_asked_for(tmp_path, head, fault):
    with pytest.raises(UserError, match=fault):
        geometry_of_table(write(tmp_path / "p.csv", head))
    assert "-g GEOMETRY" in call("calibrate", tmp_path / "p.csv", "-o", tmp_path / "x.h5", status=2)


def test_run_files_need_their_geometry(tmp_path):
    text = call("calibrate", "sample_data/static-bare.h5", "-o", tmp_path / "x.h5", status=2)
    assert "no geometry is given" in text and not (tmp_path / "x.h5").exists()


def test_check_says_what_a_table_is(tmp_path):
    path = write(tmp_path / "p.csv", "Fx [lbf],N1 [N],B1 [mV/V],B2 [mV/V]")
    text = call("check", path)
    assert "point table: 24 rows, loads Fx, N1, channels B1, B2" in text and "0 with faults" in text
    (tmp_path / "g.yaml").write_text(GEOMETRY)
    assert "has no column of `Fz`" in call("check", "-g", tmp_path / "g.yaml", path, status=2)
    good = write(tmp_path / "q.csv")
    call("calibrate", good, "-o", tmp_path / "a.h5")
    call("apply", tmp_path / "a.h5", good, "-o", tmp_path / "l.csv", "--zero", "first")
    assert "made by `balance apply`" in call("check", tmp_path / "l.csv")


def test_a_head_with_readings_named_by_the_loads_needs_no_geometry(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("Fx [mV/V],My [mV/V],applied Fx [N],applied My [N m]\n0.1,0.2,0,0\n1.1,0.3,10,-5\n")
    head = read_table_head(path)
    assert (head.hub_loads, head.channels) == (("Fx", "My"), {"Fx": "V/V", "My": "V/V"})


def test_the_text_says_why_a_row_is_not_counted(tmp_path):
    """Two readings of one load in succession are one load point."""
    path = tmp_path / "points.csv"
    loads = [0, 10, 20, 30, 20, 20, 10, 0, -10, -20]
    rows = [f"{load},{0.1 + 0.02 * load + 1e-5 * (k % 3)}" for k, load in enumerate(loads)]
    path.write_text("Fz [N],B1 [mV/V]\n" + "\n".join(rows) + "\n")
    output = call("calibrate", path, "-o", tmp_path / "c.h5")
    assert "9 of 10 rows (check points and repetitions aside)" in output
