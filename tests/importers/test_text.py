"""Text files as Excel, DIAdem, LabVIEW and others write them."""

from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from balance_cli.importers import open_foreign
from balance_cli.importers.base import TextLayout
from balance_cli.importers.time_axis import read_time_axis
from balance_cli.io.errors import UserError
from balance_cli.io.text_numbers import fillers_as_missing

ROWS = [(0.0, 1.5, -2.25), (0.1, 2.5, -3.25), (0.2, 3.5, 1e-7), (0.3, 4.5, 12345.678)]


def text_of(separator, decimal, header, rows=ROWS):
    cell = lambda value: f"{value!r}".replace(".", decimal)  # noqa: E731
    lines = [*header, *(separator.join(map(cell, row)) for row in rows)]
    return "\r\n".join(lines) + "\r\n"


def opened(tmp_path, content, encoding="utf-8", **layout):
    path = tmp_path / "record"
    path.write_bytes(content.encode(encoding) if isinstance(content, str) else content)
    return open_foreign(path, TextLayout(**layout))


def values(file):
    (group,) = file.groups
    return group.read(range(len(group.channels)), 0, group.samples)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252", "utf-16-le"])
@pytest.mark.parametrize(
    ("separator", "decimal"), [(";", ","), (",", "."), ("\t", ","), (";", "."), (" ", "."), ("|", ".")]
)
def test_separators_decimals_and_encodings(tmp_path, separator, decimal, encoding):
    name = separator.join(["Time", "Kraft_ä", "M"])
    units = separator.join(["s", "N", "mV"])
    file = opened(tmp_path, text_of(separator, decimal, ["Versuch 12°", "", name, units]), encoding)
    assert file.groups[0].names == ("Time", "Kraft_ä", "M")
    assert [channel.unit for channel in file.groups[0].channels] == ["s", "N", "mV"]
    assert np.array_equal(values(file), ROWS)


def test_units_in_brackets_and_a_stated_rate(tmp_path):
    file = opened(tmp_path, text_of(",", ".", ["Sample rate: 2.4 kHz", "Fx [N],Fy (lbf),Mz [N m]"]))
    assert [(c.name, c.unit) for c in file.groups[0].channels] == [("Fx", "N"), ("Fy", "lbf"), ("Mz", "N m")]
    assert file.scalars == {"sample_rate": 2400.0}


def test_separator_line_of_excel_and_trailing_separators(tmp_path):
    file = opened(tmp_path, "sep=;\r\nA;B;\r\n1,5;2;\r\n3,5;4;\r\n")
    assert file.groups[0].names == ("A", "B") and values(file).tolist() == [[1.5, 2.0], [3.5, 4.0]]


def test_no_header_at_all(tmp_path):
    file = opened(tmp_path, "1 2\n3 4\n5 6\n")
    assert file.groups[0].names == ("column 1", "column 2") and values(file)[:, 1].tolist() == [2, 4, 6]


def test_missing_values_are_not_a_number(tmp_path):
    read = values(opened(tmp_path, "a,b\n1,\nNaN,4\n5,---\n7,8\n"))
    assert np.array_equal(np.isnan(read), [[False, True], [True, False], [False, True], [False, False]])


def test_clock_times_become_seconds(tmp_path):
    lines = [f"18.04.2023 23:59:59,{k}00;{k}" for k in range(8)]
    file = opened(tmp_path, "Zeit;x\n" + "\n".join(lines))
    assert file.groups[0].names == ("Zeit", "x")
    assert np.allclose(np.diff(values(file)[:, 0]), 0.1) and values(file)[:, 1].tolist() == list(range(8))


def test_a_row_that_broke_off_is_left_out_and_said(tmp_path):
    file = opened(tmp_path, "a,b,c\n1,2,3\n4,5,6\n7,8")
    assert file.groups[0].samples == 2 and "row 4 broke off" in file.notes[0]


def test_a_word_among_the_numbers_is_named_by_row_and_column(tmp_path):
    file = opened(tmp_path, "a;b\n" + "1;2\n" * 20000 + "1;overload\n" + "1;2\n" * 10)
    with pytest.raises(UserError, match="`overload` is not a number") as caught:
        values(file)
    assert caught.value.place == "row 20002, column `b`"


def test_a_row_with_too_many_cells_is_named(tmp_path):
    file = opened(tmp_path, "a,b\n" + "1,2\n" * 20000 + "1,2,5\n" + "1,2\n" * 10)
    with pytest.raises(UserError, match="3 cells") as caught:
        values(file)
    assert caught.value.place == "row 20002"


@pytest.mark.parametrize("content", ["no numbers here\nat all\n", "\n\n\n", "{}\n"])
def test_text_without_columns_is_refused(tmp_path, content):
    with pytest.raises(UserError, match="no columns of numbers"):
        opened(tmp_path, content)


def test_layout_can_be_stated(tmp_path):
    file = opened(tmp_path, "1;2\n3;4\n5;6\n", name_row=1, first_row=2, separator=";")
    assert file.groups[0].names == ("1", "2") and values(file).tolist() == [[3, 4], [5, 6]]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False, width=64)] * 3), min_size=1, max_size=30),
    st.sampled_from([(";", ","), (",", "."), ("\t", "."), ("\t", ",")]),
)
def test_any_numbers_come_back(tmp_path_factory, rows, signs):
    path = tmp_path_factory.mktemp("text")
    file = opened(path, text_of(*signs, [signs[0].join(["alpha", "beta", "gamma"])], rows))
    assert file.groups[0].names == ("alpha", "beta", "gamma")
    expected = fillers_as_missing(np.array(rows))  # hypothesis finds 9.91e37 among the constants of the package
    assert np.allclose(values(file), expected, rtol=1e-14, atol=0, equal_nan=True)


def test_blocks_are_parts_of_the_whole(tmp_path):
    rows = np.random.default_rng(0).standard_normal((40000, 2))
    file = opened(tmp_path, "a,b\n" + "\n".join(f"{x!r},{y!r}" for x, y in rows.tolist()))
    (group,) = file.groups
    assert group.samples == 40000
    assert np.allclose(group.read([1], 16380, 24600)[:, 0], rows[16380:24600, 1], rtol=1e-14)


# ---- time columns ----------------------------------------------------------------------------------------------------


def axis(times):
    return read_time_axis(lambda columns, a, b: np.asarray(times)[a:b, None], len(times))


def test_times_rounded_to_milliseconds_give_the_rate():
    found = axis(np.round(5.0 + np.arange(40960) / 1024.0, 3))
    assert found.rate == 1024.0 and abs(found.start - 5.0) < 1e-5 and 0.4 < found.scatter < 0.6


def test_a_missing_sample_is_found():
    times = np.delete(np.arange(5000) / 1000.0, 3217)
    with pytest.raises(UserError, match="not even") as caught:
        axis(times)
    assert caught.value.place == "sample 3218"


@pytest.mark.parametrize(
    ("rows", "sample", "remedy"),
    [
        (np.insert(np.arange(6000), 3000, 2999), 3001, "Remove rows that are there twice"),
        (np.r_[0:3000, 2500:6000], 3001, "each once"),
        (np.r_[0:3000, 3001, 3000, 3002:6000], 3002, "in the order of their times"),
        (np.r_[0:3000, 0:3000], 3001, "a clock that begins anew is another record"),
        (np.r_[0:3000, 3003:6000], 3001, "Cut the record at the gap"),
    ],
)
def test_rows_that_are_there_twice_or_in_another_order_are_no_gap(rows, sample, remedy):
    """The sample rate in the map, which was the remedy for all, reads such records without a word."""
    with pytest.raises(UserError, match="not even") as caught:
        axis(rows / 1000.0)
    assert caught.value.place == f"sample {sample}" and remedy in str(caught.value.remedy)


def test_a_record_in_reverse_order_is_told_to_be_that():
    with pytest.raises(UserError, match="decrease") as caught:
        axis(np.arange(6000)[::-1] / 1000.0)
    assert "sample rate" not in str(caught.value.remedy)


def test_a_rate_that_is_not_whole_stays():
    assert axis(np.arange(10000) / 610.3516).rate == pytest.approx(610.3516, rel=1e-12)


def rounded_half_up(index, rate, digits):
    time = Decimal(index) / Decimal(rate)
    return float(time.quantize(Decimal(1).scaleb(time.adjusted() - digits + 1), ROUND_HALF_UP)) if index else 0.0


@pytest.mark.parametrize(
    ("rate", "count", "digits"), [(4000, 4000, 3), (2000, 400, 3), (4000, 20000, 4), (2560, 800, 4)]
)
def test_times_of_few_digits_give_the_rate_and_not_that_of_a_straight_line(rate, count, digits):
    """Spreadsheets write `1.03E-02`: a line through such times is off by up to 0.2 %, or seems to have a gap."""
    found = axis([rounded_half_up(index, rate, digits) for index in range(count)])
    assert (found.rate, found.start) == (rate, pytest.approx(0.0, abs=1e-5))


@pytest.mark.parametrize("start", [*(1.77e9 + 86400.0 * day for day in range(8)), 86000.2, 50707.0])
@pytest.mark.parametrize("seconds", [2, 20])
def test_dates_and_times_of_day_are_no_times_of_few_digits(start, seconds):
    """To 0.2 of its last digit any number has six: on a third of all days a record of 1024 Hz had 1020."""
    assert axis(np.round(start + np.arange(1024 * seconds) / 1024, 6)).rate == 1024


def test_a_missing_sample_among_times_of_few_digits_is_found():
    with pytest.raises(UserError, match=r"not even.*too few digits"):
        axis(np.delete([rounded_half_up(index, 4000, 3) for index in range(4000)], 2217))


@pytest.mark.parametrize("count", [3, 99, 511, 513, 1025])
def test_short_records(count):
    assert axis(np.arange(count) / 8.0).rate == 8.0
