"""What a sketch makes of files that state their channels in other ways: no channel and no scale is lost unsaid."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import yaml

from balance_cli.importers import open_foreign
from balance_cli.importers.base import ForeignFile
from balance_cli.importers.time_axis import read_time_axis
from balance_cli.io.errors import UserError
from balance_cli.steps.import_sketch import sketch_map

X = np.random.default_rng(5).uniform(-1, 1, (200, 2))
TIMES = np.arange(200) / 1000.0


def values(file: ForeignFile, name: str) -> np.ndarray:
    group = next(group for group in file.groups if name in group.names)
    return group.read([group.names.index(name)], 0, group.samples)[:, 0]


def sketch(path: Path) -> tuple[str, dict]:
    text = sketch_map([open_foreign(path)], None)
    return text, yaml.safe_load(text)


def write_rows(path: Path, head: str, *columns: object) -> Path:
    cells = zip(*([str(cell) for cell in column] for column in columns), strict=True)
    path.write_text(head + "\n" + "".join(",".join(row) + "\n" for row in cells), encoding="utf-8")
    return path


# ---- structures of MATLAB 7.3 ----------------------------------------------------------------------------------------


def of_class(item: h5py.Dataset | h5py.Group, name: str) -> h5py.Dataset | h5py.Group:
    item.attrs["MATLAB_class"] = np.bytes_(name)
    return item


def references(file: h5py.File, place: str, items: list[h5py.Dataset | h5py.Group]) -> h5py.Dataset:
    dataset = file.create_dataset(place, (len(items), 1), h5py.ref_dtype)
    for k, item in enumerate(items):
        dataset[k, 0] = item.ref
    return dataset


def characters(file: h5py.File, place: str, text: str) -> h5py.Dataset:
    return of_class(file.create_dataset(place, data=np.array([[ord(sign)] for sign in text], np.uint16)), "char")


def test_arrays_of_structures_and_cells_of_matlab_73(tmp_path: Path) -> None:
    path = tmp_path / "zero.mat"
    with h5py.File(path, "w", userblock_size=512) as file:

        def numbers(place: str, column: int) -> h5py.Dataset:
            return of_class(file.create_dataset(place, data=X[None, :, column]), "double")

        of_class(file.create_group("chn"), "struct")
        references(file, "chn/data", [numbers(f"#refs#/d{k}", k) for k in range(2)])
        references(file, "chn/name", [characters(file, f"#refs#/n{k}", f"F{k + 1}") for k in range(2)])
        references(file, "chn/unit", [characters(file, f"#refs#/u{k}", "mV") for k in range(2)])
        inner = of_class(file.create_group("#refs#/s"), "struct")
        numbers("#refs#/s/y", 1)
        of_class(references(file, "cells", [numbers("#refs#/c0", 0), inner]), "cell")
        empty = of_class(file.create_dataset("none", data=np.zeros(2, np.uint64)), "double")
        empty.attrs["MATLAB_empty"] = np.uint8(1)
        of_class(file.create_dataset("fs", data=np.array([[1000.0]])), "double")
    file = open_foreign(path)
    assert {name for group in file.groups for name in group.names} == {
        *("chn[1].data", "chn[2].data", "cells[1]", "cells[2].y")
    }
    np.testing.assert_array_equal(values(file, "chn[2].data"), X[:, 1])
    np.testing.assert_array_equal(values(file, "cells[2].y"), X[:, 1])
    entries = sketch(path)[1]
    assert entries["channels"]["chn[1].data"] == {"name": "F1", "unit": "mV"} and entries["sample_rate"] == 1000.0


def test_an_array_of_structures_alone_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "zero.mat", "w", userblock_size=512) as file:
        of_class(file.create_group("chn"), "struct")
        data = [of_class(file.create_dataset(f"#refs#/d{k}", data=X[None, :, k]), "double") for k in range(2)]
        references(file, "chn/data", data)
    np.testing.assert_array_equal(values(open_foreign(tmp_path / "zero.mat"), "chn[1].data"), X[:, 0])


def test_a_reference_to_itself_ends(tmp_path: Path) -> None:
    path = tmp_path / "zero.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        of_class(file.create_dataset("a", data=X[None, :, 0]), "double")
        cell = of_class(file.create_dataset("c", (300, 1), h5py.ref_dtype), "cell")
        cell[:, 0] = [cell.ref] * 300
    assert "a" in [name for group in open_foreign(path).groups for name in group.names]


def test_a_link_to_another_file_is_not_followed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "private.h5", "w") as file:
        file["secret"] = X[:, 0]
    with h5py.File(tmp_path / "zero.mat", "w", userblock_size=512) as file:
        of_class(file.create_dataset("a", data=X[None, :, 0]), "double")
        of_class(file.create_group("s"), "struct")["b"] = h5py.ExternalLink("private.h5", "secret")
        file["c"] = h5py.ExternalLink("private.h5", "secret")
    assert [name for group in open_foreign(tmp_path / "zero.mat").groups for name in group.names] == ["a"]


# ---- what converts integers ------------------------------------------------------------------------------------------


def test_a_scale_beside_integers_is_to_be_completed(tmp_path: Path) -> None:
    raw = (1000 * X[:, :1]).astype(np.int16)
    with h5py.File(tmp_path / "zero.h5", "w") as file:
        for name, stored in (("F1", raw[:, 0]), ("F2", X[:, 1]), ("F3", raw[:, 0])):
            file[name] = stored
            file[name].attrs.update({"unit": "mV", "gain": 1.0 if name == "F3" else 0.01, "sample_rate": 1000.0})
    scipy.io.savemat(tmp_path / "zero.mat", {"ch": {"data": raw, "unit": "mV", "scale": 0.01, "offset": 1.0}})
    text, entries = sketch(tmp_path / "zero.h5")
    assert entries["channels"]["F1"]["scale"] == "TODO" and "the file states gain 0.01" in text
    # A gain beside converted values is that of an amplifier, and one of 1 converts nothing.
    assert "scale" not in entries["channels"]["F2"] and "scale" not in entries["channels"]["F3"]
    text, entries = sketch(tmp_path / "zero.mat")
    assert entries["channels"]["ch.data"]["scale"] == "TODO" and "scale 0.01, offset 1" in text


# ---- times -----------------------------------------------------------------------------------------------------------


def test_a_thrust_is_no_time(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "zero.csv", "T [mV],Q [mV],Time [s]", X[:, 0], X[:, 1], TIMES)
    entries = sketch(path)[1]
    assert entries["time"] == "Time" and set(entries["channels"]) == {"T", "Q"}
    with h5py.File(tmp_path / "zero.h5", "w") as file:
        for k, name in enumerate("TQ"):
            file[name] = X[:, k]
            file[name].attrs["sample_rate"] = 1000.0
    assert set(sketch(tmp_path / "zero.h5")[1]["channels"]) == {"T", "Q"}


def test_a_time_called_t_is_one(tmp_path: Path) -> None:
    entries = sketch(write_rows(tmp_path / "zero.csv", "t,F [mV]", TIMES, X[:, 0]))[1]
    assert entries["time"] == "t" and set(entries["channels"]) == {"F"}


def test_quantities_over_their_units(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "zero.csv", "t/min,A/V,B / mV,C/Rack1", TIMES / 60.0, X[:, 0], X[:, 1], X[:, 1])
    text, entries = sketch(path)
    assert entries["time"] == "t" and "time_unit" not in text
    assert {name: entry["unit"] for name, entry in entries["channels"].items()} == {
        **{"A": "V", "B": "mV", "C/Rack1": "TODO"}
    }


def test_channels_of_a_lower_rate_are_in_the_sketch(tmp_path: Path) -> None:
    slow = [f"{x}" if k % 5 == 0 else "" for k, x in enumerate(X[:, 0])]
    path = write_rows(tmp_path / "wind.csv", "Time [s],F1 [V],Tacho [V]", TIMES, slow, X[:, 1])
    entries = sketch(path)[1]
    assert set(entries["channels"]) == {"F1"} and entries["rotor"]["channel"] == "Tacho"


@pytest.mark.parametrize("factor", [1.0, 1e-3])
def test_times_of_day_pass_midnight(factor: float) -> None:
    times = (86399.9 + TIMES) % 86400.0 / factor
    axis = read_time_axis(lambda columns, a, b: times[a:b, None], len(times), factor)
    assert axis.rate == pytest.approx(1000.0) and axis.start == pytest.approx(86399.9)


def test_times_that_begin_anew_do_not_pass_midnight() -> None:
    times = np.concatenate([80000.0 + TIMES, TIMES])
    with pytest.raises(UserError, match="decrease"):
        read_time_axis(lambda columns, a, b: times[a:b, None], len(times))


# ---- what is not read is named ---------------------------------------------------------------------------------------


def test_arrays_that_are_no_records_are_named(tmp_path: Path) -> None:
    table = np.zeros(200, [("F", float, 3), ("T", float)])
    with h5py.File(tmp_path / "zero.h5", "w") as file:
        file["A"], file["block"], file["frf"], file["rec"] = X[:, 0], np.zeros((200, 3, 2)), X[:, 0] + 1j, table
    scipy.io.savemat(tmp_path / "zero.mat", {"A": X[:, :1], "B": np.zeros((200, 3, 2))})
    text = sketch(tmp_path / "zero.h5")[0]
    for named in ("block: an array of 3 dimensions", "frf: complex numbers", "rec.F: an array in each row"):
        assert f"not usable: {named}" in text
    assert "not usable: B: an array of 3 dimensions" in sketch(tmp_path / "zero.mat")[0]


def test_time_stamps_of_tdms_are_times(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    stamps = np.datetime64("2024-03-12T12:00:00", "us") + (1e6 * TIMES).astype("timedelta64[us]")
    with nptdms.TdmsWriter(tmp_path / "zero.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("g", "Time", stamps), nptdms.ChannelObject("g", "A", X[:, 0])])
    np.testing.assert_allclose(np.diff(values(open_foreign(tmp_path / "zero.tdms"), "Time")), 1e-3, atol=1e-6)
    entries = sketch(tmp_path / "zero.tdms")[1]
    assert entries["time"] == "Time" and set(entries["channels"]) == {"A"}


def test_decimals_and_durations_of_parquet(tmp_path: Path) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {
        "A [V]": [Decimal(k) / 100 for k in range(199)] + [None],
        "t [s]": pyarrow.array((1e9 * TIMES).astype(np.int64), pyarrow.duration("ns")),
        "day": pyarrow.array((1000 * TIMES).astype(np.int32), pyarrow.time32("ms")),
        "word": ["x"] * 200,
    }
    parquet.write_table(pyarrow.table(columns), tmp_path / "zero.parquet")
    file = open_foreign(tmp_path / "zero.parquet")
    np.testing.assert_allclose(values(file, "A")[:199], np.arange(199) / 100)
    assert np.isnan(values(file, "A")[199])
    np.testing.assert_allclose(values(file, "t"), TIMES, atol=1e-9)
    np.testing.assert_allclose(values(file, "day"), TIMES, atol=1e-9)
    assert "not usable: word: of type string" in sketch(tmp_path / "zero.parquet")[0]


# ---- rows below, quotes, archives ------------------------------------------------------------------------------------


def test_rows_below_the_data_are_named(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "zero.csv", "Time [s],A [V],B [V]", TIMES, X[:, 0], X[:, 1])
    with path.open("a", encoding="utf-8") as file:
        file.write("\nStatistics,min,max,mean\nA,1.0,3.0,2.0\n")
    with pytest.raises(UserError, match="no row of numbers") as caught:
        open_foreign(path)
    assert caught.value.place == "row 203"


def test_numbers_in_quotes_have_the_separator_as_decimal_sign(tmp_path: Path) -> None:
    columns = ([f'"{x:.4f}"'.replace(".", ",") for x in column] for column in (TIMES, X[:, 0]))
    file = open_foreign(write_rows(tmp_path / "zero.csv", '"Time [s]","A [V]"', *columns))
    np.testing.assert_allclose(values(file, "A"), X[:, 0], atol=1e-4)


@pytest.mark.parametrize(("mark", "remedy"), [(b"\x1f\x8b\x08", "gunzip"), (b"ARROW1\0\0", "Parquet")])
def test_what_has_to_be_unpacked_is_named(tmp_path: Path, mark: bytes, remedy: str) -> None:
    (tmp_path / "zero.csv.gz").write_bytes(mark + bytes(range(256)))
    with pytest.raises(UserError, match=remedy):
        open_foreign(tmp_path / "zero.csv.gz")


def test_the_index_of_pandas_in_a_parquet_file_is_its_time(tmp_path: Path) -> None:
    """It was a channel without a unit, and the rate was to be completed."""
    pd, _ = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    table = pd.DataFrame({"F1 [V]": X[:, 0]}, index=pd.date_range("2024-03-12", periods=200, freq="1ms"))
    table.to_parquet(tmp_path / "zero.parquet")
    text, entries = sketch(tmp_path / "zero.parquet")
    assert entries["time"] == "__index_level_0__" and list(entries["channels"]) == ["F1"] and "time_unit" not in text
    table.reset_index(drop=True).to_parquet(tmp_path / "plain.parquet")
    assert "sample_rate: TODO" in sketch(tmp_path / "plain.parquet")[0]


@pytest.mark.parametrize(
    ("head", "kind"), [(b"ARROW1\0\0\xff\xff\xff\xff", "a Feather"), (b"CDF\1\0\0\0\0\0\0\0\n", "a netCDF-3 file")]
)
def test_formats_that_are_not_read_are_named(tmp_path: Path, head: bytes, kind: str) -> None:
    """Their zero bytes were taken for a text in UTF-16 without columns of numbers."""
    (tmp_path / "record").write_bytes(head + b"\0\1\0\2\0a\0b" * 40)
    with pytest.raises(UserError, match=f"is {kind}"):
        open_foreign(tmp_path / "record")


def test_the_unit_of_yokogawa_is_that_of_the_values(tmp_path: Path) -> None:
    """`HUnit`, of the time between samples, was the unit of all channels, and their scale was left open."""
    head = '"Model","DL850E"\n"TraceName","CH1","CH2"\n"VUnit","V","mV"\n"HResolution",1.0E-03,1.0E-03\n"HUnit","s","s"'
    path = write_rows(tmp_path / "y.csv", head, [""] * 200, *X.T)
    text, mapping = sketch(path)
    assert {name: channel["unit"] for name, channel in mapping["channels"].items()} == {"CH1": "V", "CH2": "mV"}
    assert "scale" not in text.split("channels:")[1].split("#")[0]


@pytest.mark.parametrize("word", ["NaN", "NA", "-"])
def test_a_row_without_values_does_not_end_the_head(tmp_path: Path, word: str) -> None:
    """The rows above it were lost, and the record was half as long, without a word."""
    cells = [f"{value:.6f}" for value in X[:, 0]]
    cells[90] = word
    file = open_foreign(write_rows(tmp_path / "one.csv", "F1 [V]", cells))
    np.testing.assert_allclose(values(file, "F1"), np.where(np.arange(200) == 90, np.nan, X[:, 0]), atol=1e-6)
