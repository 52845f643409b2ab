"""Progress without a terminal: lines from time to time, none for short steps."""

import pytest

from balance_cli.cli import progress


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_long_loop_writes_a_line_every_ten_seconds(clock, capsys):
    seen = []
    for item in progress.track(range(100), "runs", 100):
        seen.append(item)
        clock[0] += 1.0
    assert seen == list(range(100))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 9
    assert lines[0] == "balance: runs, 10 of 100: 10 % after 10 s, about 90 s left"


def test_a_short_loop_and_one_of_unknown_length_are_silent(clock, capsys):
    assert list(progress.track([1, 2], "runs", 2)) == [1, 2]
    for _ in progress.track(iter(range(30)), "runs", None):
        clock[0] += 1.0
    assert capsys.readouterr().err == ""


def test_a_step_that_reports_itself_writes_lines(clock, capsys):
    with progress.progress_bar() as show:
        show("search", 0.0)
        clock[0] += 12.0
        show("search, round 2", 0.25)
        show("search, round 2", 0.26)
    assert capsys.readouterr().err == "balance: search, round 2: 25 % after 12 s, about 36 s left\n"
