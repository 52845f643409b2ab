"""A mapping whose values lie in a temporary file, so that any number of results needs little memory."""

from __future__ import annotations

import pickle
import weakref
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from tempfile import SpooledTemporaryFile, gettempdir
from typing import TypeVar

from balance_cli.io.atomic import os_errors_as_user_error

V = TypeVar("V")

MOST_IN_MEMORY = 2**24
"""Bytes up to which the values stay in memory: those of some hundred runs."""


class StoredMapping(MutableMapping[str, V]):
    """Values by name, in the order in which they were added; each is read when it is asked for.

    A value that is replaced or removed leaves its room in the file, which goes with the mapping.
    """

    def __init__(self) -> None:
        self._file = SpooledTemporaryFile(max_size=MOST_IN_MEMORY)  # noqa: SIM115  # lives as long as the mapping
        weakref.finalize(self, self._file.close)
        self._places: dict[str, tuple[int, int]] = {}
        self._end = 0

    def __getitem__(self, key: str) -> V:
        start, length = self._places[key]
        self._file.seek(start)
        value: V = pickle.loads(self._file.read(length))
        return value

    def __setitem__(self, key: str, value: V) -> None:
        data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
        with os_errors_as_user_error(Path(gettempdir())):
            self._file.seek(self._end)
            self._file.write(data)
            self._file.flush()
        self._places[key] = (self._end, len(data))
        self._end += len(data)

    def __delitem__(self, key: str) -> None:
        del self._places[key]

    def __contains__(self, key: object) -> bool:
        return key in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)
