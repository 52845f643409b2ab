"""UFF 58 and 58b: files of other programs, and byte patterns that they write."""

import numpy as np
import pytest

from balance_cli.importers import open_foreign
from balance_cli.importers.uff import data_form
from balance_cli.importers.written_numbers import plausible_rate
from balance_cli.io.errors import UserError
from tests.support.measured_data import SHARED

FOREIGN = SHARED / "foreign" / "uff"
foreign = pytest.mark.skipif(not FOREIGN.exists(), reason="files of other programs are not here")
TIME_FILES = ("Sample_UFF58_ascii.uff", "Sample_UFF58b_bin.uff", "binary8byte.uff", "mpstd_set001.uff")


def dataset(values, order="<", step="1.25000E-03", kind=4, end=b"\r\n", function=1, count=None, entity="Force"):
    """A dataset 58b (or 58 where `order` is empty) of real numbers, as test systems write it."""
    values = np.asarray(values)
    size = values.astype(f"{order or '<'}f{8 if kind == 4 else 4}").tobytes()
    sizes = f"{1 if order == '<' else 2}     2          11{count or len(size):12d}"
    first = f"    58b     {sizes}     0     0           0           0"
    header = [
        first if order else "    58",
        *("title", "NONE", "18-Apr-16 13:49:58", "NONE", "NONE"),
        f"{function:5d}         0    0         0 {entity:10s}         3   3 NONE               0   0",
        f"{kind:10d}{len(values):10d}         1  0.00000E+00  {step}  0.00000E+00",
        "        17    0    0    0 Time                 s",
        "         9    0    0    0 Force                N",
        "         0    0    0    0 NONE                 NONE",
        "         0    0    0    0 NONE                 NONE",
    ]
    text = b"    -1" + end + b"".join(line.encode("latin-1") + end for line in header)
    if order:
        return text + size + end + b"    -1" + end
    width, digits = (20, 12) if kind == 4 else (13, 5)
    numbers = [f"{value:{width}.{digits}E}".encode() for value in values]
    per_line = 4 if kind == 4 else 6
    lines = [b"".join(numbers[k : k + per_line]) for k in range(0, len(numbers), per_line)]
    return text + b"".join(line + end for line in lines) + b"    -1" + end


def opened(tmp_path, content):
    path = tmp_path / "record.bin"  # the name tells nothing
    path.write_bytes(content)
    return open_foreign(path)


def column(file, group=0):
    one = file.groups[group]
    return one.read([0], 0, one.samples)[:, 0]


@foreign
@pytest.mark.parametrize("name", TIME_FILES)
def test_values_are_those_of_pyuff(name):
    pyuff = pytest.importorskip("pyuff")
    sets = pyuff.UFF(str(FOREIGN / name)).read_sets()
    expected = [item["data"] for item in (sets if isinstance(sets, list) else [sets]) if item["type"] == 58]
    file = open_foreign(FOREIGN / name)
    assert len(file.groups) == len(expected)
    for group, values in zip(file.groups, expected, strict=True):
        assert np.allclose(group.read([0], 0, group.samples)[:, 0], values, rtol=1e-12)
        middle = group.samples // 3
        assert np.allclose(group.read([0], middle, middle + 7)[:, 0], values[middle : middle + 7], rtol=1e-12)


@foreign
def test_a_step_in_single_precision_is_the_rate_that_was_meant():
    text, binary = (open_foreign(FOREIGN / name) for name in TIME_FILES[:2])
    assert text.groups[0].rate == binary.groups[0].rate == 65536.0
    assert "65536" in text.notes[0] and text.recorded == "2016-04-18T13:49:58"


@foreign
@pytest.mark.parametrize(
    ("name", "words"),
    [("non_ascii_header.uff", "frequency response"), ("sample_dataset58_psd.uff", "spectral density")],
)
def test_what_is_no_time_record_says_what_it_is(name, words):
    (group,) = open_foreign(FOREIGN / name).groups
    assert words in group.unusable


@foreign
def test_ragged_columns_and_non_ascii_headers():
    (group,) = open_foreign(FOREIGN / "time-history-not-all-columns-filled.uff").groups
    assert (group.samples, group.rate, group.channels[0].unit) == (13, 20000.0, "m/s²")
    assert group.read([0], 11, 13)[:, 0].tolist() == [-3.46046, -5.84096]


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("kind", [2, 4])
@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r\r\n"])
def test_byte_orders_precisions_and_line_ends(tmp_path, order, kind, end):
    values = np.float32(np.random.default_rng(1).standard_normal(1001))
    file = opened(tmp_path, 2 * dataset(values, order, kind=kind, end=end))
    tolerance = 1e-5 if not order and kind == 2 else 1e-11
    assert [group.names for group in file.groups] == [("Force:3+Z",), ("Force:3+Z #2",)]
    assert all(np.allclose(column(file, k), values, rtol=tolerance, atol=tolerance) for k in (0, 1))
    assert file.groups[1].rate == 800.0 and file.groups[0].channels[0].unit == "N"


@pytest.mark.parametrize("stated", [7, 4008 + 500])
def test_a_misstated_count_of_bytes_does_not_matter(tmp_path, stated):
    values = np.arange(501.0)
    assert np.array_equal(column(opened(tmp_path, dataset(values, count=stated))), values)


def test_numbers_that_touch_each_other(tmp_path):
    content = dataset([-1.5, -2.5, 3.0], "", kind=2).replace(
        b" -1.50000E+00 -2.50000E+00  3.00000E+00", b"-1.50000E+000-2.50000E+000-3.00000E+000"
    )
    assert column(opened(tmp_path, content)).tolist() == [-1.5, -2.5, -3.0]


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
@pytest.mark.parametrize("order", ["<", ""])
def test_a_file_that_broke_off_is_refused(tmp_path, order, share):
    content = dataset(np.arange(300.0), order)
    with pytest.raises(UserError, match="truncated or damaged"):
        opened(tmp_path, content[: int(share * len(content))])


@pytest.mark.parametrize(
    ("step", "rate"),
    [
        ("1.52588E-05", 65536.0),
        ("1.95313E-05", 51200.0),
        ("1.95313E-03", 512.0),
        ("9.76563E-06", 102400.0),
        ("3.12500E-04", 3200.0),
        ("1.63840E-03", 1.0 / 1.6384e-3),
        ("0.001", 1000.0),
    ],
)
def test_plausible_rates(step, rate):
    assert plausible_rate(step)[0] == rate


def test_a_header_of_too_few_lines_is_damage():
    with pytest.raises(UserError, match="truncated or damaged"):
        data_form(["name", "NONE"])
