"""Linear matrices: plain CSV in both directions, and the XML of ATI with published numbers of a Gamma sensor."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.calibration.ati_matrix import read_ati_matrix
from balance_cli.calibration.linear_matrix import read_linear_csv
from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.io.table_text import read_table

AXES = """
<Axis Name="Fx" values=" -0.27053  -0.14278   0.35224 -32.30108  -0.22111  32.83006 " max="130" scale="2.33993181642138"/>
<Axis Name="Fy" values="  0.21616  37.46357   0.05722 -18.83819   0.35126 -18.85998 " max="130" scale="2.33993181642138"/>
<Axis Name="Fz" values=" 18.48980  -0.25078  18.75502  -0.41293  18.60017  -0.58878 " max="400" scale="0.747981765296576"/>
<Axis Name="Tx" values="  0.05325   0.15667 -32.28492   0.82744  32.26505  -1.25235 " max="10" scale="44.8196831994584"/>
<Axis Name="Ty" values=" 37.31421  -0.62445 -18.43472   0.63319 -18.48677   0.60638 " max="10" scale="44.8196831994584"/>
<Axis Name="Tz" values=" -0.13536 -18.46474   0.04406 -18.57097   0.27123 -18.80438 " max="10" scale="43.1398206760749"/>
<BasicTransform Dx="0" Dy="0" Dz="0.0120142" Rx="0" Ry="0" Rz="0"/>
"""  # noqa: E501
USER_AXES = """
<UserAxis Name="Fx" values=" -0.11562  -0.06102   0.15054 -13.80428  -0.09449  14.03035 " max="130"/>
<UserAxis Name="Fy" values="  0.09238  16.01054   0.02446  -8.05074   0.15012  -8.06005 " max="130"/>
<UserAxis Name="Fz" values=" 24.71959  -0.33527  25.07417  -0.55206  24.86714  -0.78715 " max="400"/>
<UserAxis Name="Tx" values="  0.00230   0.19585  -0.72004  -0.07826   0.72169  -0.12478 " max="10"/>
<UserAxis Name="Ty" values="  0.83393  -0.01320  -0.41312   0.17997  -0.41133  -0.15503 " max="10"/>
<UserAxis Name="Tz" values=" -0.00314  -0.42802   0.00102  -0.43048   0.00629  -0.43589 " max="10"/>
"""
UNITS = 'ForceUnits="N" TorqueUnits="N-m" DistUnits="m"'


def ati(axes: str, units: str = UNITS) -> str:
    calibration = f"<Calibration {units}>{axes}</Calibration>"
    return f'<?xml version="1.0"?>\n<FTSensor Serial="FT1" NumGages="6">{calibration}</FTSensor>'


def test_scaled_axes_and_user_axes_agree() -> None:
    """The vendor's own matrix (UserAxis, five decimals) follows from the scaled one and the moved origin."""
    user, scaled = read_ati_matrix(ati(AXES + USER_AXES), "f"), read_ati_matrix(ati(AXES), "f")
    assert user.T0[4] == pytest.approx([0.83393, -0.0132, -0.41312, 0.17997, -0.41133, -0.15503])
    np.testing.assert_allclose(scaled.T0, user.T0, atol=1e-5)
    assert user.full_range == pytest.approx([130, 130, 400, 10, 10, 10])
    assert user.name == "FT1"


def test_units_of_the_vendor_are_converted() -> None:
    imperial = read_ati_matrix(ati(USER_AXES, 'ForceUnits="lbf" TorqueUnits="lbf-in"'), "f")
    metric = read_ati_matrix(ati(USER_AXES), "f")
    assert imperial.T0[:3] == pytest.approx(4.4482216 * metric.T0[:3])
    assert imperial.T0[3:] == pytest.approx(0.11298483 * metric.T0[3:])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<FTSensor>", "not well-formed"),
        ("<a/>", "no element `Calibration`"),
        (ati(USER_AXES, 'ForceUnits="stone" TorqueUnits="N-m"'), "Calibration, ForceUnits: unknown unit"),
        (ati(USER_AXES.replace("0.09238", "x")), "UserAxis Fy, values: "),
        (ati(USER_AXES.replace('"Tz"', '"Tq"')), "has no axis `Tz`"),
        (ati(AXES.replace('Rx="0"', 'Rx="5"')), "turns the axes"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a/>', "document type"),
        (ati(USER_AXES.replace(" 24.71959", " 0 0 0 0 0 0 24.7")), "unequal length"),
    ],
)
def test_faults_of_vendor_files(text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        read_ati_matrix(text, "f.cal")


T0 = np.array([[100.0, 2.0, -1.0], [3.0, 250.0, 4.0]])


def table(tmp_path: Path, text: str):
    path = tmp_path / "m.csv"
    path.write_text(text)
    return read_table(path)


def test_plain_csv_in_both_directions(tmp_path: Path) -> None:
    loads = table(tmp_path, ",B1 [mV/V],B2 [mV/V],B3 [mV/V],range\nFx [N],100,2,-1,500\nMy [N m],3,250,4,60\n")
    matrix = read_linear_csv(loads, ("Fx", "My"), ("B1", "B2", "B3"))
    np.testing.assert_allclose(matrix.T0, 1e3 * T0)
    assert matrix.full_range == pytest.approx([500, 60])
    C0 = np.linalg.pinv(T0)
    rows = "".join(f"B{i + 1} [mV/V],{row[1] * 0.11298483},{row[0] * 4.4482216}\n" for i, row in enumerate(C0))
    readings = table(tmp_path, f"channel,My [in-lbf],Fx [lbf]\n{rows}range,531,112.4\n")
    other = read_linear_csv(readings, ("Fx", "My"), ("B1", "B2", "B3"))
    np.testing.assert_allclose(other.T0, 1e3 * T0)
    assert other.full_range == pytest.approx([500, 60], rel=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (",B1 [V],B2 [V]\nFx [N],1,2\n", "has component `My` 0 times"),
        (",B1,B2 [V]\nFx [N],1,2\nMy [N m],1,3\n", "column `B1`: has no unit"),
        (",B1 [V],B2 [V]\nFx,1,2\nMy [N m],1,3\n", "line 2, column `Fx`: has no unit"),
        (",B1 [V],B2 [V]\nFx [N],1,2\nMy [N m],1,2\n", "does not determine 2 loads"),
        (",B1 [V],B2 [V]\nFx [N],1,2\nMy [N m],1,x\n", "line 3, column"),
        (",p [V],q [V]\na,1,2\nb,1,x\n", "names neither components"),
    ],
)
def test_faults_of_plain_matrices(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        read_linear_csv(table(tmp_path, text), ("Fx", "My"), ("B1", "B2"))


def call(*words, status: int = 0) -> str:
    done = CliRunner().invoke(balance, [str(word) for word in words])
    assert done.exit_code == status, done.output
    return done.output


def test_a_vendor_matrix_is_applied_and_written_again(tmp_path: Path) -> None:
    channels = ", ".join(f"{{name: G{i}}}" for i in range(6))
    (tmp_path / "g.yaml").write_text(f"format: balance-geometry/1\nname: g\nrig: r\nchannels: [{channels}]\n")
    (tmp_path / "ft.cal").write_text(ati(USER_AXES))
    g, cal = ("-g", tmp_path / "g.yaml"), tmp_path / "cal.h5"
    call("calibrate", *g, "--from-matrix", tmp_path / "ft.cal", "--linear-matrix", tmp_path / "again.csv", "-o", cal)
    expected = read_ati_matrix(ati(USER_AXES), "f")
    volts = np.array([0.1, -0.2, 0.3, 0.05, 0.02, -0.1])
    readings = pd.DataFrame([np.full(6, 0.7), 0.7 + volts], columns=[f"G{i} [V]" for i in range(6)])
    readings.to_csv(tmp_path / "r.csv", index=False)
    call("apply", cal, tmp_path / "r.csv", "--zero", "first", "-o", tmp_path / "l.csv")
    loads = pd.read_csv(tmp_path / "l.csv")
    assert loads.iloc[1, 2:8].to_numpy(float) == pytest.approx(expected.T0 @ volts, abs=1e-6)
    assert loads.iloc[1, 8:14].isna().all()
    assert loads["flag"][1].startswith("untested")
    assert "matrix without zeros" in call("apply", cal, tmp_path / "r.csv", "-o", tmp_path / "l.csv", status=2)
    call("calibrate", *g, "--from-matrix", tmp_path / "again.csv", "--linear-matrix", tmp_path / "b.cal", "-o", cal)
    again = read_ati_matrix((tmp_path / "b.cal").read_text(), "f")
    np.testing.assert_allclose(again.T0, expected.T0, atol=1e-9)
    call("report", cal, "-o", tmp_path / "page.html")


def test_check_loads_have_no_coverage_where_no_interval_is_known(tmp_path: Path) -> None:
    """The noise of a linear matrix is not known: an interval that is not known covers neither all nor nothing."""
    geometry = "format: balance-geometry/1\nname: g\nrig: r\nchannels: [{name: B}]\ncomponents: [Fx]\n"
    (tmp_path / "g.yaml").write_text(geometry)
    (tmp_path / "m.csv").write_text("component,B [V],range\nFx [N],100,50\nnote,1,1\n")
    (tmp_path / "check.csv").write_text("Fx [N],B [V]\n0,0.01\n10,0.111\n20,0.209\n")
    words = ("-g", tmp_path / "g.yaml", "--from-matrix", tmp_path / "m.csv", "--hold-out", tmp_path / "check.csv")
    text = call("calibrate", *words, "-o", tmp_path / "cal.h5")
    assert "interval not known" in text
    assert "0.0 %" not in text
    call("report", tmp_path / "cal.h5", "-o", tmp_path / "page.html")
    assert "interval not known" in (tmp_path / "page.html").read_text()
    text = call("apply", tmp_path / "cal.h5", tmp_path / "check.csv", "--zero", "first", "-o", tmp_path / "l.csv")
    assert "not known" in text


def test_a_linear_matrix_needs_no_geometry(tmp_path: Path) -> None:
    """Plain CSV in both directions, and a vendor's file, whose channels are numbered."""
    (tmp_path / "t0.csv").write_text("component,B1 [mV/V],B2 [mV/V],range\nFx [N],100,0,200\nFz [N],10,200,200\n")
    (tmp_path / "c0.csv").write_text("channel,Fx [N],Fz [N]\nB1 [mV/V],0.01,0\nB2 [mV/V],-5e-4,0.005\nrange,200,200\n")
    (tmp_path / "p.csv").write_text("B1 [mV/V],B2 [mV/V]\n0,0\n1,0.5\n")
    for name in ("t0.csv", "c0.csv"):
        call("calibrate", "--from-matrix", tmp_path / name, "-o", tmp_path / "c.h5")
        call("apply", tmp_path / "c.h5", tmp_path / "p.csv", "--zero", "first", "-o", tmp_path / "l.csv")
        loads = pd.read_csv(tmp_path / "l.csv")
        assert loads["Fx [N]"][1] == pytest.approx(100.0) and loads["Fz [N]"][1] == pytest.approx(110.0)
    (tmp_path / "s.cal").write_text(ati(USER_AXES))
    assert "G0, G1, G2, G3, G4, G5 are the channels" in call(
        "calibrate", "--from-matrix", tmp_path / "s.cal", "-o", tmp_path / "v.h5"
    )
    (tmp_path / "bad.csv").write_text("component,B1\nFx [N],1\n")
    words = call("calibrate", "--from-matrix", tmp_path / "bad.csv", "-o", tmp_path / "x.h5", status=2)
    assert "has no channels with their units" in words and not (tmp_path / "x.h5").exists()


def test_the_linear_matrix_of_a_curved_channel_is_the_best_straight_line(tmp_path: Path) -> None:
    """The slope of the model at zero load was off by as much as the curvature has added at full load."""
    load = np.concatenate([np.linspace(0, 400, 11), np.linspace(400, 0, 11)[1:]])
    reading = 1e-3 + 8e-3 * load * (1 - 8e-5 * load) + 2e-6 * np.random.default_rng(2).standard_normal(load.size)
    rows = "".join(f"{x},{y:.9f}\n" for x, y in zip(load, reading, strict=True))
    (tmp_path / "p.csv").write_text(f"Fx [N],B [mV/V]\n{rows}")
    (tmp_path / "g.yaml").write_text(
        "format: balance-geometry/1\nname: g\nrig: r\nchannels: [{name: B, unit: mV/V}]\ncomponents: [Fx]\n"
    )
    words = ("-g", tmp_path / "g.yaml", tmp_path / "p.csv", "--linear-matrix", tmp_path / "m.csv")
    assert "Fx^2" in call("calibrate", *words, "-o", tmp_path / "c.h5")
    found = read_linear_csv(read_table(tmp_path / "m.csv"), ("Fx",), ("B",)).T0[0, 0]
    straight = 1e3 / np.polyfit(load, reading, 1)[0]
    assert found == pytest.approx(straight, rel=1e-3)
