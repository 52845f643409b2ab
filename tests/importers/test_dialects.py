"""Text and MAT files as data loggers write them: headers of their own, remarks, blanks, columns of a lower rate."""

import h5py
import numpy as np
import pytest
import scipy.io

from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.import_map_file import declared_runs
from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError
from balance_cli.steps.import_runs import import_run
from balance_cli.steps.import_sketch import sketch_map

TIME = np.arange(400) / 1000.0
X = np.random.default_rng(1).uniform(-1, 1, (400, 3))
CATMAN = "HBM_CATMAN_DATAFILE_40\n\nT0 = 12.03.2024 12:34:56\nDT = 1,00000E-03\n\n"
LABVIEW = "LabVIEW Measurement\t\nX_Columns\tNo\n***End_of_Header***\t\n\t\nChannels\t3\t\t\t\nDelta_X"
LABVIEW += "\t0.002" * 3 + "\t\n"


def opened(tmp_path, text, encoding="utf-8"):
    (tmp_path / "record").write_bytes(text.encode(encoding))
    return open_foreign(tmp_path / "record")


def whole(file, name):
    group = next(group for group in file.groups if name in group.names)
    return group.read([group.names.index(name)], 0, group.samples)[:, 0]


def test_a_header_names_no_channels_and_its_time_step_is_the_rate(tmp_path):
    rows = [f"{t:.6f}\t{x:.6f}\t{y:.6f}\t\n".replace(".", ",") for t, (x, y, _) in zip(TIME, X, strict=True)]
    names = "Zeit 1 - default sample rate\tDMS_1\tDMS_2\ns\tmV/V\tµm/m\n"
    file = opened(tmp_path, CATMAN + names + "".join(rows), "cp1252")
    assert file.groups[0].names == ("Zeit 1 - default sample rate", "DMS_1", "DMS_2")
    assert [channel.unit for channel in file.groups[0].channels] == ["s", "mV/V", "µm/m"]
    assert file.scalars == {"sample_rate": 1000.0}
    assert np.allclose(whole(file, "DMS_2"), X[:, 1], atol=1e-6)


def test_columns_without_times_have_the_step_of_the_header(tmp_path):
    rows = ["\t" + "\t".join(f"{x:.6f}" for x in row) + "\t\n" for row in X]
    file = opened(
        tmp_path, LABVIEW + "***End_of_Header***\t\t\t\t\n\tVoltage_0\tVoltage_1\tVoltage_2\tComment\n" + "".join(rows)
    )
    assert file.scalars == {"sample_rate": 500.0} and np.allclose(whole(file, "Voltage_1"), X[:, 1], atol=1e-6)


@pytest.mark.parametrize(("step", "rate"), [("0.002", 500.0), ("2,0E-3 s", 500.0), ("2 ms", 500.0)])
def test_the_step_in_a_head_of_imc_is_the_rate(tmp_path, step, rate):
    rows = "".join("\t" + "\t".join(f"{x:.6f}" for x in row[:2]) + "\n" for row in X)
    head = f"Name:\tKraft_1\tKraft_2\nUnit:\tV\tV\ndx:\t{step}\t{step}\n"
    file = opened(tmp_path, head + rows)
    assert file.scalars.get("sample_rate") == rate
    assert np.allclose(whole(file, "Kraft_1"), X[:, 0], atol=1e-6)


def test_an_empty_time_column_is_no_channel_of_a_sketch(tmp_path):
    rows = "".join("\t" + "\t".join(f"{x:.6f}" for x in row) + "\t\n" for row in X)
    names = "***End_of_Header***\t\t\t\t\nX_Value\tVoltage_0\tVoltage_1\tVoltage_2\tComment\n"
    text = sketch_map([opened(tmp_path, LABVIEW + names + rows)], None)
    assert "X_Value" not in text and "Voltage_0" in text and "sample_rate: 500" in text


def test_a_summary_below_the_data_is_refused_and_a_remark_left_out(tmp_path):
    rows = "".join(f"{t:.3f},{x:.6f}\n" for t, x in zip(TIME, X[:, 0], strict=True))
    with pytest.raises(UserError, match="`Max` is not a number") as caught:
        whole(opened(tmp_path, "time,a\n" + rows + "Max,1.0\nMin,0.0\n"), "time")
    assert caught.value.place.startswith("row 402")
    file = opened(tmp_path, "time,a\n" + rows + "# end of record\n\n# checked\n")
    assert file.groups[0].samples == 400 and "remark" in file.notes[0]


def test_blanks_and_dashes_in_cells_are_missing_values(tmp_path):
    file = opened(tmp_path, "a,b\n" + "1, 2\n3, \n - ,4\n5 ,6\n" * 20)
    read = np.column_stack([whole(file, "a"), whole(file, "b")])[:4]
    assert np.array_equal(read, [[1, 2], [3, np.nan], [np.nan, 4], [5, 6]], equal_nan=True)


def test_a_column_of_a_lower_rate_is_a_group_of_its_own(tmp_path):
    rows = [
        f"{t:.3f};{x:.6f};{y:.6f}" if k % 8 == 3 else f"{t:.3f};{x:.6f};"
        for k, (t, (x, y, _)) in enumerate(zip(TIME, X, strict=True))
    ]
    file = opened(tmp_path, "t [s];fast [V];slow [V]\n" + "\n".join(rows) + "\n")
    slow = file.groups[1]
    assert (slow.names, slow.first_row, slow.stride, slow.samples) == (("slow",), 3, 8, 50)
    assert np.allclose(slow.read([0], 7, 20)[:, 0], X[3::8, 1][7:20], atol=1e-6)


def test_american_dates_with_half_days(tmp_path):
    hours = [f"12:59:{58 + k} PM" for k in range(2)] + [f"1:00:{k:02d} PM" for k in range(6)]
    clocks = [f"3/12/2024 {hour}" for hour in hours]
    file = opened(tmp_path, "Date/Time,x\n" + "".join(f"{clock},{k}\n" for k, clock in enumerate(clocks)))
    time = whole(file, "Date/Time")
    assert np.allclose(np.diff(time), 1.0)
    assert time[0] == np.datetime64("2024-03-12T12:59:58").astype(float)


def test_a_workbook_is_named(tmp_path):
    (tmp_path / "book.xlsx").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(UserError, match="workbook"):
        open_foreign(tmp_path / "book.xlsx")


def test_arrays_of_structures_and_cells_of_matlab(tmp_path):
    channels = np.zeros((1, 2), dtype=[("name", "O"), ("data", "O"), ("fs", "O")])
    for k in range(2):
        channels[0, k] = (f"cell{k + 1}", X[:, [k]], 1000.0)
    cells = np.empty((1, 2), object)
    cells[0, 0], cells[0, 1] = X[:, [1]], {"inner": X[:, [2]]}
    scipy.io.savemat(tmp_path / "record", {"ch": channels, "c": cells}, appendmat=False)
    file = open_foreign(tmp_path / "record")
    assert np.array_equal(whole(file, "ch[2].data"), X[:, 1]) and file.scalars["ch[1].fs"] == 1000.0
    assert np.array_equal(whole(file, "c[1]"), X[:, 1]) and np.array_equal(whole(file, "c[2].inner"), X[:, 2])


@pytest.mark.parametrize("is_padded", [True, False])
def test_columns_behind_a_second_column_of_times_are_a_group_of_their_own(tmp_path, is_padded):
    """As catman, DIAdem and LabVIEW write channels of two rates: the shorter columns end above."""
    slow = 100
    rows = [
        f"{t:.3f};{x:.6f};" + (f"{0.05 + 0.004 * k:.3f};{y:.6f};{z:.6f}" if k < slow else ";;" * is_padded)
        for k, (t, (x, y, z)) in enumerate(zip(TIME, X, strict=True))
    ]
    if not is_padded:
        rows = [row.rstrip(";") for row in rows]
    file = opened(tmp_path, "Time_1;F;Time_2;M;N\ns;N;s;Nm;Nm\n" + "\n".join(rows) + "\n")
    assert [(group.names, group.samples, group.time) for group in file.groups] == [
        (("Time_1", "F"), 400, 0),
        (("Time_2", "M", "N"), slow, 0),
    ]
    assert np.allclose(whole(file, "F"), X[:, 0], atol=1e-6) and np.allclose(whole(file, "N"), X[:slow, 2], atol=1e-6)


def test_times_of_one_record_are_no_groups(tmp_path):
    rows = "".join(f"{t:.3f},{t + 5:.3f},{x:.6f},{20 + t:.2f}\n" for t, x in zip(TIME, X[:, 0], strict=True))
    file = opened(tmp_path, "Time [s],Elapsed [s],F [N],T1 [degC]\n" + rows)
    assert len(file.groups) == 1 and file.groups[0].time is None


def test_a_second_block_of_rows_is_refused(tmp_path):
    """The layout of the last one would hide the first."""
    block = "Channel,{}\nTime,Value\n" + "".join(f"{t:.3f},{x:.6f}\n" for t, x in zip(TIME, X[:, 0], strict=True))
    with pytest.raises(UserError, match="several blocks of rows, one from row 3 and one behind row 405"):
        opened(tmp_path, block.format("a") + "\n" + block.format("b"))


def test_a_quote_without_its_partner_before_a_long_cell_is_a_row_without_numbers(tmp_path):
    rows = "".join(f"{t:.6f},{x:.6f}\n" for t, (x, *_) in zip(TIME, X, strict=True))
    (tmp_path / "record.csv").write_text("t,force\n" + rows + '"' + "x" * 140_000 + ",1.0\n")
    with pytest.raises(UserError, match=r"record\.csv.*row 402.*is not a number"):
        sketch_map([open_foreign(tmp_path / "record.csv")], None)


# ---- MAT and HDF5 of other programs ----


def import_all(file):
    """The channels of a file by a map with a stated rate, as `sample_rate` of a sketch gives it."""
    names = [name for group in file.groups for name in group.names]
    mapping = {"channels": {name: {"name": name, "unit": "V"} for name in names}, "sample_rate": 1000.0}
    runs = [{"file": "*", "kind": "zero", "run": "zero-1"}]
    mapping = ImportMap.model_validate({"format": "balance-import/1", "rig": "r", "runs": runs} | mapping)
    return import_run(declared_runs(mapping, [file.path], "map")[0], [file])


def test_channels_of_different_lengths_are_not_at_one_stated_rate(tmp_path):
    """As DEWESoft exports a slow channel to MATLAB: one `Sample_rate` in the file, that of the fast ones."""
    channels = {"Data1_F": X[:, [0]], "Data1_T": X[:40, [1]], "Sample_rate": 1000.0}
    scipy.io.savemat(tmp_path / "record", channels, appendmat=False)
    with pytest.raises(UserError, match="`Data1_F` has 400: they are not both at `sample_rate`"):
        import_all(open_foreign(tmp_path / "record"))


def test_steps_of_signals_give_the_rate_of_a_sketch_where_they_agree(tmp_path):
    """As Siemens Testlab exports signals to MATLAB."""
    for step, said in ((0.001, "sample_rate: 1000 "), (0.002, "sample_rate: TODO")):
        signals = {f"Signal_{k}": {"x_values": {"increment": dx}, "y": X[:, [k]]} for k, dx in enumerate((0.001, step))}
        scipy.io.savemat(tmp_path / "record", signals, appendmat=False)
        assert said in sketch_map([open_foreign(tmp_path / "record")], None)


def test_packed_numbers_and_times_of_netcdf(tmp_path):
    stored = np.round(X[:, 0] * 30000).astype("i2")
    stored[7] = -32768
    with h5py.File(tmp_path / "record", "w") as target:
        target["time"], target["sensor"], target["force"] = TIME, np.arange(3), stored
        target["time"].attrs["units"] = "seconds since 2024-03-12"
        target["sensor"].make_scale("sensor")
        target["force"].attrs.update({"scale_factor": 1 / 30000, "add_offset": 2.0, "_FillValue": np.int16(-32768)})
    file = open_foreign(tmp_path / "record")
    assert "sensor" not in [name for group in file.groups for name in group.names]
    assert "time: time\n" in sketch_map([file], None) and "time_unit" not in sketch_map([file], None)
    read = whole(file, "force")
    assert np.flatnonzero(np.isnan(read)).tolist() == [7]
    assert np.allclose(np.delete(read, 7), np.delete(2.0 + stored / 30000, 7), atol=1e-12)


def test_tables_of_named_columns_and_rates_of_groups_in_hdf5(tmp_path):
    table = np.zeros(400, [("t", "f8"), ("F", "f4")])
    table["t"], table["F"] = TIME, X[:, 0]
    with h5py.File(tmp_path / "record", "w") as target:
        target["rec"], target["fast"], target["slow"], target["labview"] = table, X[:, 0], X[:40, 1], X[:, 2]
        target["df/block0_items"], target["df/block0_values"] = [b"A", b"B"], X[:, :2]
        target.attrs["fs"], target["labview"].attrs["wf_increment"] = 1000.0, 0.002
    file = open_foreign(tmp_path / "record")
    rates = {name: group.rate for group in file.groups for name in group.names}
    assert (rates["fast"], rates["slow"], rates["labview"]) == (1000.0, None, 500.0)
    assert np.array_equal(whole(file, "rec.F"), table["F"]) and np.array_equal(whole(file, "B"), X[:, 1])
