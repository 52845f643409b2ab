"""Files written whole or not at all: staged beside their final path, then moved there together.

A staged file has a name that identifies its owner: `.part-HOST-SYSTEM-PID-START-COUNT-NAME`. SYSTEM identifies the boot
and the process namespace in which PID and START (of the process, in clock ticks) are valid. Files whose owner was
killed are removed when the next file is staged in their folder. Files of running processes are never touched.
"""

from __future__ import annotations

import errno
import functools
import itertools
import os
import platform
import re
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from balance_cli.io.errors import UserError

FOREIGN_PART_AGE = 86400.0
"""[s]. Whether a process of another host or boot still runs cannot be tested; no command writes for a whole day."""
COMMIT_LOCK_WAIT = 10.0
"""[s]. Moving files takes milliseconds: a process that locks a folder for longer is stopped, not busy."""
SHORT_NAME = 24
"""Characters of host and file name in the name of a staged file, so that it is shorter than 255 bytes."""
_PART_NAME = re.compile(r"\.part-\w+-(?P<system>[0-9a-f]{8})-(?P<pid>\d+)-(?P<start>\d+)-\d+-")
_FORMER_PART_NAME = re.compile(r"\.part-\d+-")
_HDF5_ERRNO = re.compile(r"errno = (\d+)")
_REMEDIES = {
    errno.ENOSPC: "Free some space, or choose another place",
    errno.EDQUOT: "Free some space, or choose another place",
    errno.EFBIG: "Raise the limit of file sizes (`ulimit -f`), or choose another place",
    errno.ENAMETOOLONG: "Choose a shorter name",
}
_counter = itertools.count(1)


class StagedOutputs:
    """Output files staged beside their final paths, moved there together by `commit` or removed by `discard`."""

    def __init__(self) -> None:
        self._parts: dict[Path, Path] = {}
        self._folders: list[Path] = []
        self._owner = os.getpid()

    def stage_file(self, path: Path) -> Path:
        """The temporary path to write to (same folder, same suffix).

        Raises UserError where no file can be written at `path`, or one is staged for it already.
        """
        check_output(path)
        target = path.resolve()
        if target in self._parts:
            raise UserError("two outputs have this name", str(path), remedy="Give each output its own name")
        if target.parent not in {staged.parent for staged in self._parts}:
            remove_leftovers(target.parent)
        _outputs.staged.add(self)
        part = target.with_name(_part_name(target))
        # An artefact is staged once more for a staged file.
        self._parts[target], _outputs.targets[part] = part, _outputs.targets.get(target, target)
        return part

    def unstage(self, path: Path) -> None:
        """Withdraw the file staged for `path` and remove what was written for it."""
        part = self._parts.pop(path.resolve())
        with suppress(OSError):
            part.unlink(missing_ok=True)

    def stage_folder(self, path: Path) -> Path:
        """A folder for outputs, created if necessary (`discard` then removes it again)."""
        check_output_folder(path)
        if not path.exists():
            _outputs.staged.add(self)
            self._folders.append(path)
            with os_errors_as_user_error(path):
                path.mkdir(exist_ok=True)
        return path

    def commit(self) -> tuple[Path, ...]:
        """Move all staged files to their final paths and return these.

        Of two processes with the same outputs, the last one to commit replaces all files of the other.
        """
        with _lock_folders(target.parent for target in self._parts), _outputs.move():
            for target, part in self._parts.items():
                with os_errors_as_user_error(target):
                    part.replace(target)
                _outputs.written |= not _PART_NAME.match(target.name)
            targets = tuple(self._parts)
            self._parts, self._folders = {}, []
            _outputs.staged.discard(self)
        return targets

    def discard(self) -> None:
        """Remove all staged files and created folders that were not committed."""
        if self._owner != os.getpid():
            return  # in a forked process: the files are the parent's
        for part in self._parts.values():
            with suppress(OSError):
                part.unlink(missing_ok=True)
        for folder in self._folders:
            with suppress(OSError):
                folder.rmdir()
        _outputs.staged.discard(self)

    def target_of(self, path: Path) -> Path | None:
        """The final path of the staged file `path`."""
        return next((target for target, part in self._parts.items() if part == path), None)


class _ProcessOutputs:
    """What this process has staged and written, for signal handlers and messages."""

    def __init__(self) -> None:
        self.staged: set[StagedOutputs] = set()
        self.targets: dict[Path, Path] = {}  # of discarded files, too: their error is reported later
        self.written = self.moving = False
        self.after_move: Callable[[], object] | None = None

    @contextmanager
    def move(self) -> Iterator[None]:
        """Postpone a signal to the end of the block, so that it finds all outputs moved or none."""
        self.moving = True
        try:
            yield
        finally:
            self.moving = False
            if self.after_move is not None:
                self.after_move()


_outputs = _ProcessOutputs()


def abandon_outputs(postponed: Callable[[], object]) -> str | None:
    """Remove all files that this process has staged, and return what was written, for a message.

    While outputs are moved to their final paths, return None; `postponed` is called when this is done.
    """
    if _outputs.moving:
        _outputs.after_move = postponed
        return None
    for staged in tuple(_outputs.staged):
        staged.discard()
    return "outputs were written before" if _outputs.written else "nothing written"


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; it is moved to `path` at the end of the block, or removed after an error."""
    staged = StagedOutputs()
    try:
        with os_errors_as_user_error(path):
            yield staged.stage_file(path)
        staged.commit()
    finally:
        staged.discard()


# ---- leftovers of killed processes -----------------------------------------------------------------------------------


def remove_leftovers(folder: Path) -> None:
    """Remove the staged files in a folder whose owner no longer runs."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(".part-") and entry.is_file(follow_symlinks=False):
                with suppress(OSError):
                    if _is_leftover(entry):
                        Path(entry.path).unlink()


def _is_leftover(entry: os.DirEntry[str]) -> bool:
    name = _PART_NAME.match(entry.name)
    if name and name["system"] == _system_key() and os.name == "posix":
        return not _is_running(int(name["pid"]), int(name["start"]))
    old = time.time() - entry.stat(follow_symlinks=False).st_mtime > FOREIGN_PART_AGE
    return old and bool(name or _FORMER_PART_NAME.match(entry.name))


def _part_name(target: Path) -> str:
    host = re.sub(r"\W", "_", platform.node(), flags=re.ASCII)[:SHORT_NAME] or "host"
    suffix = target.suffix if len(target.suffix) <= SHORT_NAME else ""
    owner = f"{host}-{_system_key()}-{os.getpid()}-{_start_ticks(os.getpid()) or 0}"
    return f".part-{owner}-{next(_counter)}-{target.stem[:SHORT_NAME]}{suffix}"


@functools.cache
def _system_key() -> str:
    """Eight hexadecimal digits of host, boot and process namespace: within these a process is known by its number."""
    text = platform.node()
    with suppress(OSError):
        text += Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        text += str(Path("/proc/self/ns/pid").readlink())
    return f"{zlib.crc32(text.encode()):08x}"


def _is_running(pid: int, start: int) -> bool:
    """Whether the process of this number and start still runs; a later process may have the same number."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        pass  # it exists and belongs to another user
    ticks = _start_ticks(pid)
    return ticks is None or ticks == start


def _start_ticks(pid: int) -> int | None:
    """Start of a process in clock ticks after boot, -1 if it has ended (a zombie), None where that is unknown."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return -1 if fields[0] in "ZX" else int(fields[19])
    except (OSError, ValueError, IndexError):
        return None


@contextmanager
def _lock_folders(folders: Iterable[Path]) -> Iterator[None]:
    """Hold an advisory lock on each folder, as far as the file system has locks; it ends with the process."""
    with ExitStack() as stack:
        for folder in sorted(set(folders)):
            with suppress(OSError, ImportError):
                descriptor = os.open(folder, os.O_RDONLY)
                stack.callback(os.close, descriptor)
                _wait_for_lock(descriptor)
        yield


def _wait_for_lock(descriptor: int) -> None:
    import fcntl

    deadline = time.monotonic() + COMMIT_LOCK_WAIT
    while time.monotonic() < deadline:
        with suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        time.sleep(0.005)


# ---- errors ----------------------------------------------------------------------------------------------------------


@contextmanager
def os_errors_as_user_error(path: Path) -> Iterator[None]:
    """Turn an operating-system error (disk full, no permission) into a UserError that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and system_error_number(error) is None:
            raise
        raise unwritable_file(error, path) from error


def unwritable_file(error: OSError | RuntimeError, path: Path | None) -> UserError:
    """The UserError of a file that the operating system did not write; a staged file is called by its final name."""
    number = system_error_number(error)
    reason = os.strerror(number) if number else getattr(error, "strerror", None) or str(error)
    name = str(_outputs.targets.get(path, path) if path else "output")
    return UserError(f"cannot be written: {reason}", name, remedy=_REMEDIES.get(number or 0, "Choose another place"))


def system_error_number(error: BaseException) -> int | None:
    """The `errno` of an operating-system error; HDF5 states it in the text of a RuntimeError."""
    if isinstance(error, OSError) and error.errno:
        return error.errno
    stated = _HDF5_ERRNO.search(str(error)) if isinstance(error, OSError | RuntimeError) else None
    return int(stated[1]) if stated else None


def check_output(path: Path) -> None:
    """Raise UserError unless an ordinary file can be written at `path`."""
    with os_errors_as_user_error(path):
        is_folder, exists, is_file = path.is_dir(), path.exists(), path.is_file()
    if is_folder:
        raise UserError("is a folder, not a file", str(path), remedy="Give the name of a file")
    if exists and not is_file:
        raise UserError("is not an ordinary file", str(path), remedy="Give a file name, or `--json -` for the terminal")
    _check_parent(path)


def check_output_folder(path: Path) -> None:
    """Raise UserError unless `path` is a folder that can be written to, or can be created. Leftovers are removed."""
    if path.exists() and not path.is_dir():
        raise UserError("is a file, not a folder", str(path), remedy="Give the name of a folder")
    _check_parent(path if path.exists() else path.absolute())
    remove_leftovers(path)


def _check_parent(path: Path) -> None:
    parent = path if path.is_dir() else path.resolve().parent
    if not parent.is_dir():
        raise UserError("its folder does not exist", str(path), remedy=f"Create the folder first: {parent}")
    if not os.access(parent, os.W_OK):
        raise UserError("its folder cannot be written to", str(path), remedy="Choose another folder")
