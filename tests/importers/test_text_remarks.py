"""Remarks between the rows of a text file: left out and counted where times show that no sample is missing."""

import numpy as np
import pytest

from balance_cli.importers.base import TextLayout
from balance_cli.importers.text import open_file
from balance_cli.io.errors import UserError

ROWS = 40
TIMES = np.arange(ROWS) / 1000.0
HEAD = "t [s],F1 [V],F2 [V]"
LINES = [f"{t:.3f},{np.sin(9 * t):.6f},{np.cos(9 * t):.6f}" for t in TIMES]


def _write(path, before, head=HEAD, lines=LINES, encoding="utf-8"):
    """Write rows of data with other lines before some of them: {row: line}."""
    rows = [line for k, own in enumerate(lines) for line in ([before[k]] if k in before else []) + [own]]
    path.write_bytes(("\n".join([head, *rows]) + "\n").encode(encoding))
    return path


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
@pytest.mark.parametrize(
    ("before", "count"),
    [({20: "# amplifier restarted"}, 1), ({20: "Block 2"}, 1), ({3: "# early", 9: "% ö", 30: "// end of step, 2"}, 3)],
)
def test_remarks_are_left_out_with_a_note(tmp_path, before, count, encoding):
    """They were refused, and rows above an early one were taken for a head and lost in silence."""
    file = open_file(_write(tmp_path / "a.csv", before, encoding=encoding), TextLayout())
    (group,) = file.groups
    values = group.read([0, 1, 2], 0, group.samples)
    assert group.samples == ROWS and [channel.name for channel in group.channels] == ["t", "F1", "F2"]
    np.testing.assert_allclose(values[:, 0], TIMES, atol=1e-9)
    (note,) = file.notes
    first = min(before)
    words = "a remark between" if count == 1 else f"{count} remarks between"
    assert note.startswith(f"{words} the rows of data left out: row {first + 2} `{before[first]}`")


def test_errors_name_the_row_of_the_file(tmp_path):
    lines = [*LINES[:30], LINES[30].replace(",", ",x", 1), *LINES[31:]]
    file = open_file(_write(tmp_path / "a.csv", {10: "# one", 20: "# two"}, lines=lines), TextLayout())
    with pytest.raises(UserError, match="row 34, column `F1`"):
        file.groups[0].read([1], 0, ROWS)


def test_without_times_a_remark_may_stand_for_missing_samples(tmp_path):
    path = _write(tmp_path / "a.csv", {20: "# gap?"}, "F1 [V],F2 [V]", [line.split(",", 1)[1] for line in LINES])
    with pytest.raises(UserError, match=r"row 22: the remark `# gap.` stands within the data"):
        open_file(path, TextLayout())


def test_heads_and_missing_values_are_no_remarks(tmp_path):
    names = _write(tmp_path / "b.csv", {2: "# t,F1,F2"}, "% settings", ["7,1,2", "8,1,2", *LINES])
    (group,) = open_file(names, TextLayout()).groups
    assert group.samples == ROWS and [channel.name for channel in group.channels] == ["t", "F1", "F2"]
    lines = ["0.25"] * 10 + ["NaN"] + ["0.5"] * 10
    file = open_file(_write(tmp_path / "c.csv", {}, "F1 [V]", lines), TextLayout())
    assert file.groups[0].samples == 21 and file.notes == ()


def test_a_remark_where_the_times_begin_anew_is_refused(tmp_path):
    path = _write(tmp_path / "a.csv", {20: "# restarted"}, lines=[*LINES[:20], *LINES[:20]])
    with pytest.raises(UserError, match="row 22: the remark `# restarted` stands within the data"):
        open_file(path, TextLayout())


def test_remarks_between_dates_are_left_out(tmp_path):
    lines = [f"2024-03-12 10:11:{k:02d},{k * k}" for k in range(20)]
    file = open_file(_write(tmp_path / "a.csv", {8: "# weights added"}, "Time,F1 [V]", lines), TextLayout())
    assert file.groups[0].samples == 20 and "row 10 `# weights added`" in file.notes[0]
