"""Progress without a terminal: lines from time to time, none for short steps."""

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from balance_cli.cli import balance, labels, progress
from balance_cli.cli.labels import echo_message

ROOT = Path(__file__).parents[2]
GEOMETRY = ROOT / "configs" / "rts-6.yaml"
SWEEP = ROOT / "sample_data" / "sweep-Fx-low.h5"


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


def test_a_step_that_cannot_say_how_far_it_is_shows_that_it_is_at_work(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_INTERVAL", 0.05)
    with progress.working("fit"):
        time.sleep(0.3)
    lines = capsys.readouterr().err.splitlines()
    assert lines and set(lines) == {"balance: fit: at work for 0 s"}


@pytest.mark.parametrize(
    ("variables", "shown"),
    [
        ({}, False),
        ({"FORCE_COLOR": "1"}, True),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, False),
        ({"NO_COLOR": ""}, False),
    ],
)
def test_faults_are_colored_only_where_colors_are_shown(monkeypatch, capsys, variables, shown):
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    echo_message("error", "no such file")
    text = capsys.readouterr().err
    assert ("\x1b[31m" in text) is shown
    assert "no such file" in text and (text == "balance: error: no such file\n") is not shown


def test_a_terminal_has_colors_unless_no_color_is_set(monkeypatch):
    monkeypatch.setattr(labels.sys.stderr, "isatty", lambda: True, raising=False)
    for name in ("NO_COLOR", "FORCE_COLOR", "TERM"):
        monkeypatch.delenv(name, raising=False)
    assert labels.shows_colors()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not labels.shows_colors()


def test_quiet_leaves_warnings_and_errors_and_verbose_says_what_is_done(tmp_path):
    words = ["modes", "-g", str(GEOMETRY)]
    loud, quiet = (CliRunner().invoke(balance, [*words, *more]) for more in ([], ["-q"]))
    assert loud.stdout and (quiet.exit_code, quiet.stdout, quiet.stderr) == (0, "", "")
    words = ["identify", "-g", str(GEOMETRY), "--method", "computed", str(SWEEP), "-o", str(tmp_path / "m.h5")]
    done = CliRunner().invoke(balance, [*words, "-v"])
    assert done.exit_code == 0
    for step in ("1 runs opened in ", "spectra: 1 in ", "fit in ", "writing "):
        assert step in done.stderr
    assert "info" not in CliRunner().invoke(balance, words).stderr
    assert "no such file" in CliRunner().invoke(balance, [*words[:-3], "absent.h5", *words[-2:], "-q"]).stderr


def test_the_time_runs_on_while_an_item_or_a_task_takes_long(monkeypatch, capsys):
    monkeypatch.setattr(progress, "TICK", 0.02)
    monkeypatch.setattr(progress, "LINE_INTERVAL", 0.1)
    for _ in progress.track([1], "responses", 1, reads_files=False):
        time.sleep(0.3)
    with progress.progress_bar() as show:
        show("search", 0.5)
        time.sleep(0.3)
    lines = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("balance: responses, 0 of 1: 0 % after") for line in lines) >= 1
    assert sum(line.startswith("balance: search: 50 % after") for line in lines) >= 1


@pytest.mark.parametrize("columns", [0, 100])
def test_a_bar_is_drawn_on_a_terminal_that_does_not_know_its_size(columns):
    terminal, other = pty.openpty()
    fcntl.ioctl(other, termios.TIOCSWINSZ, struct.pack("HHHH", columns // 4, columns, 0, 0))
    code = "from balance_cli.cli.progress import track\nfor _ in track([1, 2], 'runs', 2): pass"
    subprocess.run([sys.executable, "-c", code], stderr=other, check=True)
    os.close(other)
    assert b"runs:" in os.read(terminal, 4096)
    os.close(terminal)
