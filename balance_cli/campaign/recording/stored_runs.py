"""Runs on object stores: read from a local copy, which is removed at once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from balance_cli.campaign.recording.run import MOST_HELD_BYTES, MemorySource, Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.io.object_store import local_copy, store_url


def read_urls(**options: Any) -> Callable[[Callable[..., Run]], Callable[..., Run]]:
    """Decorate a reader of runs `(path, geometry, ...)`, so that the path may be a URL.

    It is then called with `options`. With `hold=True` among them the samples must fit into memory. Raises UserError
    where they do not.
    """

    def decorate(reader: Callable[..., Run]) -> Callable[..., Run]:
        @functools.wraps(reader)
        def read(path: Path, geometry: Geometry, *arguments: Any, **keywords: Any) -> Run:
            url = store_url(path)
            if url is None:
                return reader(path, geometry, *arguments, **keywords)
            with local_copy(url) as copy:
                run = _read_copy(lambda: reader(copy, geometry, **options), copy, url)
            if options.get("hold") and not isinstance(run.source, MemorySource):
                fault = f"is longer than the {MOST_HELD_BYTES // 2**20} MB that are read from a store"
                raise UserError(fault, url, remedy="Copy it to a local disk first")
            return replace(run, path=path)

        return read

    return decorate


def _read_copy(read: Callable[[], Run], copy: Path, url: str) -> Run:
    """Return what is read, or raise its error with the URL in place of the copy."""
    try:
        return read()
    except UserError as error:
        raise UserError(
            error.fault, url if error.file == str(copy) else error.file, error.place, error.remedy
        ) from error
