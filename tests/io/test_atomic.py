"""Staged files: leftovers of killed processes go, files of running ones stay, disk errors name the file."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from balance_cli.io import atomic
from balance_cli.io.atomic import FOREIGN_PART_AGE, StagedOutputs, atomic_write, check_output_folder, unwritable_file
from balance_cli.io.errors import UserError

WAIT = 60.0
"""[s]. Far more than any of the processes below needs."""
WRITER = """
import sys
from pathlib import Path
from balance_cli.io.atomic import StagedOutputs
staged = StagedOutputs()
for name in sys.argv[2:]:
    staged.stage_file(Path(name)).write_text(sys.argv[1] * 10000)
print("staged", flush=True)
sys.stdin.readline()
staged.commit()
"""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and process numbers of POSIX")


def start_writer(text, *paths):
    command = [sys.executable, "-c", WRITER, text, *map(str, paths)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "staged\n"
    return process


def parts(folder):
    return sorted(path.name for path in folder.glob(".part-*"))


def end(process):
    process.communicate("go\n", timeout=WAIT)
    return process.returncode


def test_leftovers_of_a_killed_process_are_removed_by_the_next_writer(tmp_path):
    process = start_writer("a", tmp_path / "a.h5", tmp_path / "b.h5")
    process.kill()
    process.communicate(timeout=WAIT)
    assert len(parts(tmp_path)) == 2
    with atomic_write(tmp_path / "c.txt") as part:
        part.write_text("c")
    assert [path.name for path in tmp_path.iterdir()] == ["c.txt"]


def test_an_ended_process_that_nobody_waited_for_owns_nothing(tmp_path):
    process = start_writer("a", tmp_path / "a.h5")
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it stays a zombie
    check_output_folder(tmp_path)
    assert parts(tmp_path) == []
    process.communicate(timeout=WAIT)


@pytest.mark.parametrize("stopped", [False, True])
def test_files_of_a_running_process_stay(tmp_path, stopped):
    process = start_writer("a", tmp_path / "a.txt")
    try:
        if stopped:
            process.send_signal(signal.SIGSTOP)
        os.utime(tmp_path / parts(tmp_path)[0], (0, 0))
        with atomic_write(tmp_path / "b.txt") as part:
            part.write_text("b")
        assert len(parts(tmp_path)) == 1
    finally:
        process.send_signal(signal.SIGCONT)
    assert end(process) == 0
    assert (tmp_path / "a.txt").read_text() == "a" * 10000


@pytest.mark.parametrize("last", ["a", "b"])
def test_of_two_processes_the_last_wins_whole(tmp_path, last):
    targets = [tmp_path / "loads.csv", tmp_path / "loads.json"]
    writers = {text: start_writer(text, *targets) for text in "ab"}
    assert len(parts(tmp_path)) == 4
    for text in sorted(writers, key=last.__eq__):
        assert end(writers[text]) == 0
    assert [target.read_text() for target in targets] == [last * 10000] * 2
    assert parts(tmp_path) == []


def test_concurrent_commits_do_not_mix_outputs(tmp_path):
    targets = [tmp_path / f"{i}.txt" for i in range(40)]
    writers = [start_writer(text, *targets) for text in "abcd"]
    for writer in writers:
        writer.stdin.write("go\n")
        writer.stdin.flush()
    assert [end(writer) for writer in writers] == [0] * 4
    assert len({target.read_text() for target in targets}) == 1


@pytest.mark.parametrize(("age", "stays"), [(0.5 * FOREIGN_PART_AGE, True), (2.0 * FOREIGN_PART_AGE, False)])
@pytest.mark.parametrize("name", [".part-lab-00000000-1-1-1-a.h5", ".part-123-a.h5"])
def test_files_of_other_hosts_and_former_versions_go_when_they_are_old(tmp_path, name, age, stays):
    part = tmp_path / name
    part.write_text("a")
    then = part.stat().st_mtime - age
    os.utime(part, (then, then))
    check_output_folder(tmp_path)
    assert part.exists() == stays


def test_files_with_other_names_are_not_ours(tmp_path):
    for name in (".part-of-me", ".partial", "part-1-a"):
        (tmp_path / name).write_text("a")
        os.utime(tmp_path / name, (0, 0))
    check_output_folder(tmp_path)
    assert len(list(tmp_path.iterdir())) == 3


def test_a_later_process_with_the_same_number_is_not_the_owner():
    start = atomic._start_ticks(os.getpid())
    if start is None:
        pytest.skip("no /proc")
    assert atomic._is_running(os.getpid(), start)
    assert not atomic._is_running(os.getpid(), start + 1)


def test_long_names_can_be_staged(tmp_path):
    target = tmp_path / ("n" * 250 + ".h5")
    with atomic_write(target) as part:
        part.write_text("a")
    assert target.exists() and part.suffix == ".h5"
    with pytest.raises(UserError, match=r"File name too long\. Choose a shorter name"):
        StagedOutputs().stage_file(tmp_path / ("n" * 300))


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EFBIG, errno.EROFS, errno.EDQUOT])
@pytest.mark.parametrize("hdf5", [False, True])
def test_errors_of_the_disk_name_the_file_and_leave_nothing(tmp_path, number, hdf5):
    target = tmp_path / "a.h5"
    with (
        pytest.raises(UserError, match=f"a.h5: cannot be written: {os.strerror(number)}"),
        atomic_write(target) as part,
    ):
        part.write_text("half")
        raise RuntimeError(f"Can't close (errno = {number}, buf)") if hdf5 else OSError(number, "x")
    assert list(tmp_path.iterdir()) == []


def test_other_runtime_errors_are_not_errors_of_the_disk(tmp_path):
    with pytest.raises(RuntimeError, match="wrong"), atomic_write(tmp_path / "a.h5"):
        raise RuntimeError("wrong")


def test_a_signal_while_files_are_moved_is_postponed(tmp_path, monkeypatch):
    calls = []
    staged = StagedOutputs()
    monkeypatch.setattr(atomic, "_outputs", atomic._ProcessOutputs())
    for name in ("a", "b"):
        staged.stage_file(tmp_path / name).write_text(name)
    replace = Path.replace

    def interrupted_replace(part, target):
        assert atomic.abandon_outputs(lambda: calls.append(sorted(path.name for path in tmp_path.iterdir()))) is None
        return replace(part, target)

    monkeypatch.setattr(Path, "replace", interrupted_replace)
    staged.commit()
    assert calls == [["a", "b"]]
    assert atomic.abandon_outputs(lambda: None) == "outputs were written before"


def test_the_error_of_a_file_staged_twice_has_its_final_name(tmp_path):
    with atomic_write(tmp_path / "a.h5") as outer, atomic_write(outer) as inner:
        error = unwritable_file(OSError(errno.EFBIG, "too large"), inner)
        inner.touch()
    assert error.file == str(tmp_path / "a.h5")
