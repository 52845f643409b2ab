"""Surveys of runs in a file that the shards of a batch share, so that the headers of all runs are read once.

JSON: the format, the key of what was asked, a checksum, and for each run its stamp (size and time of change) with name,
kind and possible harmonics. Runs that have changed since are surveyed again; bad runs are not kept.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from balance_cli.cli.batch.journal import file_stamp
from balance_cli.cli.batch.work import RunSurvey
from balance_cli.io.atomic import atomic_write, os_errors_as_user_error
from balance_cli.io.errors import UserError
from balance_cli.io.formats import SURVEY_FORMAT
from balance_cli.io.object_store import store_url
from balance_cli.io.version import __version__


class KeptSurveys:
    """The surveys in a file; without a file there are none, and none are kept.

    Surveys of another `key` (the inputs and options that they depend on) are not used. Raises UserError where the file
    is something else, or damaged: it would be overwritten.
    """

    def __init__(self, path: Path | None, key: Any) -> None:
        self._path = path
        self._key = hashlib.sha256(json.dumps([__version__, key]).encode()).hexdigest()
        self._runs = {} if path is None or not path.exists() else _read(path, self._key)
        self._unchanged: set[Path] = set()

    def find_all(self, files: Iterable[Path]) -> dict[Path, RunSurvey]:
        """Return the surveys of those of the files that have not changed since."""
        stored = ((file, self._runs.get(_place(file))) for file in files)
        unchanged = {file: entry["survey"] for file, entry in stored if entry and entry["stamp"] == file_stamp(file)}
        self._unchanged = set(unchanged)
        return {file: RunSurvey(**survey) for file, survey in unchanged.items()}

    def keep(self, surveys: Mapping[Path, RunSurvey]) -> None:
        """Write the surveys beside those of other files, unless all of them are there."""
        new_paths = [path for path in surveys if path not in self._unchanged]
        if self._path is None or not new_paths:
            return
        runs = {_place(path): {"stamp": file_stamp(path), "survey": asdict(surveys[path])} for path in new_paths}
        runs = {**self._runs, **runs}
        content = {"format": SURVEY_FORMAT, "key": self._key, "checksum": _checksum(runs), "runs": runs}
        with atomic_write(self._path) as path:
            path.write_text(json.dumps(content), encoding="utf-8")


def _place(file: Path) -> str:
    return store_url(file) or str(file.absolute())


def _read(path: Path, key: str) -> dict[str, Any]:
    with os_errors_as_user_error(path):
        data = path.read_bytes()
    try:
        content = json.loads(data)
        if content["format"] != SURVEY_FORMAT or content["checksum"] != _checksum(content["runs"]):
            raise ValueError
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        fault = f"is not a survey of runs (`{SURVEY_FORMAT}`), or is damaged"
        raise UserError(fault, str(path), remedy="Remove it, or give --survey another file") from error
    runs: dict[str, Any] = content["runs"]
    return runs if content["key"] == key else {}


def _checksum(runs: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(runs, sort_keys=True).encode()).hexdigest()
