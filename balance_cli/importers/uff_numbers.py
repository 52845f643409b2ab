"""The numbers of a dataset 58, text or binary, read in blocks."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from balance_cli.importers.base import Array, damage_error

SINGLE_WIDTH, DOUBLE_WIDTH = 13, 20
"""Characters of a number in text: E13.5 and E20.12."""


class Form(Protocol):
    """What the reading of numbers needs to know of the header."""

    @property
    def count(self) -> int:
        """Number of ordinates of the dataset."""
        ...

    @property
    def is_double(self) -> bool:
        """Whether the ordinates are double precision."""
        ...

    @property
    def is_even(self) -> bool:
        """Whether there is no abscissa beside each ordinate."""
        ...


class Place(Protocol):
    """Where the numbers are in the file."""

    @property
    def offset(self) -> int:
        """Position of the first byte of the data in the file."""
        ...

    @property
    def size(self) -> int:
        """Length of the data in bytes."""
        ...


class BinaryNumbers:
    """Real ordinates with an even abscissa, in binary."""

    def __init__(self, path: Path, order: str, offset: int, form: Form) -> None:
        self._path, self._offset = path, offset
        self._type = np.dtype(f"{order}f{8 if form.is_double else 4}")

    def read(self, start: int, stop: int) -> Array:
        """Samples start to stop."""
        size = self._type.itemsize
        values = np.fromfile(self._path, self._type, stop - start, offset=self._offset + start * size)
        if len(values) < stop - start:
            raise damage_error("binary data end early")
        return values.astype(np.float64)


def binary_numbers(path: Path, order: str, offset: int, form: Form) -> BinaryNumbers:
    """The numbers of a binary dataset."""
    return BinaryNumbers(path, order, offset, form)


class TextNumbers:
    """Real ordinates in text: read line by line where all lines are equally long, else parsed whole when first read."""

    def __init__(self, path: Path, place: Place, form: Form) -> None:
        self._path, self._place, self._form = path, place, form
        self._width = DOUBLE_WIDTH if form.is_double else SINGLE_WIDTH

    def read(self, start: int, stop: int) -> Array:
        """Samples start to stop."""
        if self._line_bytes is None:
            return self._all[start:stop]
        length, in_line = self._line_bytes
        first, last = start // in_line, -(-stop // in_line)
        with self._path.open("rb") as file:
            file.seek(self._place.offset + first * length)
            text = file.read(min((last - first) * length, self._place.size - first * length))
        values = self._parse(text, min(last * in_line, self._form.count) - first * in_line)
        return values[start - first * in_line : stop - first * in_line]

    @cached_property
    def _line_bytes(self) -> tuple[int, int] | None:
        """Bytes and numbers of a line where all lines but the last have the same; None where they differ."""
        with self._path.open("rb") as file:
            file.seek(self._place.offset)
            first = file.readline(self._place.size)
            in_line = len(first.split())
            lines = -(-self._form.count // in_line) if in_line else 0
            for line in (1, lines // 2, lines - 2):  # samples of the structure, before it is relied on
                if 0 < line < lines - 1:
                    file.seek(self._place.offset + line * len(first))
                    text = file.readline(self._place.size)
                    if len(text) != len(first) or len(text.split()) != in_line:
                        return None
        is_whole = in_line > 0 and (lines - 1) * len(first) < self._place.size <= lines * len(first) + 2
        return (len(first), in_line) if is_whole else None

    @cached_property
    def _all(self) -> Array:
        with self._path.open("rb") as file:
            file.seek(self._place.offset)
            return self._parse(file.read(self._place.size), self._form.count)

    def _parse(self, text: bytes, count: int) -> Array:
        """Numbers separated by spaces, or in columns of fixed width where some touch each other."""
        words = text.replace(b"D", b"E").replace(b"d", b"e").split()
        if len(words) != count:
            lines = [line.rstrip(b"\r\n ") for line in text.replace(b"D", b"E").splitlines()]
            words = [line[k : k + self._width] for line in lines for k in range(0, len(line), self._width)]
        if len(words) != count:
            raise damage_error(f"{len(words)} numbers where the header announces {count}")
        try:
            return np.array(words, dtype="S32").astype(np.float64)
        except ValueError as error:
            raise damage_error(error) from error
