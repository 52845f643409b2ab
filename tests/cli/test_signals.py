"""Signals and limits in real processes: one line on stderr, the exit status of the contract, nothing left behind."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from balance_cli.cli.errors import report_error
from balance_cli.cli.pipeline.execution import START_COMMAND

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

ROOT = Path(__file__).parents[2]
RIG = str(ROOT / "configs" / "rts-6.yaml")
WAIT = 120.0
"""[s]. Far more than any of the processes below needs."""

AT_IMPORT = """
import os, runpy, sys
module, number = sys.argv[1], int(sys.argv[2])
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), number)
sys.meta_path.insert(0, Interrupt())
"""
MODULE = "sys.argv[:3] = ['balance']\nrunpy.run_module('balance_cli', run_name='__main__', alter_sys=True)"
SCRIPT = "from balance_cli.__main__ import main\nsys.argv[:3] = ['balance']\nsys.exit(main())"
AT_STAGING = """
import os, signal, sys
from balance_cli.io import atomic
stage_file = atomic.StagedOutputs.stage_file
number, sys.argv[1:] = int(sys.argv[1]), sys.argv[2:]
def stage_and_kill(self, path):
    part = stage_file(self, path)
    part.write_bytes(b"half")
    os.kill(os.getpid(), number)
    return part
atomic.StagedOutputs.stage_file = stage_and_kill
from balance_cli.__main__ import main
main()
"""


FOREGROUND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
"""
"""A shell that starts the tests in the background has them ignore interrupts, and nohup that the terminal closes."""


def run(code, *words, **options):
    words = [sys.executable, "-c", FOREGROUND + code, *map(str, words)]
    return subprocess.run(words, capture_output=True, text=True, timeout=WAIT, **options)


@pytest.mark.parametrize("start", [MODULE, SCRIPT], ids=["module", "script"])
@pytest.mark.parametrize(
    "module", ["click", "click.core", "balance_cli.cli.errors", "numpy", "numpy.linalg", "yaml", "pydantic"]
)
def test_an_interrupt_during_imports_is_one_line(start, module, tmp_path):
    done = run(AT_IMPORT + start, module, int(signal.SIGINT), "modes", "-g", RIG, cwd=ROOT)
    assert (done.returncode, done.stderr) == (130, "balance: error: interrupted, nothing written\n")


def test_an_interrupt_of_the_help_is_one_line():
    done = run(AT_IMPORT + MODULE, "click.core", int(signal.SIGINT), "--help", cwd=ROOT)
    assert (done.returncode, done.stderr) == (130, "balance: error: interrupted, nothing written\n")


@pytest.mark.parametrize(
    ("name", "word"), [("SIGINT", "interrupted"), ("SIGTERM", "terminated"), ("SIGHUP", "terminal closed")]
)
def test_signals_remove_what_is_staged(tmp_path, name, word):
    number = int(getattr(signal, name))
    words = ("modes", "-g", RIG, "--json", tmp_path / "modes.json")
    done = run(AT_STAGING, number, *words, cwd=ROOT)
    assert (done.returncode, done.stderr) == (128 + number, f"balance: error: {word}, nothing written\n")
    assert list(tmp_path.iterdir()) == []


def test_the_next_call_removes_what_a_killed_one_left(tmp_path):
    words = ("modes", "-g", RIG, "--json", tmp_path / "modes.json")
    assert run(AT_STAGING, int(signal.SIGKILL), *words, cwd=ROOT).returncode == -signal.SIGKILL
    assert [path.name.startswith(".part-") for path in tmp_path.iterdir()] == [True]
    assert subprocess.run([sys.executable, "-m", "balance_cli", *words], cwd=ROOT, capture_output=True).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["modes.json"]


def test_a_signal_that_the_caller_ignores_stays_ignored(tmp_path):
    words = ("modes", "-g", RIG, "--json", tmp_path / "modes.json")
    ignoring = f"import signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n{AT_STAGING}"
    done = run(ignoring, int(signal.SIGHUP), *words, cwd=ROOT)
    assert done.returncode == 2 or (tmp_path / "modes.json").exists()
    assert "terminal closed" not in done.stderr


def test_the_limit_of_file_sizes_is_one_message(tmp_path):
    code = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n" + SCRIPT.replace(
        "sys.argv[:3] = ['balance']", "import sys"
    )
    done = run(code, "modes", "-g", RIG, "--json", tmp_path / "modes.json", cwd=ROOT)
    assert done.returncode == 2
    assert "modes.json: cannot be written: File too large. Raise the limit" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_standard_output_is_one_message():
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "balance_cli", "modes", "-g", RIG]
        done = subprocess.run(command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, timeout=WAIT)
    assert done.returncode == 2
    assert done.stderr == (
        "balance: error: output: cannot be written: No space left on device. Free some space, or choose another place\n"
    )


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9 GiB"),
        OSError(12, "Cannot allocate memory"),
        ImportError("x.so: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
    ],
)
def test_a_lack_of_memory_is_no_internal_error(error, capsys):
    assert report_error(error, verbose=False) == 2
    assert capsys.readouterr().err.startswith("balance: error: not enough memory. Raise the memory limit")


def test_a_read_only_file_system_is_no_internal_error(capsys):
    assert report_error(OSError(30, "Read-only file system", "loads.csv"), verbose=False) == 2
    assert "loads.csv: cannot be written: Read-only file system" in capsys.readouterr().err


def test_a_step_ends_with_the_chain_that_started_it():
    read_end, write_end = os.pipe()
    words = [sys.executable, "-c", START_COMMAND, "\n".join([str(ROOT), *sys.path]), "modes", "-g", RIG]
    step = subprocess.Popen(words, stdin=read_end, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT)
    os.close(read_end)
    os.close(write_end)  # as the system does when the chain is killed
    # By the signal itself, or once the program handles signals.
    assert step.wait(WAIT) in (-signal.SIGTERM, 128 + signal.SIGTERM)


KILLED_BATCH = """
import os, signal, sys
from balance_cli.cli.batch.executors import batch_workers
if __name__ == "__main__":
    pool = batch_workers(2, None).open()
    assert pool.submit(abs, -1).result() == 1
    print(*os.listdir(os.environ["TMPDIR"]), flush=True)
    os.kill(os.getpid(), int(sys.argv[1]))
"""


IMPORTED_SERVER = """
import os
from balance_cli.cli.batch.executors import batch_workers
if __name__ == "__main__":
    with batch_workers(2, None).open() as pool:
        assert pool.submit(abs, -1).result() == 1
    import balance_cli.cli.batch.server
    print(*os.listdir(os.environ["TMPDIR"]))
"""


def test_the_module_of_the_server_may_be_imported_elsewhere(tmp_path):
    """The process that had started workers lost its folder, and printed a traceback when it ended."""
    done = run(IMPORTED_SERVER, cwd=ROOT, env=os.environ | {"TMPDIR": str(tmp_path)})
    assert (done.returncode, done.stderr) == (0, "")
    assert "pymp-" in done.stdout and list(tmp_path.iterdir()) == []


def test_a_killed_batch_leaves_no_temporary_files(tmp_path):
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    # The pipes of the output are open until the last of its processes has ended.
    done = run(KILLED_BATCH, int(signal.SIGKILL), cwd=ROOT, env=environment)
    assert (done.returncode, done.stderr) == (-signal.SIGKILL, "")
    assert "pymp-" in done.stdout and list(tmp_path.iterdir()) == []
