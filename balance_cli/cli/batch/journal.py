"""The journal of a batch: what is done is kept beside the output, so that an interrupted call goes on from there.

One line for each run: a checksum, then JSON with the stamp of the file and the result. The first line is the key of the
call: what was asked, of which inputs, by which version. A line that was not written whole ends the journal; what
follows is done again. The histories of runs lie in a folder beside it. Both are removed when the output is in place.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

import numpy as np

from balance_cli.io.atomic import os_errors_as_user_error
from balance_cli.io.hdf5_tree import from_tree, to_tree
from balance_cli.io.object_store import store_stamp, store_url

R = TypeVar("R")

JOURNAL_SUFFIX, HISTORIES_SUFFIX = ".unfinished", ".histories"
CHECKSUM_LENGTH = 16
"""Hexadecimal digits: a line that is not whole passes with a probability of 5e-20."""


class Journal(Generic[R]):
    """Results of one type by file, kept in a file while a batch is in work. Only one process writes to it."""

    def __init__(self, path: Path, key: str, result_type: type[R]) -> None:
        self._path, self._type = path, result_type
        self.histories = path.with_name(path.name.removesuffix(JOURNAL_SUFFIX) + HISTORIES_SUFFIX)
        self._done: dict[str, tuple[int, int]] = {}
        with os_errors_as_user_error(path):
            path.touch()
            self._file: BinaryIO = path.open("r+b")
        # The call that had it may have removed it in between; a third call then makes another one.
        self.is_mine = _lock(self._file) and _is_at(path, self._file)
        if self.is_mine and not self._read(key):
            self._file.seek(0)
            self._file.truncate()
            self._write_line(key)
            shutil.rmtree(self.histories, ignore_errors=True)
        _open_journals.add(self)

    def __str__(self) -> str:
        return str(self._path)

    def __len__(self) -> int:
        return len(self._done)

    def find(self, file: Path) -> R | None:
        """Return the result of a file that has not changed since; None where there is none."""
        place = self._done.get(f"{file} {file_stamp(file)}")
        if place is None:
            return None
        position = self._file.tell()
        self._file.seek(place[0])
        line = self._file.read(place[1])
        self._file.seek(position)
        result: R = from_tree(_decode(_checked(line)["result"]), self._type)
        return result

    def add(self, file: Path, result: R) -> None:
        """Keep the result of a file; it is with the system, and outlives this process, when the call returns."""
        if self.is_mine:
            name = f"{file} {file_stamp(file)}"
            start = self._file.tell()
            length = self._write_line({"file": name, "result": _encode(to_tree(result))})
            self._done[name] = (start, length)

    def close(self, remove: bool = True) -> None:
        """Close the journal, and remove it: the batch is done, or was refused."""
        if self.is_mine and remove:
            # The journal last: from then on another call may have its histories there.
            shutil.rmtree(self.histories, ignore_errors=True)
            with suppress(OSError):
                self._path.unlink()
        _open_journals.discard(self)
        self._file.close()

    def history(self, name: str) -> Path:
        """Return where the history of a run is kept until the batch is done."""
        with os_errors_as_user_error(self.histories):
            self.histories.mkdir(exist_ok=True)
        return self.histories / f"{name}.h5"

    def _read(self, key: str) -> bool:
        """Find the whole lines, cut off what follows them, and return whether they are of this call."""
        end = 0
        for number, line in enumerate(self._file):
            try:
                entry = _checked(line)
            except ValueError:
                break
            if number == 0 and entry != key:
                return False
            if number:
                self._done[entry["file"]] = (end, len(line))
            end += len(line)
        self._file.seek(end)
        self._file.truncate()
        return end > 0

    def _write_line(self, entry: Any) -> int:
        text = json.dumps(entry).encode()
        line = _checksum(text) + b" " + text + b"\n"
        with os_errors_as_user_error(self._path):
            self._file.write(line)
            self._file.flush()
        return len(line)


_open_journals: set[Journal[Any]] = set()


def describe_kept_results() -> str:
    """Return what an interruption of this process leaves for the next call, in words; empty where that is nothing."""
    counts = [(len(journal), journal) for journal in _open_journals if journal.is_mine]
    sentences = [f"{count} reduced runs are kept in {journal}" for count, journal in counts if count]
    return f"{', '.join(sentences)}: the same call resumes from there" if sentences else ""


def journal_path(output: Path) -> Path:
    """Return the path of the journal of an output."""
    return output.with_name(f".{output.name}{JOURNAL_SUFFIX}")


def _is_at(path: Path, file: BinaryIO) -> bool:
    """Whether an open file is still the one at this path."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except OSError:
        return False


def file_stamp(file: Path) -> str:
    """Size and time of change of a file; a file that is not there has none, and is never found."""
    url = store_url(file)
    if url is not None:
        return store_stamp(url)
    try:
        status = file.stat()
    except OSError:
        return "absent"
    return f"{status.st_size} {status.st_mtime_ns}"


def _checksum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:CHECKSUM_LENGTH].encode()


def _checked(line: bytes) -> Any:
    """Return the content of a line. Raises ValueError where it is not whole."""
    checksum, _, text = line.rstrip(b"\n").partition(b" ")
    if not line.endswith(b"\n") or checksum != _checksum(text):
        raise ValueError("not whole")
    return json.loads(text)


def _lock(file: BinaryIO) -> bool:
    """Whether this process may write the journal; another call for the same output goes on without one."""
    try:
        import fcntl
    except ImportError:
        return os.name != "posix"
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


# ---- trees as JSON: arrays by their bytes, so that a result is the same after an interruption -----------------------


def _encode(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {"tree": [[key, _encode(value)] for key, value in tree.items()]}
    if isinstance(tree, np.ndarray) and tree.dtype == object:
        return {"texts": tree.ravel().tolist(), "shape": tree.shape}
    if isinstance(tree, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(tree).tobytes()).decode()
        return {"array": data, "dtype": tree.dtype.str, "shape": tree.shape}
    if isinstance(tree, float | complex) and not isinstance(tree, bool):
        return _encode(np.array(tree)) | {"scalar": True}
    return tree


def _decode(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if "tree" in value:
        return {key: _decode(item) for key, item in value["tree"]}
    if "texts" in value:
        return np.array(value["texts"], dtype=object).reshape(value["shape"])
    array = np.frombuffer(base64.b64decode(value["array"]), value["dtype"]).reshape(value["shape"])
    return array.item() if "scalar" in value else array.copy()
