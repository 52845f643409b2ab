"""MAT, HDF5, TDMS, MDF4, Parquet and WAV files, written by the packages that others use."""

import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import wavfile

from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError
from balance_cli.steps.import_sketch import sketch_map
from tests.support.measured_data import SHARED

X = np.random.default_rng(3).standard_normal((5000, 3))
SCIPY_FILES = Path(scipy.io.__file__).parent / "matlab" / "tests" / "data"
TDMS_FILES = SHARED / "foreign" / "tdms"


def whole(group):
    return group.read(range(len(group.channels)), 0, group.samples)


def by_name(file):
    return {name: (group, k) for group in file.groups for k, name in enumerate(group.names)}


def write_matlab_73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in (("X", X.T), ("t", np.arange(5000.0)[None])):
            file[name] = value
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["rec/force"] = X[:, :1].T
        file["rec/force"].attrs["MATLAB_class"] = np.bytes_("double")
        file["word"] = np.array([[77, 65]], np.uint16)
        file["word"].attrs["MATLAB_class"] = np.bytes_("char")
    content = path.read_bytes()
    path.write_bytes(
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + struct.pack("<HH", 512, 0x4D49) + content[128:]
    )


@pytest.mark.parametrize("version", ["4", "5", "7.3"])
def test_matlab(tmp_path, version):
    path = tmp_path / "record"
    if version == "7.3":
        write_matlab_73(path)
    else:
        content = {"X": X, "t": np.arange(5000.0)[:, None], "fs": 800.0}
        content |= {"rec": {"force": X[:, :1].T}} if version == "5" else {}
        scipy.io.savemat(path, content, format=version, appendmat=False)
    channels = by_name(open_foreign(path))
    group, k = channels["X[2]"]
    assert np.array_equal(group.read([k], 100, 200)[:, 0], X[100:200, 1]) and channels["t"][0].samples == 5000
    assert version == "4" or np.array_equal(whole(channels["rec.force"][0]), X[:, :1])
    assert not any(name.startswith("word") for name in channels)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("before", "after", "fault"),
    [
        ((9, 8 * len(X)), (60_000, 8 * len(X)), "data type 60000, which does not belong there"),
        ((6, 8, 6), (6, 8, 255), "class 255, which does not exist"),
        ((6, 8, 6), (6, 8, 0x806), "3 elements, where its class has 4"),  # complex without an imaginary part
    ],
)
def test_what_no_matlab_file_has_is_refused_before_scipy_looks_it_up(tmp_path, compressed, before, after, fault):
    path = tmp_path / "record.mat"
    scipy.io.savemat(path, {"rec": {"force": X[:, :1]}}, do_compression=False)
    content, sound = path.read_bytes(), struct.pack(f"<{len(before)}I", *before)
    assert content.count(sound) == 1
    damaged = content.replace(sound, struct.pack(f"<{len(after)}I", *after))
    if compressed:
        packed = zlib.compress(damaged[128:])
        damaged = damaged[:128] + struct.pack("<II", 15, len(packed)) + packed
    path.write_bytes(damaged)
    with pytest.raises(UserError, match=fault):
        open_foreign(path)


def test_files_of_matlab_in_scipy_are_read_or_refused():
    paths = sorted(SCIPY_FILES.glob("*.mat"))
    if not paths:
        pytest.skip("this SciPy has no test data")
    for path in paths:
        try:
            for group in open_foreign(path).groups:
                whole(group)
        except UserError as error:
            assert error.file and error.fault


def test_hdf5_with_attributes(tmp_path):
    with h5py.File(tmp_path / "record", "w") as file:
        dataset = file.create_dataset("daq/ai", data=X)
        dataset.attrs["names"], dataset.attrs["units"] = ["a", "b", "c"], ["V", "mV", "N"]
        file.attrs["sample_rate"] = 512.0
    (group,) = open_foreign(tmp_path / "record").groups
    assert group.names == ("a", "b", "c") and group.rate == 512.0 and group.channels[1].unit == "mV"
    assert np.array_equal(group.read([2, 0], 10, 20), X[10:20, [2, 0]])


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    start = np.datetime64("2026-01-01T00:00:00")
    properties = {"wf_increment": 1 / 51200, "unit_string": "V", "wf_start_time": start}
    late = properties | {"wf_start_time": start + np.timedelta64(250, "ms"), "wf_increment": 0.001}
    channels = [
        nptdms.ChannelObject("g", "a", X[:, 0], properties=properties),
        nptdms.ChannelObject("g", "slow", X[:100, 1], properties=late),
        nptdms.ChannelObject("g", "words", ["x", "y"]),
    ]
    with nptdms.TdmsWriter(tmp_path / "record") as writer:
        writer.write_segment(channels)
        writer.write_segment(channels[:1])
    found = by_name(open_foreign(tmp_path / "record"))
    assert found["a"][0].rate == 51200.0 and found["slow"][0].start == 0.25 and found["words"][0].unusable
    assert np.array_equal(found["a"][0].read([0], 4990, 5010)[:, 0], np.concatenate([X[-10:, 0], X[:10, 0]]))


@pytest.mark.skipif(not TDMS_FILES.exists(), reason="files of other programs are not here")
@pytest.mark.parametrize("name", ["big_endian", "raw1", "Digital_Input", "raw_timestamps"])
def test_tdms_files_of_labview(name):
    nptdms = pytest.importorskip("nptdms")
    path = TDMS_FILES / f"{name}.tdms"
    channels = [channel for group in nptdms.TdmsFile(path).groups() for channel in group.channels()]
    file = open_foreign(path)
    assert len(file.groups) == len(channels)
    for group, channel in zip(file.groups, channels, strict=True):
        assert np.array_equal(whole(group)[:, 0], channel[:])


def test_mdf4(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    time = np.arange(5000) / 800.0
    with asammdf.MDF(version="4.10") as file:
        signal = asammdf.Signal
        file.append([signal(X[:, 0], time + 1.5, name="a", unit="V"), signal(X[:, 1], time + 1.5, name="b", unit="N")])
        file.append([signal(X[:50, 2], np.cumsum(np.linspace(0.1, 3, 50)), name="can")])
        file.save(tmp_path / "record.mf4")
    (tmp_path / "record.mf4").rename(tmp_path / "record")
    found = by_name(open_foreign(tmp_path / "record"))
    group = found["a"][0]
    assert (group.rate, group.channels[found["b"][1]].unit) == (800.0, "N") and group.start == pytest.approx(1.5)
    assert np.array_equal(group.read([found["b"][1], found["a"][1]], 4000, 4100), X[4000:4100, [1, 0]])
    assert "uneven" in found["can"][0].unusable


def test_parquet(tmp_path):
    pytest.importorskip("pyarrow")
    import pandas as pd

    table = pd.DataFrame({"time": np.arange(5000) / 800, "Fz [N]": X[:, 0], "word": "x", "n": np.arange(5000)})
    table.to_parquet(tmp_path / "record", row_group_size=700)
    group, words = open_foreign(tmp_path / "record").groups
    assert words.names == ("word",) and words.unusable
    assert group.names == ("time", "Fz", "n") and group.channels[1].unit == "N"
    assert np.array_equal(group.read([1, 2], 650, 1450), np.column_stack([X[650:1450, 0], np.arange(650, 1450)]))


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint8, np.float32, np.float64])
def test_wav(tmp_path, kind):
    scale = {np.int16: 2.0**15, np.int32: 2.0**31, np.uint8: 2.0**7}.get(kind, 1.0)
    data = np.clip(X / 5.0, -0.99, 0.99)
    stored = (data * scale + (128 if kind is np.uint8 else 0)).astype(kind)
    wavfile.write(tmp_path / "record", 48000, stored)
    (group,) = open_foreign(tmp_path / "record").groups
    assert group.rate == 48000.0 and group.samples == 5000
    assert np.allclose(group.read([2, 0], 1000, 1100), data[1000:1100, [2, 0]], atol=1.0 / scale if scale > 1 else 1e-7)


def test_wav_of_24_bits(tmp_path):
    import wave

    counts = np.arange(-4000, 4000, 7) * 1000
    with wave.open(str(tmp_path / "record"), "wb") as file:
        file.setparams((1, 3, 51200, 0, "NONE", ""))
        file.writeframes(b"".join(int(count).to_bytes(3, "little", signed=True) for count in counts))
    (group,) = open_foreign(tmp_path / "record").groups
    assert np.array_equal(whole(group)[:, 0], counts / 2.0**23)


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(
        [b"TDSm", b"MDF     4.10    ", b"RIFF\0\0\0\0WAVEfmt ", b"PAR1", b"    -1\r\n    58b", b"MATLAB 5.0"]
    ),
    st.binary(max_size=400),
)
def test_damaged_files_are_user_errors(tmp_path_factory, head, rest):
    path = tmp_path_factory.mktemp("damaged") / "record"
    path.write_bytes(head.ljust(124 if head.startswith(b"MATLAB") else 0) + rest)
    try:
        for group in open_foreign(path).groups:
            whole(group)
    except UserError as error:
        assert error.file == str(path)


def test_a_text_of_another_kind_is_no_recording(tmp_path):
    (tmp_path / "picture").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    with pytest.raises(UserError, match="no format that can be imported"):
        open_foreign(tmp_path / "picture")


def test_a_sketch_leaves_out_what_is_not_as_long_as_the_times(tmp_path):
    time = np.arange(64) / 100.0
    spectra = {"freq": np.arange(33.0), "H": np.exp(1j * np.arange(33.0))}
    scipy.io.savemat(tmp_path / "sweep.mat", {"time": time, "force": np.sin(time), "y": np.cos(time), **spectra})
    sketch = sketch_map([open_foreign(tmp_path / "sweep.mat")], None)
    assert list(yaml.safe_load(sketch)["channels"]) == ["force", "y"]
    assert "# not as long as `time`: freq, H\n" in sketch


def _testlab(name, unit, samples):
    values = {"values": samples, "quantity": {"label": unit}}
    return {"x_values": {"increment": 1e-3}, "y_values": values, "function_record": {"name": name}}


def _dspace(name, unit, samples):
    return np.array([(name, unit, samples)], dtype=[("Name", object), ("Unit", object), ("Data", object)])


@pytest.mark.parametrize("structure", [_testlab, _dspace])
def test_a_sketch_calls_the_channels_of_structures_as_the_structures_do(tmp_path, structure):
    """Testlab and dSPACE number their structures, and the names of the signals stand in them."""
    samples = np.random.default_rng(5).standard_normal((4, 60))
    signals = zip(("x.piezo", "z1.strain", "Fx", "Tacho"), ("V", "mV", "N", "V"), samples, strict=True)
    content = {f"Signal_{k}": structure(*signal) for k, signal in enumerate(signals)}
    scipy.io.savemat(tmp_path / "sweep-Fx.mat", content)
    file = open_foreign(tmp_path / "sweep-Fx.mat")
    sketched = yaml.safe_load(sketch_map([file], None))
    stated = {entry["name"]: entry["unit"] for entry in sketched["channels"].values()}
    assert stated == {"x.piezo": "V", "z1.strain": "mV"}
    (load,) = sketched["loads"].items()
    assert load[0].startswith("Signal_2.") and load[1] == {"component": "Fx", "unit": "N", "sign": 1}
    assert sketched["rotor"]["channel"].startswith("Signal_3.")
    first = next(group for group in file.groups if group.names[0] == next(iter(sketched["channels"])))
    np.testing.assert_array_equal(first.read([0], 0, 60)[:, 0], samples[0])
