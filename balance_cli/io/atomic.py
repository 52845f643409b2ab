"""Files written whole or not at all: staged beside their final path, then moved there together."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from balance_cli.io.errors import UserError


class StagedOutputs:
    """Output files staged beside their final paths, moved there together by `commit` or removed by `discard`."""

    def __init__(self) -> None:
        self._parts: dict[Path, Path] = {}
        self._folders: list[Path] = []

    def stage_file(self, path: Path) -> Path:
        """The temporary path to write to (same folder, same suffix).

        Raises UserError where no file can be written at `path`, or one is staged for it already.
        """
        check_output(path)
        target = path.resolve()
        if target in self._parts:
            raise UserError("two outputs have this name", str(path), remedy="Give each output its own name")
        part = target.with_name(f".part-{os.getpid()}-{target.name}")
        self._parts[target] = part
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
            with os_errors_as_user_error(path):
                path.mkdir()
            self._folders.append(path)
        return path

    def commit(self) -> tuple[Path, ...]:
        """Move all staged files to their final paths and return these."""
        for target, part in self._parts.items():
            with os_errors_as_user_error(target):
                part.replace(target)
        targets = tuple(self._parts)
        self._parts, self._folders = {}, []
        return targets

    def discard(self) -> None:
        """Remove all staged files and created folders that were not committed."""
        for part in self._parts.values():
            with suppress(OSError):
                part.unlink(missing_ok=True)
        for folder in self._folders:
            with suppress(OSError):
                folder.rmdir()


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


@contextmanager
def os_errors_as_user_error(path: Path) -> Iterator[None]:
    """Turn an operating-system error (disk full, no permission) into a UserError that names the file."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"cannot be written: {reason}", str(path), remedy="Choose another place") from error


def check_output(path: Path) -> None:
    """Raise UserError unless an ordinary file can be written at `path`."""
    if path.is_dir():
        raise UserError("is a folder, not a file", str(path), remedy="Give the name of a file")
    if path.exists() and not path.is_file():
        raise UserError("is not an ordinary file", str(path), remedy="Give a file name, or `--json -` for the terminal")
    _check_parent(path)


def check_output_folder(path: Path) -> None:
    """Raise UserError unless `path` is a folder that can be written to, or can be created."""
    if path.exists() and not path.is_dir():
        raise UserError("is a file, not a folder", str(path), remedy="Give the name of a folder")
    _check_parent(path if path.exists() else path.absolute())


def _check_parent(path: Path) -> None:
    parent = path if path.is_dir() else path.resolve().parent
    if not parent.is_dir():
        raise UserError("its folder does not exist", str(path), remedy=f"Create the folder first: {parent}")
    if not os.access(parent, os.W_OK):
        raise UserError("its folder cannot be written to", str(path), remedy="Choose another folder")
