"""`balance export`: every format, read back by the programs that others use, says what the artefact says."""

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from balance_cli.api.artefacts import load_artefact
from balance_cli.cli import balance
from balance_cli.cli.export import FORMAT_NAMES
from balance_cli.exporters.datasets import to_xarray
from balance_cli.exporters.formats import FORMATS
from balance_cli.exporters.tables import round_to_sigma
from balance_cli.exporters.uff import uff_text
from balance_cli.importers import open_foreign
from balance_cli.reduction.polar import LARGEST_PHASE_SIGMA, polar_sigma
from balance_cli.reduction.result import LOAD_TABLE_COLUMNS

ROOT = Path(__file__).parents[2]
DATA, RIG = ROOT / "sample_data", ROOT / "configs" / "rts-6.yaml"


def call(*words, status=0):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A calibration, responses, a model and loads of the sample campaign."""
    folder = tmp_path_factory.mktemp("export")
    call("calibrate", "-g", RIG, DATA / "static-bare.h5", "-o", folder / "cal.h5")
    sweeps = [DATA / f"sweep-{name}.h5" for name in ("Fz-high", "Mx-high")]
    call("sweep-tf", "-g", RIG, *sweeps, "--to", 40, "-o", folder / "tf.h5")
    call("identify", "-g", RIG, "--method", "computed", "-o", folder / "model.h5")
    words = ("--calibration", folder / "cal.h5", "--model", folder / "model.h5")
    history = ("--history", folder / "histories")
    call("reduce", *words, DATA / "wind-1.h5", DATA / "wind-2.h5", *history, "-o", folder / "loads.h5")
    call("reduce", *words, DATA / "wind-1.h5", "--band", 5, 100, "-o", folder / "spectra.h5")
    return folder


def export(folder, name, file, *words, status=0):
    path = folder / file
    result = call("export", folder / f"{name}.h5", "-o", path, *words, status=status)
    return path if not status else result.stderr


def test_names_of_the_formats_are_those_that_are_written():
    assert FORMAT_NAMES == FORMATS


def test_long_table_has_the_columns_of_the_contract_first(folder):
    table = pd.read_csv(export(folder, "loads", "loads.csv"))
    assert tuple(table.columns[: len(LOAD_TABLE_COLUMNS)]) == LOAD_TABLE_COLUMNS
    loads = load_artefact(folder / "loads.h5")
    exact = loads.to_frame()
    for name in ("cosine", "sine", "amplitude"):
        sigma = np.maximum(exact.sigma_cosine, exact.sigma_sine)
        assert np.all(np.abs(table[name] - exact[name]) <= 0.006 * sigma + 1e-9 * np.abs(exact[name]))
    assert np.nanmax(np.abs(table.sigma_cosine / exact.sigma_cosine - 1)) < 0.006


def test_wide_table_has_a_row_for_each_run(folder):
    table = pd.read_csv(export(folder, "loads", "wide.csv", "--wide")).set_index("run")
    run = load_artefact(folder / "loads.h5").runs["wind-2"]
    column = run.components.index("Fz")
    assert list(table.index) == ["wind-1", "wind-2"]
    assert table.Fz_mean["wind-2"] == pytest.approx(run.amplitude[0, column].real, abs=run.sigma_cosine[0, column])
    sigma = float(table.Fz_4_amplitude_sigma["wind-2"])
    assert table.Fz_4_amplitude["wind-2"] == pytest.approx(abs(run.amplitude[4, column]), abs=0.006 * sigma)
    assert {"Mz_8_phase_deg_sigma", "rotor_hz", "trim", "flags"} <= set(table.columns)


def test_stdout_has_the_table_and_nothing_else(folder):
    program = [sys.executable, "-m", "balance_cli", "export", str(folder / "loads.h5"), "-o", "-"]
    output = subprocess.run(program, cwd=ROOT, capture_output=True, check=True).stdout
    assert output == export(folder, "loads", "again.csv").read_bytes()
    assert len(pd.read_csv(io.BytesIO(output))) == 2 * 6 * 9


@pytest.mark.parametrize("name", ["loads", "tf", "cal", "model", "spectra"])
def test_parquet_and_csv_hold_any_result(folder, name):
    pytest.importorskip("pyarrow")
    table = pd.read_parquet(export(folder, name, f"{name}.parquet"))
    assert len(table) == len(pd.read_csv(export(folder, name, f"{name}.csv"))) > 0


def test_universal_file_is_read_by_pyuff(folder):
    pyuff = pytest.importorskip("pyuff")
    transfer = load_artefact(folder / "tf.h5")
    file = pyuff.UFF(str(export(folder, "tf", "tf.uff")))
    kinds = [int(kind) for kind in file.get_set_types()]
    channels = len(transfer.responses[0].channel_names)
    assert kinds == [151, 164, *[58] * (2 * channels)]
    assert file.read_sets(1)["units_code"] == 1
    for index, response in enumerate(transfer.responses):
        for i in (0, channels - 1):
            found = file.read_sets(2 + index * channels + i)
            assert np.abs(found["data"] - response.response[:, i, 0]).max() < 1e-11 * np.abs(found["data"]).max()
            np.testing.assert_allclose(found["x"], response.frequency, rtol=1e-12)
            assert found["func_type"] == 4
            assert (found["ref_dir"], found["rsp_node"]) == ([3, 4][index], 2 + i)
            assert found["orddenom_axis_units_lab"] == ["N", "N m"][index]
            assert found["ordinate_axis_units_lab"] == "V"


def test_uneven_frequencies_are_written_one_by_one(folder):
    pyuff = pytest.importorskip("pyuff")
    transfer = load_artefact(folder / "tf.h5")
    keep = np.arange(len(transfer.responses[0].frequency)) ** 2
    keep = keep[keep < len(transfer.responses[0].frequency)]
    first = transfer.responses[0]
    thinned = replace(first, frequency=first.frequency[keep], response=first.response[keep])
    path = folder / "uneven.uff"
    path.write_text(uff_text(replace(transfer, responses=(thinned,)), "2026-01-02T03:04:05+00:00"))
    found = pyuff.UFF(str(path)).read_sets(2)
    np.testing.assert_allclose(found["x"], thinned.frequency, rtol=5e-6)
    np.testing.assert_allclose(found["data"], thinned.response[:, 0, 0], rtol=1e-11)


def test_nexus_file_names_what_a_viewer_plots(folder):
    with h5py.File(export(folder, "loads", "loads.nxs")) as file:
        entry = file[file.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert (file.attrs["NX_class"], entry.attrs["NX_class"], data.attrs["NX_class"]) == (
            "NXroot",
            "NXentry",
            "NXdata",
        )
        assert list(data.attrs["axes"]) == ["harmonic"]
        signal = data[data.attrs["signal"]]
        run = load_artefact(folder / "loads.h5").runs["wind-1"]
        np.testing.assert_allclose(signal, np.abs(run.amplitude[:, 0]))
        assert signal.attrs["units"] == "N"
        assert data["amplitude_errors"].shape == signal.shape == data["harmonic"].shape
        np.testing.assert_allclose(entry["all/cosine"], run.amplitude.real.T)
    with h5py.File(export(folder, "tf", "tf.nxs")) as file:
        assert file["sweep-Fz-high/all/response"].dtype.kind == "c"
        assert file["sweep-Fz-high/Fz_x.strain"].attrs["signal"] == "magnitude"


def test_matlab_file_has_a_struct_for_each_run(folder):
    from scipy.io import loadmat

    found = loadmat(export(folder, "loads", "loads.mat"), simplify_cells=True)["wind_1"]
    run = load_artefact(folder / "loads.h5").runs["wind-1"]
    np.testing.assert_allclose(found["sine"], -run.amplitude.imag.T)
    assert list(found["component"]) == list(run.components)
    assert found["flag"][2][1] == run.flags[1][2]
    assert found["units"]["frequency"] == "Hz"
    found = loadmat(export(folder, "cal", "cal.mat"), simplify_cells=True)["table"]
    assert len(found) > 3


def test_datasets_have_axes_and_units(folder):
    xarray = pytest.importorskip("xarray")
    loads = load_artefact(folder / "loads.h5")
    dataset = to_xarray(loads)["wind-2"]
    assert float(dataset.cosine.sel(component="Fz", harmonic=4)) == loads.runs["wind-2"].amplitude[4, 2].real
    assert dataset.frequency.attrs["units"] == "Hz"
    with xarray.open_dataset(export(folder, "spectra", "s.nc"), engine="scipy") as found:
        np.testing.assert_allclose(found.density, load_artefact(folder / "spectra.h5").runs["wind-1"].density.T)


@pytest.mark.parametrize(
    ("name", "file", "words", "message"),
    [
        ("loads", "x.txt", (), "names no format"),
        ("loads", "x.uff", (), "frequency responses"),
        ("cal", "x.nxs", (), "loads, spectra and frequency responses"),
        ("loads", "x.nc", (), "one run"),
        ("tf", "x.csv", ("--wide",), "only loads"),
        ("loads", "x.mat", ("--wide",), "--wide"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(folder, name, file, words, message):
    if file.endswith(".nc"):
        pytest.importorskip("xarray")
    assert message in export(folder, name, file, *words, status=2)
    assert not (folder / file).exists()


# ---- sigma and digits ------------------------------------------------------------------------------------------------


def test_sigma_of_amplitude_and_phase_is_that_of_samples():
    rng = np.random.default_rng(3)
    value, sigma_cosine, sigma_sine = 3.0 - 4.0j, 0.02, 0.05
    noise = sigma_cosine * rng.standard_normal(200_000) - 1j * sigma_sine * rng.standard_normal(200_000)
    radial, angle = polar_sigma(value, sigma_cosine, sigma_sine)
    assert float(radial) == pytest.approx(np.std(np.abs(value + noise)), rel=0.01)
    assert float(angle) == pytest.approx(np.degrees(np.std(np.angle(value + noise))), rel=0.01)


def test_sigma_where_there_is_no_amplitude_no_phase_and_no_value():
    radial, angle = polar_sigma([0.0, 1e-9, 2.0, np.nan], [1.0, 1.0, 0.1, np.nan], [1.0, 1.0, 0.0, np.nan])
    assert radial[:3] == pytest.approx([1.0, 1.0, 0.1])
    assert angle[:2] == pytest.approx([LARGEST_PHASE_SIGMA] * 2)
    assert np.isnan(angle[2:]).all()
    assert np.isnan(radial[3])


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e6))
def test_rounding_loses_less_than_a_hundredth_of_sigma(value, sigma):
    text = round_to_sigma(value, sigma)
    assert abs(float(text) - value) <= 0.0051 * sigma + 1e-15 * abs(value)
    assert len(text) <= 24


def test_a_history_in_every_format(folder, tmp_path):
    path = folder / "histories" / "wind-1.h5"
    with h5py.File(path) as file:
        time, loads, sigma = (file[name][:] for name in ("time", "loads", "sigma"))
    for suffix in ("csv", "parquet", "mat", "uff", "nxs"):
        call("export", path, "-o", tmp_path / f"h.{suffix}")
    table = pd.read_parquet(tmp_path / "h.parquet")
    assert np.array_equal(table["time_s"], time) and np.array_equal(table["Fz_sigma"], sigma[:, 2])
    rounded = pd.read_csv(tmp_path / "h.csv")
    assert np.all(np.abs(rounded["Fz"] - loads[:, 2]) <= 0.01 * sigma[:, 2])
    (group,) = [group for group in open_foreign(tmp_path / "h.uff").groups if group.names == ("hub:1+Z",)]
    assert group.rate == 800.0 and group.channels[0].unit == "N" and abs(group.start - time[0]) < 1e-5
    assert np.allclose(group.read([0], 0, group.samples)[:, 0], loads[:, 2], rtol=1e-11)
    with h5py.File(tmp_path / "h.nxs") as file:
        assert np.array_equal(file["wind-1/Fz/load"], loads[:, 2])
    refused = call("export", path, "--wide", "-o", tmp_path / "w.csv", status=2)
    assert "only loads have a table" in refused.stderr
    assert f"history of the hub loads of run wind-1: {len(time)} samples" in call("check", path).stdout
    empty = tmp_path / "empty.h5"
    with h5py.File(empty, "w") as file:
        file.attrs["format"] = "balance-history/1"
        for name in ("time", "loads", "sigma"):
            file.create_dataset(name, shape=(10**9, 6), dtype=float, chunks=(1000, 6))
    assert "of which 0 are stored" in call("check", empty, status=2).stdout
    assert "of which 0 are stored" in call("export", empty, "-o", tmp_path / "e.csv", status=2).stderr


def test_spectra_are_on_the_page(folder, tmp_path):
    summary = tmp_path / "s.json"
    call("report", folder / "spectra.h5", folder / "loads.h5", "-o", tmp_path / "p.html", "--json", summary)
    assert "load-spectra" in json.loads(summary.read_text(encoding="utf-8"))["sections"]
    run = load_artefact(folder / "spectra.h5").runs["wind-1"]
    page = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert f"peak at {run.peak_hz['Fz']:.4g} Hz" in page and "Spectra of hub loads" in page


def test_table_of_loads_is_written_as_its_data_frame_would_be(folder, tmp_path):
    call(
        "reduce", "--model", folder / "model.h5", DATA / "wind-1.h5", DATA / "check-1.h5", "-o", tmp_path / "loads.csv"
    )
    call("reduce", "--model", folder / "model.h5", DATA / "wind-1.h5", DATA / "check-1.h5", "-o", tmp_path / "loads.h5")
    frame = load_artefact(tmp_path / "loads.h5").to_frame()
    assert frame.isna().any(axis=None)  # mean loads are not measured without a calibration
    assert (tmp_path / "loads.csv").read_text() == frame.to_csv(index=False, lineterminator="\n")
