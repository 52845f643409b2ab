"""HDF5 files written through a stand-in for the disk, which never fails in the eyes of the HDF5 library.

The library crashes where it cannot write: it tries again when the file is closed, and once more at the end of the
process. Here the first error of the system is kept, further writing is discarded, and the error is raised when the file
has been closed. Memory stays bounded, because nothing is collected.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py

from balance_cli.io.atomic import os_errors_as_user_error


class _Disk(io.RawIOBase):
    """A file that keeps the first error of the system instead of raising it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._file = path.open("w+b", buffering=0)
        self._position = 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to an offset from the start, the present position or the end, as HDF5 knows it."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size()}[whence]
        self._position = base + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Read what is on the disk; zeros where writing had failed."""
        view = memoryview(buffer).cast("B")
        count = 0
        with self._keep_error():
            self._file.seek(self._position)
            count = self._file.readinto(view) or 0
        if self.error is not None:
            view[count:] = bytes(len(view) - count)
            count = len(view)
        self._position += count
        return count

    def write(self, data: Any) -> int:
        """Write all of the data, or discard them after an error."""
        view = memoryview(data).cast("B")
        start = self._position
        self._position += len(view)
        if self.error is None:
            with self._keep_error():
                self._file.seek(start)
                written = 0
                while written < len(view):
                    written += self._file.write(view[written:]) or 0
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file."""
        size = self._position if size is None else size
        if self.error is None:
            with self._keep_error():
                self._file.truncate(size)
        return size

    def close(self) -> None:
        """Close the file; systems with quotas report some errors only now."""
        if not self.closed:
            with self._keep_error():
                self._file.close()
        super().close()

    def _size(self) -> int:
        with suppress(OSError):
            return self._file.seek(0, io.SEEK_END)
        return self._position

    @contextmanager
    def _keep_error(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error


class Hdf5Output:
    """A new HDF5 file. Raises UserError where it cannot be written: from `check`, and when it is closed.

    Writers of long files call `check` after each block.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with os_errors_as_user_error(path):
            self._disk = _Disk(path)
        self.file: Any = h5py.File(self._disk, "w")

    def __enter__(self) -> Hdf5Output:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(report=kind is None)

    def check(self) -> None:
        """Raise UserError where a part of the file could not be written."""
        if self._disk.error is not None:
            with os_errors_as_user_error(self._path):
                raise self._disk.error

    def close(self, report: bool = True) -> None:
        """Close the file and, unless an exception is under way, report what could not be written."""
        try:
            self.file.close()
        except (OSError, RuntimeError):
            if self._disk.error is None:
                raise
        finally:
            self._disk.close()
        if report:
            self.check()
