"""Tables as laboratories write them."""

import re
from pathlib import Path

import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.io.table_text import TextTable, parse_number, read_table

EXPECTED = [[0.0, 0.5], [10.0, -1.25], [-20.0, 2e-3]]


def table(tmp_path: Path, text: str, encoding: str = "utf-8") -> TextTable:
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode(encoding))
    return read_table(path)


@pytest.mark.parametrize(
    "text",
    [
        "Fx,B1\n0,0.5\n10,-1.25\n-20,2e-3\n",
        "Fx;B1\r\n0;0,5\r\n10;-1,25\r\n-20;2e-3\r\n",
        "Fx\tB1\n0\t0,5\n10\t-1,25\n-20\t0,002\n",
        'Fx,B1\n0,"0,5"\n10,"-1,25"\n-20,"0,002"\n',
        "# made in 2019\nFx   B1\n  0   0.5\n 10 -1.25\n\n-20 2.0D-03\n",
        "Calibration 7;\nby hand;\nFx;B1\n0;0,5\n% spoilt\n10;-1,25\n-20;0,002\n",
        "Fx,B1,,\n0,0.5,,\n10,-1.25,,\n-20,2e-3,,\n",
        "Fx | B1\n0 | 0.5\n10 | -1.25\n-20 | 0.002\n",
        "Fx,B1\n0,0.5\n\nFx,B1\n10,-1.25\nFx,B1\n-20,2e-3\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_dialects(tmp_path: Path, text: str, encoding: str) -> None:
    read = table(tmp_path, text, encoding)
    assert read.header == ("Fx", "B1")
    assert read.units == ()
    assert np.column_stack([read.numbers(0), read.numbers(1)]) == pytest.approx(np.array(EXPECTED))


@pytest.mark.parametrize("units", ["N,mV/V", "[N],[mV/V]", "(N),"])
def test_units_row(tmp_path: Path, units: str) -> None:
    read = table(tmp_path, f"Fx,B1\n{units}\n0,0.5\n10,-1.25\n")
    assert read.header == ("Fx", "B1")
    assert read.units[0] == "N"
    again = table(tmp_path, f"Fx,B1\n{units}\n0,0.5\nFx,B1\n{units}\n10,-1.25\n")
    assert again.rows[1] == (6, ("10", "-1.25"))


@pytest.mark.parametrize("text", ["z.strain [V]\n0.01\n-2.5e-3\n", "Readings of today\nz.strain\n[V]\n0.01\n-2.5e-3\n"])
def test_a_table_of_one_column(tmp_path: Path, text: str) -> None:
    read = table(tmp_path, text)
    assert read.header[0].startswith("z.strain")
    np.testing.assert_array_equal(read.numbers(0), [0.01, -2.5e-3])


def test_labels_are_no_numbers(tmp_path: Path) -> None:
    read = table(tmp_path, "run,Fx,B1,B2\na,1,2,3\nb,4,5,6\n")
    assert read.texts(0) == ("a", "b")
    with pytest.raises(UserError, match="line 2, column `run`: `a` is not a number"):
        read.numbers(0)


@pytest.mark.parametrize("label", ["axial, up", "axial; up", "axial | up"])
def test_labels_in_quotes_hold_any_separator(tmp_path: Path, label: str) -> None:
    read = table(tmp_path, f'series,Fx,B1\n"{label}",1,2\n"{label}",3,4\n')
    assert read.header == ("series", "Fx", "B1")
    assert read.texts(0) == (label, label)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Fx,B1\n1,2\n3\n4,5\n5,6\n6,7\n", r"line 3: has 1 column, the head \(line 1\) has 2"),
        ("1,2\n3,4\n", "begins with numbers"),
        ("", "has no rows"),
        ("hello\nworld\n", "no rows of numbers"),
        ("Fx,Fx\n1,2\n", "names two columns `Fx`"),
        ('Fx,B1\n"1,2\n', "not a line of a table|no rows of numbers"),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        table(tmp_path, text)


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        *(("", "empty"), ("nan", "not finite"), ("1_0", "not a number"), ("x", "not a number")),
        *(("1 234", "thousands"), ("12'34.5", "not a number"), ('"1,23.4"', "not a number")),
    ],
)
def test_bad_cells(tmp_path: Path, cell: str, words: str) -> None:
    read = table(tmp_path, f"Fx,B1,B2\n1,2,3\n4,{cell},5\n")
    with pytest.raises(UserError, match=f"line 3, column `B1`: .*{words}"):
        read.numbers(1)


def test_mixed_decimal_signs_are_refused(tmp_path: Path) -> None:
    read = table(tmp_path, "Fx;B1\n1,5;2,5\n3,5;4.5\n")
    with pytest.raises(UserError, match="either decimal points or decimal commas"):
        read.numbers(1)


def test_other_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "t.xlsx"
    path.write_bytes(b"PK\x03\x04rest")
    with pytest.raises(UserError, match="workbook"):
        read_table(path)
    for text, fault in (
        ('<?xml version="1.0"?>\n<FTSensor Serial="1"/>', "calibration matrix of an ATI sensor.*--from-matrix"),
        ('\ufeff<?xml version="1.0"?>\n<a/>', "XML or a web page"),
        ("\n<!DOCTYPE html>\n<p>1,2</p>", "XML or a web page"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(UserError, match=fault):
            read_table(path)
    with pytest.raises(UserError, match="no such file"):
        read_table(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ('"1,234.5",2\n"12,000",-1', [1234.5, 12000.0]),
        ("1 234.5,2\n500,-1", [1234.5, 500.0]),
        ("1.234,5;2,5\n12.000;-1,5", [1234.5, 12000.0]),
    ],
)
def test_signs_between_thousands(tmp_path: Path, rows: str, expected: list[float]) -> None:
    read = table(tmp_path, f"Fx{';' if ';' in rows else ','}B1\n" + rows + "\n")
    assert read.numbers(0) == pytest.approx(expected)


VALUES = [[10, 1.25, 0.5], [20, -2.5, 3.5], [30, 0.25, -1.5], [40, 5.0, 2.5], [55, 1.5, 0.75], [60, 2.5, 4.25]]


def points_with(lines: list[str]) -> str:
    return "No,Fx,B1,B2\n" + "".join(f"{i},{a},{b},{c}\n" for i, (a, b, c) in enumerate(VALUES, 1)) + "\n".join(lines)


@pytest.mark.parametrize(
    "lines",
    [
        ["Mean,35.8,1.33,1.67"],
        ["Mittelwert:,35.8,1.33,1.67", "Std. dev.,19.8,2.49,2.1", "Max,60,5,4.25"],
        [",35.833333,1.333333,1.666667"],
        ["3.5,35.833,1.333,1.667", "1.8708,19.6,2.523,2.133"],
        ["", "End of data", "Operator: A. Smith, bench 2"],
        ["Full scale,500,500,500"],
    ],
)
def test_rows_of_statistics_and_footers_are_no_load_points(tmp_path: Path, lines: list[str]) -> None:
    read = table(tmp_path, points_with(lines))
    assert [line for line, _ in read.rows] == list(range(2, 8))
    assert [line for line, _ in read.other_rows] == [8 + i for i, text in enumerate(lines) if text]


@pytest.mark.parametrize("line", ["7,36,1.33,1.67", "7,0,0,0", "7,60,5,4.25", "max,36,1.4,1.6", "mean,36,1.4,1.6"])
def test_load_points_like_statistics_remain(tmp_path: Path, line: str) -> None:
    """A rounded mean that the digits contradict, the largest load with its readings, and labels that stay labels."""
    text = points_with([line])
    if line[0] == "m":
        text = re.sub(r"(?m)^\d,", line.split(",", maxsplit=1)[0] + ",", text)
    assert len(table(tmp_path, text).rows) == 7


def test_an_unloaded_row_at_the_end_of_a_symmetric_schedule_is_a_load_point(tmp_path: Path) -> None:
    """Its readings are the means of the columns, as those of the first row; a coarse converter shows no difference."""
    rows = [
        (0, 37, 41, 52),
        (10, 87, 31, 60),
        (20, 137, 21, 68),
        (-10, -13, 51, 44),
        (-20, -63, 61, 36),
        (0, 37, 41, 52),
    ]
    text = "Fx,B1,B2,B3\n" + "\n".join(",".join(f"{v:.2f}" for v in row) for row in rows) + "\n"
    assert len(table(tmp_path, text).rows) == len(rows)


@pytest.mark.parametrize("cell", ["2e\N{MINUS SIGN}1", "0e'1", "1.6e-05e9", "0e99999", "x"])
def test_the_last_rows_are_compared_with_points_that_have_unusual_numbers(tmp_path: Path, cell: str) -> None:
    read = table(tmp_path, points_with([]).replace(",0.25,", f",{cell},"))
    assert len(read.rows) == 6


def test_headings_of_blocks(tmp_path: Path) -> None:
    text = "Fx,B1\nN,mV\nSeries 1\n0,1\n5,2\n6,3\n\nSeries 2,\nFx,B1\nN,mV\n7,3\n8,4\n9,5\n"
    read = table(tmp_path, text)
    assert (read.header, read.units) == (("Fx", "B1"), ("N", "mV"))
    assert [line for line, _ in read.rows] == [4, 5, 6, 11, 12, 13]
    assert [line for line, _ in read.other_rows] == [8]


def test_numbers() -> None:
    assert parse_number("\N{MINUS SIGN}1.5") == -1.5
    assert parse_number("1,5", decimal_comma=True) == 1.5
    assert parse_number("1.000,5", decimal_comma=True) is None
    assert parse_number("12'345'678.5") == 12345678.5
    assert parse_number("1\u202f000,5", decimal_comma=True) == 1000.5
