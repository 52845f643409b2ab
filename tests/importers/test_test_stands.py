"""Exports of loggers, oscilloscopes and test stands whose heads had given wrong names, times or units."""

import numpy as np
import pytest
import yaml

from balance_cli.campaign.recording.import_map import MappedChannel
from balance_cli.campaign.recording.recorded_time import date_of_start
from balance_cli.importers import open_foreign
from balance_cli.importers.base import ChannelGroup, ForeignChannel
from balance_cli.importers.stated_clock import stated_rates
from balance_cli.importers.time_axis import read_time_axis
from balance_cli.importers.uneven_times import evened_group
from balance_cli.io.errors import UserError
from balance_cli.io.table_text import read_table
from balance_cli.io.text_format import find_encoding
from balance_cli.steps.import_channels import FoundChannel
from balance_cli.steps.import_level import rms_about_drift
from balance_cli.steps.import_pieces import joined_pieces
from balance_cli.steps.import_signals import channel_signal
from balance_cli.steps.import_sketch import sketch_map

COUNT = 60
TIME = np.arange(COUNT) / 20.0
X = np.round(np.random.default_rng(7).uniform(-9, 9, (COUNT, 2)), 4)
GRAPHTEC = 'Vendor,"GRAPHTEC Corporation"\nModel,"GL000"\nSampling interval,50ms\nAMP settings\nCH,Input,Unit\n'
GRAPHTEC += "CH1,DC,[mV]\nData\nNumber,Date,Time,ms,A,B\nNO.,Date,Time,ms,mV,A\n"
LABCHART = "Interval=\t0.05 s\nTimeFormat=\tStartOfBlock\nChannelTitle=\tA\tB\nRange=\t2.000 V\t50.0 mmHg\n"
LABCHART += "UnitName=\t*\tmmHg\nTopValue=\t*\t56.44\nBottomValue=\t*\t-0.09\n"
KYOWA = '"タイトル","試験"\n"サンプリング周波数(Hz)",20\n"CH名称","A","B"\n"CH No","CH1","CH2"\n"レンジ",10,10\n'
KYOWA += '"オフセット",0,0\n"単位","mV","με"\n'
TEKTRONIX = "Model,MDO\nHorizontal Units,S,\nSample Interval,0.05,\nProbe Attenuation,10,1\nVertical Units,V,V\n"
TEKTRONIX += "Vertical Offset,0,0\nTIME,A,B\n"
SCANNER = "Source:\ta.svd\nComponent:\tRoot\nSignal:\tTime - Velocity\n\nTime\tA\tB\n[ s ]\t[ m/s ]\t[ V ]\n"
TUNNEL = "Nr\tTime\tangle\tA\tB\tV\n/\tH:M:S\tdegrees\tsteps\tsteps\tm/s\n"
ANALOG = "File_Type:\tAnalog\tGeneration#:\nBitDepth:\t16\tPreciseRate:\nName\tA\tB\nRate\t20\t20\nRange\t10000\t5000\n"
PLATE = "NO_OF_SAMPLES\t60\nFREQUENCY\t20\nDESCRIPTION\tForce data\nA\tB\tCOP_X\n"


def rows(form):
    return "".join(form.format(t=TIME[k], a=X[k, 0], b=X[k, 1], **parts(k)) + "\n" for k in range(COUNT))


def parts(k):
    return {"k": k + 1, "h": f"12:00:{k // 20:02d}", "ms": 50 * (k % 20), "sa": f"{X[k, 0]:+.4f}".replace("-", "- ")}


DIALECTS = {
    "Graphtec": (GRAPHTEC + rows("{k},2024/03/11,{h},{ms},{a:+},{b:+}"), "A: {name: A, unit: mV}"),
    "Graphtec, signs apart": (GRAPHTEC + rows("{k},2024/03/11,{h},{ms},{sa},{b:+}"), "A: {name: A, unit: mV}"),
    "LabChart": (LABCHART + rows("{t:.2f}\t{a}\t{b}"), "time: column 1\ntime_unit: s  # the head states the same"),
    "Kyowa": (KYOWA + rows("{t:.2f},{a},{b}"), "A: {name: A, unit: mV}"),
    "Tektronix": (TEKTRONIX + rows("{t:.2f},{a},{b}"), "time: TIME"),
    "a laser vibrometer": (SCANNER + rows("{t:.6e}\t{a}\t{b}"), "B: {name: B, unit: V}"),
    "Cortex": (ANALOG + rows("{t:.2f}\t{a}\t{b}"), "time: column 1"),
    "a head with dashes beside empty cells": (
        "Devices,,\nPlate 1 - Force,,\nTime,A,B\ns,mV,mV\n" + rows("{t:.2f},{a},{b}"),
        "A: {name: A, unit: mV}",
    ),
    "a monitor of Arduino": ("12:00:00.000 -> x,A,B\n" + rows("{h}.{ms:03d} -> {k},{a},{b}"), "time: column 1"),
    "a thrust stand with fewer cells than names": (
        "Time (s),A (mV),B (kgf),App message,Message,Acceleration (RPM/s),\n" + rows("{t:.2f},{a},{b},,"),
        "#   the rows have no cells for the last names of the head: Acceleration (RPM/s)",
    ),
}


def opened(tmp_path, text, encoding="utf-8"):
    (tmp_path / "run-1.txt").write_bytes(text.encode(encoding))
    return open_foreign(tmp_path / "run-1.txt")


def whole(file, name):
    group = next(group for group in file.groups if name in group.names)
    return group.read([group.names.index(name)], 0, group.samples)[:, 0]


@pytest.mark.parametrize(("text", "said"), DIALECTS.values(), ids=DIALECTS)
def test_names_times_and_values(tmp_path, text, said):
    file = opened(tmp_path, text)
    np.testing.assert_array_equal(np.column_stack([whole(file, "A"), whole(file, "B")]), X)
    sketch = sketch_map([file], None)
    assert said in sketch
    time = whole(file, yaml.safe_load(sketch)["time"])
    np.testing.assert_allclose(time - time[0], TIME, atol=1e-6)
    assert {"No.", "ms", "Number", "NO."}.isdisjoint(yaml.safe_load(sketch)["channels"])


def test_units_that_are_none_of_readings_are_units(tmp_path):
    """Cells of the row of units were names: `H:M:S`, `hPa`, `m` in s for V in m/s."""
    file = opened(tmp_path, TUNNEL + rows("{k}\t{h}\t-2.0\t{a}\t{b}\t54.8"))
    units = {channel.name: channel.unit for group in file.groups for channel in group.channels}
    assert units == {"Nr": "", "Time": "s", "angle": "degrees", "A": "steps", "B": "steps", "V": "m/s"}
    entries = yaml.safe_load(sketch_map([file], None))["channels"]
    assert entries["A"] == {"name": "A", "unit": "steps", "scale": "TODO"}
    assert entries["V"] == {"name": "V", "unit": "V", "scale": "TODO"}  # volts for one m/s


@pytest.mark.parametrize("head", ["A,T,V\nA,B,C\n", "Rig,Rig,Rig\nt,A,N\n", "Force,Force,Torque\nX,Y,Z\n"])
def test_names_below_names_are_no_units(tmp_path, head):
    file = opened(tmp_path, head + rows("{t:.2f},{a},{b}"))
    assert {channel.unit for channel in file.groups[0].channels} == {""}
    assert [channel.name for channel in file.groups[0].channels] == head.splitlines()[1].split(",")


@pytest.mark.parametrize(("text", "encoding"), [(KYOWA, "cp932"), ("时间,载荷一,载荷二,温度\n", "gb18030")])
def test_east_asian_code_pages(tmp_path, text, encoding):
    file = opened(tmp_path, text.replace("με", "μ").replace('"A"', '"荷重"') + rows("{t:.2f},{a},{b},1"), encoding)
    assert {"荷重", "载荷一"} & {name for group in file.groups for name in group.names}


@pytest.mark.parametrize("text", ["Größe;Länge;Weiß\n", "µε;°C;Öß\n", "température;été;Ünïté\n", "50 Ω · ±5 °\n"])
def test_western_text_stays_western(text):
    assert find_encoding(text.encode("cp1252", "ignore")) == "cp1252"


def test_settings_beside_the_data_are_no_channels(tmp_path):
    settings = ["Record Length,60,,", "Sample Interval,5.0e-02,,", "Source,CH1,,"]
    lines = [f"{settings[k] if k < 3 else ',,,'}{TIME[k]:.6f},{X[k, 0]},\n" for k in range(COUNT)]
    entries = yaml.safe_load(sketch_map([opened(tmp_path, "".join(lines))], None))
    assert entries["time"] == "column 4" and list(entries["channels"]) == ["column 5"]


@pytest.mark.parametrize(
    ("head", "rate"),
    [
        ("Interval=\t0.001 s\n", 1000.0),
        ("//  Update Rate: 100.0Hz\n", 100.0),
        (PLATE, 20.0),
        ("FREQUENCY\t50\n", None),
        ("Interval of tests: 5\n", None),
        ("Display update rate: 2 Hz\n", None),
    ],
)
def test_rates_of_heads(head, rate):
    assert stated_rates(head.splitlines()) == (() if rate is None else (rate,))


# ---- what a sketch makes of units and names --------------------------------------------------------------------------


def sketch(tmp_path, head, name="run-1.txt", values="{t:.2f},{a},{b}"):
    (tmp_path / name).write_text(head + rows(values), encoding="utf-8")
    text = sketch_map([open_foreign(tmp_path / name)], None)
    return text, yaml.safe_load(text)


def test_a_scale_is_for_the_base_unit(tmp_path):
    """The comment said volts for one unit, of kN: an import by it was 1000 times off."""
    text, _ = sketch(tmp_path, "t [s],P [kN],I [A]\n")
    assert "unit: kN, scale: TODO}  # volts for one N, or remove it" in text
    assert "unit: V, scale: TODO}  # the file says A; scale: volts for one A, or remove it" in text


@pytest.mark.parametrize(("unit", "reading"), [("counts", "1"), ("steps", "1"), ("mV/V", "V/V"), ("mV", "V")])
def test_readings_stay_in_the_unit_that_a_geometry_may_declare(tmp_path, unit, reading):
    file = opened(tmp_path, f"t [s],A [{unit}]\n" + rows("{t:.2f},{a}"))
    signal = channel_signal(FoundChannel("A", file, file.groups[0], 1), MappedChannel(name="A"))
    assert signal.reading_unit == reading


@pytest.mark.parametrize(("name", "unit"), [("load cell", "gf"), ("acc 1", "g")])
def test_grams_of_a_weight_are_no_acceleration(tmp_path, name, unit):
    assert sketch(tmp_path, f"t [s],{name} [g],B [V]\n")[1]["channels"][name]["unit"] == unit


def test_the_speed_of_the_air_is_no_tachometer(tmp_path):
    entries = sketch(tmp_path, "t [s],Air_speed,Speed\n")[1]
    assert entries["rotor"]["channel"] == "Speed" and "Air_speed" in entries["channels"]


def test_components_of_a_wind_run_are_readings(tmp_path):
    """They were loads, which a wind run has none of: the map had no channel that the balance reads."""
    assert set(sketch(tmp_path, "t [s],Fx [N],Fz [N]\n", "wind-1.csv")[1]["channels"]) == {"Fx", "Fz"}
    entries = sketch(tmp_path, "t [s],Fx [N],Fz [N]\n", "sweep-1.csv")[1]
    assert set(entries["loads"]) == {"Fx", "Fz"} and entries["channels"] == "TODO"


def test_torques_of_force_sensors_are_moments(tmp_path):
    head = "t,Fx,Fy,Fz,Tx,wrench.torque.y,T\n"
    loads = sketch(tmp_path, head, "sweep-1.csv", "{t:.2f},{a},{b},1,{a},{b},1")[1]["loads"]
    assert {name: entry["component"] for name, entry in loads.items()} == {
        **{name: name for name in ("Fx", "Fy", "Fz")},
        **{"Tx": "Mx", "wrench.torque.y": "My"},
    }


# ---- times -----------------------------------------------------------------------------------------------------------


def test_rows_of_several_sensors_are_named():
    """They may be samples of one with times of few digits, which they were taken for without a word."""
    times = np.repeat(TIME, 2)
    axis = read_time_axis(lambda columns, a, b: times[a:b, None], len(times))
    assert axis.rate == pytest.approx(40.0, rel=1e-3) and "each is there 2 times: rows of several sensors" in axis.note
    times = np.repeat(TIME**1.05, 2)
    with pytest.raises(UserError, match=r"each time is there 2 times") as caught:
        read_time_axis(lambda columns, a, b: times[a:b, None], len(times))
    assert "Save the rows of each sensor" in caught.value.remedy


@pytest.mark.parametrize(("samples", "missing"), [(12, 6), (60, 9), (200, 100), (1000, 500)])
def test_a_missing_sample_in_a_short_record_is_found(samples, missing):
    """The rate was up to 2.5 % off: half a step to either side of a straight line passed for rounding."""
    times = np.delete(np.arange(samples + 1), missing) / 1000.0
    with pytest.raises(UserError, match="a step is 2 times the others") as caught:
        read_time_axis(lambda columns, a, b: times[a:b, None], samples)
    assert caught.value.place == f"sample {missing + 1}"


@pytest.mark.parametrize("rate", [96.0, 104.17, 333.3, 990.0, 1017.3])
@pytest.mark.parametrize("samples", [15, 40, 700])
def test_rounded_times_have_no_missing_sample(rate, samples):
    times = np.round(0.123 + np.arange(samples) / rate, 3)
    axis = read_time_axis(lambda columns, a, b: times[a:b, None], samples)
    assert axis.rate == pytest.approx(rate, rel=0.5 / samples)


def test_a_computer_that_was_late_once_has_no_missing_sample():
    times = TIME.copy()
    times[30] += 0.6 / 20.0
    assert read_time_axis(lambda columns, a, b: times[a:b, None], COUNT).rate == pytest.approx(20.0, rel=1e-2)


def test_a_time_that_is_there_twice_is_taken_once():
    jitter = np.random.default_rng(3).uniform(-0.01, 0.01, COUNT)
    times = np.concatenate([TIME[:1], TIME + jitter])
    times[0] = times[1]
    values = np.concatenate([[99.0], np.sin(times[1:])])
    values[:2] = values[1], 99.0

    group = ChannelGroup(
        (ForeignChannel("A", "V"),), len(times), lambda columns, a, b: values[a:b, None][:, list(columns)]
    )
    evened = evened_group(group, times, 20.0)
    assert evened is not None and "1 of 61 rows have the time of the row above" in evened.note
    read = evened.group.read([0], 0, evened.group.samples)[:, 0]
    at = times[0] + np.arange(len(read)) / 20.0
    np.testing.assert_allclose(read, np.sin(at), atol=1e-4)


def test_the_even_one_of_two_times_is_taken(tmp_path):
    """The first was, at which a computer got the samples in bursts."""
    lines = "".join(f"{0.15 * (k // 3) + 0.001 * (k % 3):.3f},{1000 + 50 * k},{X[k, 0]}\n" for k in range(COUNT))
    file = opened(tmp_path, "Timestamp [s],t [ms],A\n" + lines)
    assert yaml.safe_load(sketch_map([file], None))["time"] == "t"


def test_temperatures_of_all_files_are_no_channels(tmp_path):
    (tmp_path / "zero-1.csv").write_text("t [s],A [V],T1 [degC],Temp [C]\n" + rows("{t:.2f},{a},{b},20"))
    (tmp_path / "zero-2.csv").write_text("t [s],A [V]\n" + rows("{t:.2f},{a}"))
    one, two = open_foreign(tmp_path / "zero-1.csv"), open_foreign(tmp_path / "zero-2.csv")
    entries = yaml.safe_load(sketch_map([one], None))
    assert entries["temperature"] == {
        **{"T1": {"name": "T1", "unit": "degC"}, "Temp": {"name": "Temp", "unit": "degC"}},
    }
    assert set(entries["channels"]) == {"A"}
    assert "temperature" not in yaml.safe_load(sketch_map([one, two], None))


def test_a_drift_is_not_in_the_level_of_an_excitation():
    """`check` warned of a level that nobody had stated."""
    noise = np.random.default_rng(5).normal(size=(20000, 2))
    record = noise + np.exp(-np.arange(20000.0) / 7000.0)[:, None] * [0.0, 20.0] + 50.0
    blocks = [(start, record[start : start + 6000]) for start in range(0, 20000, 6000)]
    level = rms_about_drift(blocks, 20000)
    assert level[0] == pytest.approx(record[:, 0].std(), rel=1e-9) and level[1] == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(
    ("start", "date"), [(1.7e9 + 0.25, "2023-11-14T22:13:20.250"), (0.0, None), (3.9e9, None), (None, None)]
)
def test_dates_of_the_times_are_those_of_the_record(start, date):
    assert date_of_start(start) == date


def test_a_bad_row_of_a_joined_record_is_named_with_its_file(tmp_path):
    for part in range(2):
        lines = [f"{TIME[k] + 3.0 * part:.2f},{X[k, 0]}" for k in range(COUNT)]
        lines[30] += "x" * part
        (tmp_path / f"zero-{part}.csv").write_text("t [s],A [V]\n" + "\n".join(lines) + "\n")
    files = [open_foreign(tmp_path / f"zero-{part}.csv") for part in range(2)]
    joined = joined_pieces(files, {"A"}, "t")
    assert len(joined) == 1
    with pytest.raises(UserError, match="not a number") as caught:
        joined[0].groups[0].read([1], 0, joined[0].groups[0].samples)
    assert caught.value.file.endswith("zero-1.csv") and caught.value.place.startswith("row 32")


def test_a_point_table_may_have_other_units_beside_those_of_readings(tmp_path):
    (tmp_path / "points.txt").write_text(TUNNEL + rows("{k}\t{h}\t-2.0\t{a}\t{b}\t54.8"))
    table = read_table(tmp_path / "points.txt")
    assert table.header == ("Nr", "Time", "angle", "A", "B", "V") and table.units[3:] == ("steps", "steps", "m/s")
    (tmp_path / "points.txt").write_text("Rig\tRig\tRig\nN\tA\tT\n" + rows("{a}\t{b}\t{a}"))
    assert read_table(tmp_path / "points.txt").header == ("N", "A", "T")
