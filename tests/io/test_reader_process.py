"""Reading in a child process: what ends or stops the child is an error of the file, and the next file is read."""

import gzip
import os
import pickle
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.io import reader_process as module
from balance_cli.io.errors import UserError
from balance_cli.io.reader_process import read_in_child, reader_process

pytestmark = pytest.mark.skipif(not module.CAN_FORK, reason="the system cannot fork safely")

DAMAGED = Path(__file__).parent / "damaged"
"""Run file with bytes swapped in the index of its chunks (SIGSEGV in HDF5 2.0), model with bits flipped in an attribute
(endless loop)."""


@read_in_child
def process_of(path):
    return os.getpid()


@read_in_child
def end_by(path, number):
    os.kill(os.getpid(), number)


@read_in_child
def turn_in_circles(path):
    while True:
        pass


@read_in_child
def refuse(path):
    raise UserError("is empty", str(path), "line 1", remedy="Fill it")


@read_in_child
def fail(path):
    raise ZeroDivisionError("by zero")


@read_in_child
def arrays(path, count):
    return {"a": np.arange(count), "b": np.asfortranarray(np.ones((3, count))), "text": "x"}


@read_in_child
def allocate(path):
    return np.ones(2 * module.BASE_MEMORY // 8).sum()


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "a.h5"
    file.write_bytes(b"content")
    return file


def test_without_a_reader_process_the_function_is_called_directly(path):
    assert process_of(path) == os.getpid()


def test_one_child_reads_all_files_and_ends_with_the_context(path):
    with reader_process():
        child = process_of(path)
        assert child != os.getpid()
        assert process_of(path) == child
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_arrays_come_back_whole_and_writable(path):
    with reader_process():
        result = arrays(path, 1_000_000)
    np.testing.assert_array_equal(result["a"], np.arange(1_000_000))
    np.testing.assert_array_equal(result["b"], np.ones((3, 1_000_000)))
    result["a"][0] = 7


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGABRT, signal.SIGKILL])
def test_the_death_of_the_child_is_an_error_of_the_file(path, tmp_path, number):
    with reader_process():
        with pytest.raises(UserError, match=rf"a\.h5.*{number.name}.*damaged"):
            end_by(path, number)
        with pytest.raises(UserError, match=number.name):  # at once: no second child is risked on this file
            process_of(path)
        assert process_of(tmp_path / "b.h5") > 0


def test_an_endless_loop_is_an_error_of_the_file(path, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "BASE_CPU_TIME", 0.1)
    begun = time.process_time()
    with reader_process():
        with pytest.raises(UserError, match=r"a\.h5.*processor time.*damaged"):
            turn_in_circles(path)
        assert process_of(tmp_path / "b.h5") > 0
    assert time.process_time() - begun < 1.0  # the parent only waits


def test_memory_of_the_child_is_bounded(path, monkeypatch):
    monkeypatch.setattr(module, "BASE_MEMORY", 2**28)
    with reader_process(), pytest.raises(MemoryError):
        allocate(path)


def test_errors_come_back_as_they_were_raised(path):
    with reader_process():
        with pytest.raises(UserError) as refused:
            refuse(path)
        with pytest.raises(ZeroDivisionError, match="by zero") as failed:
            fail(path)
    assert (refused.value.fault, refused.value.place, refused.value.remedy) == ("is empty", "line 1", "Fill it")
    assert "in fail" in failed.value.__notes__[0]  # the traceback of the child, for --verbose


def test_a_result_that_cannot_be_sent_is_an_internal_error(path):
    with reader_process(), pytest.raises((pickle.PicklingError, AttributeError)):
        not_sendable(path)


@read_in_child
def not_sendable(path):
    return lambda: path


def test_a_fork_of_the_program_has_a_child_of_its_own(path):
    with reader_process():
        child = process_of(path)
        pid = os.fork()
        if pid == 0:
            try:
                os._exit(0 if process_of(path) not in (child, os.getpid()) else 1)
            finally:
                os._exit(2)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
        assert process_of(path) == child


@pytest.mark.parametrize("name", ["chunk-index", "attribute"])
def test_a_file_on_which_hdf5_fails_is_a_fault_beside_good_files(name, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "BASE_CPU_TIME", 0.5)
    bad = tmp_path / "bad.h5"
    bad.write_bytes(gzip.decompress((DAMAGED / f"{name}.h5.gz").read_bytes()))
    good = Path(__file__).parents[2] / "sample_data" / "static-bare.h5"
    done = CliRunner().invoke(balance, ["check", str(good), str(bad)])
    assert done.exit_code == 2
    assert done.stdout.count("fault:") == 1
    assert "static run `static-bare`" in done.stdout
