"""Files that a full disk or a copy has cut: the text, WAV, TDMS and MAT files that can still be read say so."""

import numpy as np
import pytest
import scipy.io
from scipy.io import wavfile

from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError

X = np.random.default_rng(4).uniform(-1.0, 1.0, (200, 2))


def opened(tmp_path, text):
    (tmp_path / "record.csv").write_text(text)
    return open_foreign(tmp_path / "record.csv")


def table(form, count=200):
    return "t,A\n" + "\n".join(f"{k / 1000:.3f},{form.format(X[k, 0])}" for k in range(count))


@pytest.mark.parametrize(
    ("form", "cut"), [("{:.6f}", 1), ("{:.6f}", 5), ("{:.6f}", 7), ("{:.6E}", 1), ("{:.6E}", 4), ("{:.6E}", 9)]
)
def test_a_row_that_broke_off_within_its_last_number_is_left_out(tmp_path, form, cut):
    """`0.489` in place of 0.489628, or a mantissa without its exponent, was a measured value."""
    file = opened(tmp_path, table(form)[:-cut])
    assert file.groups[0].samples == 199 and file.notes == (
        "row 201 broke off within its last number and was left out",
    )


@pytest.mark.parametrize("form", ["{:.6f}", "{:.6E}", "{}", "{:.0f}", "{:.3g}"])
@pytest.mark.parametrize("count", [5, 60, 200])
def test_a_last_row_without_a_line_end_is_one(tmp_path, form, count):
    file = opened(tmp_path, table(form, count))
    assert file.groups[0].samples == count and not file.notes
    assert file.groups[0].read([1], count - 1, count)[0, 0] == float(form.format(X[count - 1, 0]))


def test_a_number_that_may_be_cut_is_kept_and_named(tmp_path):
    """Of numbers that differ in length, one that is shorter than all others may be a whole one."""
    file = opened(tmp_path, table("{}")[:-9])
    assert file.groups[0].samples == 200 and file.notes == ("row 201 may have broken off within its last number",)
    assert not opened(tmp_path, table("{}")[:-9] + "\n").notes


@pytest.mark.parametrize("kind", [np.int16, np.float32])
def test_a_wav_file_with_fewer_samples_than_it_states(tmp_path, kind):
    path = tmp_path / "record.wav"
    wavfile.write(path, 1000, (1000 * X).astype(kind))
    assert not any("early" in note for note in open_foreign(path).notes)
    path.write_bytes(path.read_bytes()[: -2 * 50 * np.dtype(kind).itemsize])
    file = open_foreign(path)
    assert file.groups[0].samples == 150 and "the file ends early, after 150 of 200 samples" in file.notes


def test_a_wav_file_that_was_never_completed_states_no_samples(tmp_path):
    path = tmp_path / "record.wav"
    wavfile.write(path, 1000, X)
    content = path.read_bytes()
    begin = content.index(b"data") + 4
    path.write_bytes(content[:begin] + b"\xff\xff\xff\xff" + content[begin + 4 :])
    assert open_foreign(path).groups[0].samples == 200 and not open_foreign(path).notes


def test_a_tdms_file_that_ends_within_a_segment(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "record.tdms"
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("g", "a", X[:, 0])])
    assert not open_foreign(path).notes
    path.write_bytes(path.read_bytes()[:-400])
    assert open_foreign(path).notes == ("the file ends early, within its last segment",)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("left", [0.4, 0.9])
def test_a_matlab_file_that_ends_within_a_variable(tmp_path, compressed, left):
    """The variable was not listed: `has no channel`, or records without it."""
    path = tmp_path / "record.mat"
    scipy.io.savemat(path, {"A": X[:, :1], "B": X[:, 1:]}, do_compression=compressed)
    assert len(open_foreign(path).groups) == 2
    path.write_bytes(path.read_bytes()[: int(left * path.stat().st_size)])
    with pytest.raises(UserError, match=r"truncated or damaged \(it ends within a variable"):
        open_foreign(path)
