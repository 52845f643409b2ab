"""Text exports as acquisition programs write them: the right numbers, or one clear refusal."""

from datetime import datetime, timedelta

import numpy as np
import pytest
import yaml

from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError
from balance_cli.steps.import_sketch import sketch_map

COUNT = 60
TIME = np.arange(COUNT) / 1000.0
X = np.round(np.random.default_rng(5).uniform(-1, 1, (COUNT, 2)), 6)
X[:, 1] = -np.abs(X[:, 1]) - 1.0
LARGE = np.round(X * 4321, 3)
BEGIN = datetime(2024, 3, 12, 12, 59, 59, 980000)
LVM = "LabVIEW\t\nX_Columns\t{}\n***End_of_Header***\t\n\t\nChannels\t2\t\t\nX0\t0\t0\t\nDelta_X\t{}\t{}\t\n"
LVM += "***End_of_Header***\t\t\t\nX_Value\tA\tB\tComment\n"
CATMAN = "HBM_CATMAN_DATAFILE_40\n\nDatei: lauf 3.ASC\n\nZeit  1 - Standardmessrate\tA\tB\ns\tN\tN\n"
PULSE = "Header Size:\t80\nVersion:\t2\nX-axis unit:\ts\nX-axis delta:\t1.000E-03\nTitle1:\tForce\nTitle2:\tInput\n"
TOA5 = '"TOA5","CR6","1234"\n"TIMESTAMP","RECORD","A","B"\n"TS","RN","N","N"\n"","","Smp","Smp"\n'


def lines(row, count=COUNT):
    return "".join(f"{row(k)}\n" for k in range(count))


def plain(sep, decimal=".", end="", begin="", values=X, form="{:.6f}"):
    def row(k):
        cells = [f"{TIME[k]:.6f}", *(form.format(x) for x in values[k])]
        return begin + sep.join(cells).replace(".", decimal) + end

    return lines(row)


def grouped(value, sign, decimal):
    return f"{value:,.3f}".replace(",", "~").replace(".", decimal).replace("~", sign)


def labview(columns):
    """A file of LabVIEW with two channels in g and its whole head; `columns` of times are One or Multi."""
    gap = "\t\t" if columns == "Multi" else "\t"
    keys = (
        ("Channels", "2"),
        ("Samples", "64" + gap + "64"),
        ("Date", "2022/05/16" + gap + "2022/05/16"),
        ("Time", "13:09:28.4412030687499793341" + gap + "13:09:28.4412030687499793341"),
        ("Y_Unit_Label", "g" + gap + "g"),
        ("X_Dimension", "Time" + gap + "Time"),
        ("X0", "0.0E+0" + gap + "0.0E+0"),
        ("Delta_X", "0.001000" + gap + "0.001000"),
    )
    head = f"LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\t{columns}\n***End_of_Header***\t\n\t\n"
    head += "".join(f"{key}\t{cells}\t\n" for key, cells in keys) + "***End_of_Header***\t\t\n"
    if columns == "Multi":
        rows = lines(lambda k: f"{TIME[k]:.6f}\t{X[k, 0]}\t{TIME[k]:.6f}\t{X[k, 1]}")
        return head + "X_Value\tA\tX_Value\tB\tComment\n" + rows
    return head + "X_Value\tA\tB\tComment\n" + lines(lambda k: f"{TIME[k]:.6f}\t{X[k, 0]}\t{X[k, 1]}")


def with_thousands(sep, sign, decimal, quote=""):
    cell = lambda value: quote + grouped(value, sign, decimal) + quote  # noqa: E731
    return lines(lambda k: sep.join([f"{TIME[k]:.3f}".replace(".", decimal), *map(cell, LARGE[k])]))


def clock(form):
    return lines(lambda k: f"{form(BEGIN + timedelta(milliseconds=k))},{X[k, 0]:.6f},{X[k, 1]:.6f}")


def opened(tmp_path, text, encoding="utf-8"):
    (tmp_path / "zero-1.txt").write_bytes(text.encode(encoding))
    return open_foreign(tmp_path / "zero-1.txt")


def whole(file, name):
    group = next(group for group in file.groups if name in group.names)
    return group.read([group.names.index(name)], 0, group.samples)[:, 0]


RIGHT = {
    "LabVIEW, one column of times": (LVM.format("One", 0.001, 0.001) + plain("\t", end="\t"), X, "time: X_Value"),
    "LabVIEW, none": (LVM.format("No", 0.001, 0.001) + lines(lambda k: f"\t{X[k, 0]}\t{X[k, 1]}\t"), X, "1000"),
    "LabVIEW, with units": (labview("One"), X, "A: {name: A, unit: g,"),
    "LabVIEW, times and values in turn": (labview("Multi"), X, "B: {name: B, unit: g,"),
    "Rigol, start and step beside the names": (
        "X,A,B,Start,Increment,\nSequence,Volt,Volt,-2.500000e-01,1.000000e-03\n"
        + lines(lambda k: f"{k},{X[k, 0]},{X[k, 1]},"),
        X,
        "sample_rate: 1000  # Hz, as the file says\nchannels:\n  A: {name: A, unit: Volt}",
    ),
    "settings of an oscilloscope above times and values": (
        'sep=,\n"Sampling Frequency (Hz)=",1000,,\n"Channel Data","A","B",\n"Attenuation = ",1,1,\n"Scale (V/DIV) = ",'
        '5,2,\n"Inverted = ","NO","NO",\n"Time (s)","Voltage (V)","Voltage (V)",\n' + plain(",", end=","),
        X,
        "time: Time\nchannels:\n  A: {name: A, unit: V}",
    ),
    "an abscissa without a unit": ("X,A (V),B (V)\n" + plain(","), X, "time: X\ntime_unit: s  # assumed"),
    "Visual3D, names above rows of kinds": (
        "\tC:\\r.c3d\tC:\\r.c3d\n\tA\tB\n\tFORCE\tFORCE\n\tORIGINAL\tORIGINAL\nITEM\tX\tX\n"
        + lines(lambda k: f"{k + 1}\t{X[k, 0]}\t{X[k, 1]}"),
        X,
        "A: {name: A, unit: TODO}",
    ),
    "an oscilloscope": ("X,A,B,\nSecond,Volt,Volt,\n" + plain(",", end=","), X, "time: X"),
    "accelerations in g": ("time [s],A [g],B [g]\n" + plain(","), X, "A: {name: A, unit: g,"),
    "catman with a row behind the units": (CATMAN + "Datum 12.03.2024\t\t\n" + plain("\t", ","), X, "time: "),
    "catman with keys": (
        "Channel name:\tTime 1\tA\tB\nUnit:\ts\tN\tN\nSensor:\t\tU10M\tT10F\n" + plain("\t", begin="\t"),
        X,
        "time: Time 1",
    ),
    "DIAdem with descriptions": (
        "Name;Zeit;A;B\nEinheit;s;N;N\nBeschreibung;;vorn;hinten\n" + plain(";", ",", begin=";"),
        X,
        "time: Zeit",
    ),
    "Campbell": (
        TOA5 + lines(lambda k: f'"2024-03-12 12:00:{k / 10:04.1f}",{k},{X[k, 0]},{X[k, 1]}', 50),
        X[:50],
        "time: TIMESTAMP",
    ),
    "numpy.savetxt": ("# run 4\n# t A B\n" + plain(" "), X, "time: t"),
    "write.table of R": ('"t" "A" "B"\n' + lines(lambda k: f'"{k + 1}" {TIME[k]} {X[k, 0]} {X[k, 1]}'), X, "time: t"),
    "an empty first column without a name": ("t,A,B\n" + plain(",", begin=","), X, "time: t"),
    "names in two rows": ("Time,Balance,Balance\n,A,B\ns,N,N\n" + plain(","), X, "time: Time"),
    "remarks with !": ("! stand 4\n! t [s], A [N], B [N]\n" + plain(", "), X, "time: t"),
    "exponents of Fortran": ("t A B\n" + plain(" ", form="{:.6E}").replace("E", "D"), X, "time: t"),
    "Excel, German thousands": ("Zeit;A;B\ns;N;N\n" + with_thousands(";", ".", ","), LARGE, "time: Zeit"),
    "Excel, English thousands": ("Time,A,B\ns,N,N\n" + with_thousands(",", ",", ".", '"'), LARGE, "time: Time"),
    "Swiss thousands": ("Zeit;A;B\ns;N;N\n" + with_thousands(";", "'", "."), LARGE, "time: Zeit"),
    "French thousands": ("Temps;A;B\ns;N;N\n" + with_thousands(";", "\u202f", ","), LARGE, "time: Temps"),
    "times of day without fractions in whole seconds": ("Time,A,B\n" + clock(datetime.isoformat), X, "time: Time"),
    "dates of MATLAB": ("Time,A,B\n" + clock(lambda t: f"12-Mar-2024 {t:%H:%M:%S.%f}"), X, "time: Time"),
    "German dates of two digits": ("Time,A,B\n" + clock(lambda t: f"{t:%d.%m.%y %H:%M:%S.%f}"), X, "time: Time"),
    "milliseconds behind a colon": ("Time,A,B\n" + clock(lambda t: f"{t:%H:%M:%S:%f}"[:-3]), X, "time: Time"),
}


@pytest.mark.parametrize(("text", "values", "said"), RIGHT.values(), ids=RIGHT)
def test_layouts_of_other_programs(tmp_path, text, values, said):
    file = opened(tmp_path, text)
    read = np.column_stack([whole(file, "A"), whole(file, "B")])
    assert np.allclose(read, values, rtol=1e-12, atol=1e-12)
    sketch = sketch_map([file], None)
    assert said in sketch
    assert {"A", "B"} <= set(yaml.safe_load(sketch)["channels"])


def turned(rows, at, separator=";"):
    """Rows whose decimal sign is a comma from row `at` on."""
    rows = [row.replace(",", separator) for row in rows.splitlines()]
    return "".join(f"{row if k < at else row.replace('.', ',')}\n" for k, row in enumerate(rows))


def turned_back(rows, at):
    return "".join(f"{row}\n" for row in turned(rows, at).replace(".", "~").replace(",", ".").replace("~", ",").split())


HEAD = "t [s],A [N],B [N]\n"
TWO_SIGNS = {
    f"{name}, from row {at} on": (HEAD.replace(",", sep) + rows(at), f"row {at + 1}")
    for name, sep, rows in (
        ("comma", ";", lambda at: turned(plain(","), at)),
        ("comma and tabs", "\t", lambda at: turned(plain(","), at, "\t")),
        ("point", ";", lambda at: turned_back(plain(","), at)),
    )
    for at in (1, 4, 30, *([COUNT - 1] if name != "point" else []))
}
TWO_SIGNS["thousandths"] = (HEAD.replace(",", ";") + turned(plain(",", values=LARGE, form="{:.3f}"), 30), "row 31")
TWO_SIGNS["no head"] = (turned(plain(","), 30), "row 30")
TWO_SIGNS["beyond the part that shows the layout"] = (turned(60 * plain(","), 3000), "row 3001, column `column 1`")
TWO_SIGNS["other separators"] = (HEAD.replace(",", ";") + 8 * plain(";") + 8 * plain("\t"), "row 481")


@pytest.mark.parametrize(("text", "place"), TWO_SIGNS.values(), ids=TWO_SIGNS)
def test_rows_with_another_decimal_sign_are_no_head(tmp_path, text, place):
    """The rows above the change were left out without a word."""
    with pytest.raises(UserError) as caught:
        file = opened(tmp_path, text)
        [group.read(range(len(group.names)), 0, group.samples) for group in file.groups]
    assert caught.value.place.startswith(place)


@pytest.mark.parametrize("head", ["0.001;2\nt;A;B\n", "Rate;2000.0;1000.0\nt;A;B\n", "0.5 1.5 2.5\nt;A;B\n"])
def test_a_head_may_hold_numbers_with_another_decimal_sign(tmp_path, head):
    assert np.array_equal(whole(opened(tmp_path, head + plain(";", ",")), "A"), X[:, 0])


REFUSED = {
    "different steps": (LVM.format("No", 0.001, 0.002) + lines(lambda k: f"\t{k}.5\t{k}.5\t"), "0.001 and 0.002"),
    "the comma as separator and decimal sign": ("t,A,B\n" + plain(",", ","), "separator and decimal sign"),
    "thousands or fractions": ("t;A\n" + lines(lambda k: f"{k};{77 if k % 2 else f'{k + 1}.234'}"), "1.234 or 1234"),
    "a name too few": ("t,A\n" + plain(","), "2 names above rows of 3 cells"),
    "a row for each channel": ("\n".join(",".join(map(str, row)) for row in np.tile(X.T, 3)), "a row for each channel"),
    "a remark within the data": (
        "t,A,B\n" + plain(",") + "# restarted amplifier\n" + plain(","),
        "the remark `# restarted amplifier` stands within the data",
    ),
    "an empty row": ("t,A,B\n" + plain(",") + "\n" + plain(","), "an empty row"),
    "a lost cell between spaces": ("t A B\n" + 200 * plain(" ") + "1 2\n" + plain(" "), "2 cells"),
    "a lost cell": ("t,A,B\n" + 200 * plain(",") + "1,2\n" + plain(","), "2 cells"),
}


@pytest.mark.parametrize(("text", "fault"), REFUSED.values(), ids=REFUSED)
def test_layouts_that_could_give_wrong_numbers_are_refused(tmp_path, text, fault):
    with pytest.raises(UserError, match=fault):
        file = opened(tmp_path, text)
        [group.read(range(len(group.names)), 0, group.samples) for group in file.groups]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("layout", ["Excel, German thousands", "Excel, English thousands", "Swiss thousands"])
def test_thousands_are_read_in_every_encoding(tmp_path, layout, encoding):
    """Excel writes UTF-8 with a byte order mark, with which each `1.234,5` was not a number."""
    text, values, _ = RIGHT[layout]
    file = opened(tmp_path, text, encoding)
    assert np.array_equal(np.column_stack([whole(file, "A"), whole(file, "B")]), values)


def test_dates_without_a_name_are_the_time(tmp_path):
    """As seismic stations write records: a line of words, then date and value."""
    rows = lines(lambda k: f"{(BEGIN + timedelta(milliseconds=k)).isoformat(timespec='microseconds')}  {X[k, 0]:.6f}")
    file = opened(tmp_path, "TIMESERIES XX_TEST_R, 400 samples, 1000 sps, INTEGER, Counts\n" + rows)
    assert "time: column 1\nchannels:\n  column 2:" in sketch_map([file], None)
    assert np.diff(whole(file, "column 1")) == pytest.approx(1e-3, abs=1e-6)
    with pytest.raises(UserError, match="several blocks of rows"):
        opened(tmp_path, 2 * ("TIMESERIES XX_TEST_R, 400 samples\n" + rows))


def test_row_numbers_are_no_time_and_unclear_units_are_to_be_completed(tmp_path):
    rows = lines(lambda k: f"{k + 1}\t{TIME[k]:.6E}\t{X[k, 0]:.6E}")
    assert "time: column 2\ntime_unit: s  # the head" in sketch_map([opened(tmp_path, PULSE + rows)], None)
    text = sketch_map([opened(tmp_path, "Time,A\n" + lines(lambda k: f"{k},{X[k, 0]}"))], None)
    assert "time_unit: TODO" in text
    text = sketch_map([opened(tmp_path, "Rate: fs = 500 Hz\nTime [s],A\n" + lines(lambda k: f"{TIME[k]},0.5"))], None)
    assert "the head states 500 Hz, these times are of 1000 Hz" in text


def test_rates_of_channels_that_differ_are_to_be_completed(tmp_path):
    head = "SampleRate,{}\nA [V],B [V]\n" + lines(lambda k: f"{X[k, 0]},{X[k, 1]}")
    text = sketch_map([opened(tmp_path, head.format("1.0E+03,1.0E+03"))], None)
    assert "sample_rate: 1000  # Hz, as the file says" in text
    text = sketch_map([opened(tmp_path, head.format("1000,500"))], None)
    assert "sample_rate: TODO  # Hz: the file says 1000 and 500" in text


def test_numbers_for_no_value_are_missing_where_they_are_far_from_all_others(tmp_path):
    text = "t,A,B\n" + lines(lambda k: f"{TIME[k]},{-9999 if k == 7 else X[k, 0]},{9.9e37 if k == 9 else k * 500}")
    file = opened(tmp_path, text)
    assert np.flatnonzero(np.isnan(whole(file, "A"))).tolist() == [7]
    assert np.flatnonzero(np.isnan(whole(file, "B"))).tolist() == [9]
    assert not np.isnan(whole(opened(tmp_path, "A\n9998\n9999\n10000\n"), "A")).any()


def test_columns_of_text_are_named_and_an_empty_comment_is_none(tmp_path):
    file = opened(tmp_path, "t,A,state,Comment\n" + lines(lambda k: f"{TIME[k]},{X[k, 0]},OVR,"))
    assert file.groups[0].names == ("t", "A") and "columns of text: state, Comment" in sketch_map([file], None)
