"""The journal survives an interruption at any byte."""

from dataclasses import replace

import pytest

from balance_cli.cli.watching.journal import REDUCED, JournalEntry, append_entry, read_entries
from balance_cli.io.errors import UserError

ENTRY = JournalEntry("2026-01-02T03:04:05+00:00", "a.h5", 10, 20, "abc", REDUCED, "run a", "wind", flags={"no zero": 6})


def test_entries_are_read_as_they_were_appended(tmp_path):
    path = tmp_path / "journal.jsonl"
    entries = [ENTRY, replace(ENTRY, file="b\nµ.h5", seconds=1.5, loads={"Fx": {"mean": 1.0}})]
    for entry in entries:
        append_entry(path, entry)
    assert [replace(entry, warnings=()) for entry in read_entries(path)] == entries
    assert len(path.read_text().splitlines()) == 2


def test_no_journal_has_no_entries(tmp_path):
    assert list(read_entries(tmp_path / "journal.jsonl")) == []


@pytest.mark.parametrize("kept", [0, 1, 40, -1])
def test_a_line_that_was_cut_off_costs_only_itself(tmp_path, kept):
    path = tmp_path / "journal.jsonl"
    append_entry(path, ENTRY)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:kept])
    append_entry(path, replace(ENTRY, file="c.h5"))
    files = [entry.file for entry in read_entries(path)]
    # Without its line break alone, the second line is whole.
    assert files == (["a.h5", "a.h5", "c.h5"] if kept == -1 else ["a.h5", "c.h5"])


def test_lines_of_something_else_are_passed_over(tmp_path):
    path = tmp_path / "journal.jsonl"
    path.write_text('[1, 2]\n{"file": "a.h5"}\nnull\n"text"\n')
    append_entry(path, ENTRY)
    assert [entry.file for entry in read_entries(path)] == ["a.h5"]


def test_a_journal_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "journal.jsonl").mkdir()
    with pytest.raises(UserError, match=r"journal\.jsonl"):
        append_entry(tmp_path / "journal.jsonl", ENTRY)
