"""The program where a standard stream is closed, full or not read on, and where its surroundings are odd."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from balance_cli.__main__ import _open_closed_streams

ROOT = Path(__file__).parents[2]
GEOMETRY = ROOT / "configs" / "one-dof.yaml"

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="devices of Linux")


def run_in_shell(line, **variables):
    """The exit status and stderr of a shell line in which BALANCE stands for the program."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), **variables}
    line = line.replace("BALANCE", f"{sys.executable} -m balance_cli").replace("GEOMETRY", str(GEOMETRY))
    done = subprocess.run(["bash", "-c", line], env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.parametrize("stream", ["2>&-", "2>/dev/full", "<&- >&- 2>&-"])
def test_the_status_is_right_where_nobody_reads_the_message(stream):
    assert run_in_shell(f"BALANCE modes -g none.yaml {stream}")[0] == 2


@pytest.mark.parametrize("words", ["check GEOMETRY", "modes -g GEOMETRY --json -", "--help", "modes --help"])
def test_output_that_nobody_reads_ends_the_program_as_sigpipe_ends_other_tools(words):
    assert run_in_shell(f"BALANCE {words} | true; exit ${{PIPESTATUS[0]}}")[0] == 141


def test_results_are_written_before_they_are_printed(tmp_path):
    line = f"BALANCE identify -g GEOMETRY --method computed -o {tmp_path}/model.h5 | true; exit ${{PIPESTATUS[0]}}"
    assert run_in_shell(line) == (141, "")
    assert (tmp_path / "model.h5").stat().st_size > 0


def test_a_broken_pipe_of_something_else_is_an_internal_error():
    code = "from balance_cli.cli import balance; import click\n"
    code += "@balance.command()\ndef fail():\n raise BrokenPipeError(32, 'a worker')\n"
    code += "balance.get_command = lambda *a: fail\n"
    done = subprocess.run([sys.executable, "-c", f"{code}balance(['fail'])"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1 and "internal error, BrokenPipeError" in done.stderr


def test_the_number_of_a_closed_stream_is_not_that_of_a_file(tmp_path):
    code = "from balance_cli.__main__ import _open_closed_streams as f; f(); import os, sys"
    path = tmp_path / "data"
    line = f"{sys.executable} -c '{code}; print(os.open(sys.argv[1], os.O_CREAT) > 2, file=sys.stderr)' {path} <&- >&-"
    assert run_in_shell(line) == (0, "True\n")
    _open_closed_streams()  # where they are open it does nothing


def test_a_folder_that_is_gone_and_a_backend_that_is_unknown():
    status, said = run_in_shell('cd "$(mktemp -d)"; rmdir "$PWD"; BALANCE modes -g none.yaml')
    assert status == 2 and "current folder does not exist" in said
    line = "BALANCE modes -g GEOMETRY; " + f"{sys.executable} -c 'import balance_cli.__main__, matplotlib.pyplot'"
    assert run_in_shell(line, MPLBACKEND="nonsense")[0] == 0
