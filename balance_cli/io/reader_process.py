"""HDF5 and MDF files are read in a process of their own, so that a damaged file cannot end or stop the program.

Damage in the structure of such a file can make its library write beyond its memory or turn in circles. No check of the
file excludes that, so the function that reads a file whole for the first time runs in a child process:

    @read_in_child
    def read_run(path: Path) -> Run: ...

    with reader_process():            # a command of the program
        run = read_run(path)          # UserError where reading ends the child, or does not end

One child, forked at the first call, serves all files. Outside of the context (in the Python interface, in the child
itself, and where the system cannot fork safely) the function is called directly.
"""

from __future__ import annotations

import functools
import os
import pickle
import signal
import struct
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, ParamSpec, TypeVar

from balance_cli.io.errors import UserError

P = ParamSpec("P")
T = TypeVar("T")

CAN_FORK = os.name == "posix" and sys.platform != "darwin"
"""The frameworks of macOS do not survive a fork; Windows has none."""
BASE_CPU_TIME = 5.0
"""[s]. An artefact of 100 MB takes one second."""
SLOWEST_READING = 4e6
"""Bytes of a file per second of processor time. Compressed samples are read at 30 to 300 MB/s."""
BASE_MEMORY = 640 * 2**20
"""Bytes that the child may allocate for a file beyond those it has; a block of samples and its copies take 100 MB."""
MEMORY_PER_BYTE = 300
"""The same for each byte of the file: an array is read and copied once, and is compressed by a factor up to 100."""
MOST_MEMORY = 4 * 2**30
"""Bytes that the size of a file adds at most: an artefact of the largest size, and copies of it."""


@dataclass
class _Child:
    """The process that reads files: its id, the process that started it, and the pipes to and from it."""

    pid: int
    owner: int
    requests: BinaryIO
    answers: BinaryIO

    def end(self, kill: bool) -> int:
        """Wait until the child has ended, and return the signal that ended it (0: none)."""
        for pipe in (self.requests, self.answers):
            with suppress(OSError):
                pipe.close()
        if self.owner != os.getpid():
            return 0  # a fork of the program: the child belongs to its parent
        if kill:
            os.kill(self.pid, signal.SIGKILL)
        status = os.waitpid(self.pid, 0)[1]
        return os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0


class ReaderProcess:
    """The child that reads files. It is forked when it is first needed, and again after a file has ended it."""

    def __init__(self) -> None:
        self._child: _Child | None = None
        self._fatal: dict[tuple[str, int, int], UserError] = {}

    def call(self, function: Callable[..., Any], path: Path, *arguments: Any, **options: Any) -> Any:
        """Return `function(path, ...)`, or raise what it raises. UserError where it does not return."""
        size, modified = _size_and_time(path)
        key = (str(path), size, modified)
        if key in self._fatal:
            raise self._fatal[key]
        if self._child is None or self._child.owner != os.getpid():
            self._child = _fork_child()
        budget = BASE_CPU_TIME + size / SLOWEST_READING
        memory = BASE_MEMORY + min(MEMORY_PER_BYTE * size, MOST_MEMORY)
        try:
            _send(self._child.requests, ((budget, memory), function, (path, *arguments), options))
            succeeded, result = _receive(self._child.answers)
        except (EOFError, BrokenPipeError) as error:
            self._fatal[key] = fault = _fatal_error(self.stop(kill=False), budget, path)
            raise fault from error
        except BaseException:  # such as an interrupt: the answer would be taken for that of the next request
            self.stop()
            raise
        if not succeeded:
            raise result
        return result

    def stop(self, kill: bool = True) -> int:
        """End the child, and return the signal that ended it (0: none)."""
        child, self._child = self._child, None
        return 0 if child is None else child.end(kill)


_process: ReaderProcess | None = None
"""The process of the current context; None in the child."""


@contextmanager
def reader_process() -> Iterator[None]:
    """Read files in a child process within this context, as far as the system allows."""
    global _process
    before, _process = _process, ReaderProcess() if CAN_FORK else None
    try:
        yield
    finally:
        ended, _process = _process, before
        if ended is not None:
            ended.stop()


def read_in_child(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function that reads the file at its first argument, a Path: in `reader_process()` the child runs it.

    Its arguments, its result and its exceptions are pickled.
    """

    @functools.wraps(function)
    def read(*arguments: P.args, **options: P.kwargs) -> T:
        if _process is None:
            return function(*arguments, **options)
        result: T = _process.call(read, *arguments, **options)  # type: ignore[arg-type]
        return result

    return read


def _size_and_time(path: Path) -> tuple[int, int]:
    """Size in bytes and time of change in ns; zeros where there is no file, which the function finds out itself."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns


def _fatal_error(number: int, budget: float, path: Path) -> UserError:
    """The error of a file of which the reading was ended by this signal."""
    if number == getattr(signal, "SIGXCPU", None):
        fault = f"cannot be read within {budget:.0f} s of processor time: its structure is damaged"
    else:
        name = signal.Signals(number).name if number else "no signal"
        fault = f"cannot be read, the library that reads it fails on it ({name}): its structure is damaged"
    return UserError(fault, str(path), remedy="Copy the file again from its source, or create it again")


# ---- the child -------------------------------------------------------------------------------------------------------


def _fork_child() -> _Child:
    request_end, requests = os.pipe()
    answers, answer_end = os.pipe()
    with warnings.catch_warnings():
        # Python 3.12 warns where any library has threads. The child only reads files, and takes no lock of theirs.
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid == 0:
        try:
            os.close(requests)
            os.close(answers)
            _serve(os.fdopen(request_end, "rb"), os.fdopen(answer_end, "wb"))
        finally:
            os._exit(0)
    os.close(request_end)
    os.close(answer_end)
    return _Child(pid, os.getpid(), os.fdopen(requests, "wb"), os.fdopen(answers, "rb"))


def _serve(requests: BinaryIO, answers: BinaryIO) -> NoReturn:
    """Answer requests until the parent closes the pipe, or has ended."""
    global _process
    _process = None
    _detach()
    while True:
        try:
            limits, function, arguments, options = _receive(requests)
        except EOFError:
            os._exit(0)
        _set_limits(*limits)
        answer: tuple[bool, Any]
        try:
            answer = True, function(*arguments, **options)
        except Exception as error:
            answer = False, _picklable(error)
        try:
            _send(answers, answer)
        except (pickle.PicklingError, TypeError, AttributeError) as error:  # nothing of it was sent
            _send(answers, (False, _picklable(error)))


def _detach() -> None:
    """Leave signals and the terminal to the parent."""
    import faulthandler

    for number, action in {
        signal.SIGINT: signal.SIG_IGN,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
        signal.SIGXCPU: signal.SIG_DFL,
    }.items():
        signal.signal(number, action)
    faulthandler.disable()
    null_device = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null_device, descriptor)


def _set_limits(cpu_time: float, memory: int) -> None:
    """Let the system end the process (SIGXCPU) after this processor time from now [s], and give it no more memory."""
    import resource

    times = os.times()
    with suppress(OSError, ValueError):
        _lower_limit(resource.RLIMIT_CPU, int(times.user + times.system + cpu_time) + 1)
    with suppress(OSError, ValueError):
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        _lower_limit(resource.RLIMIT_AS, pages * resource.getpagesize() + memory)


def _lower_limit(resource_id: int, value: int) -> None:
    import resource

    hard = resource.getrlimit(resource_id)[1]
    resource.setrlimit(resource_id, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def _picklable(error: Exception) -> Exception:
    """The error, or its text where it cannot be sent; its traceback, which is not sent, as a note."""
    import traceback

    if not isinstance(error, UserError):
        error.add_note("In the process that reads files:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


# ---- messages: a pickle, and apart from it the arrays, which are not copied ------------------------------------------


def _send(pipe: BinaryIO, message: Any) -> None:
    arrays: list[pickle.PickleBuffer] = []
    text = pickle.dumps(message, protocol=5, buffer_callback=arrays.append)
    parts = [memoryview(text), *(array.raw() for array in arrays)]
    pipe.write(struct.pack(f"<{len(parts) + 1}Q", len(parts), *(part.nbytes for part in parts)))
    for part in parts:
        pipe.write(part)
    pipe.flush()


def _receive(pipe: BinaryIO) -> Any:
    """The next message. Raises EOFError where the other end has closed the pipe."""
    (count,) = struct.unpack("<Q", _receive_bytes(pipe, 8))
    lengths = struct.unpack(f"<{count}Q", _receive_bytes(pipe, 8 * count))
    text, *arrays = [_receive_bytes(pipe, length) for length in lengths]
    return pickle.loads(text, buffers=arrays)


def _receive_bytes(pipe: BinaryIO, length: int) -> bytearray:
    data = bytearray(length)
    received = 0
    with memoryview(data) as view:
        while received < length:
            count = pipe.readinto(view[received:])  # type: ignore[attr-defined]
            if not count:
                raise EOFError
            received += count
    return data
