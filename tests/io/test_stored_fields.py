"""Fields of artefacts are the schema of the files: none is lost or renamed, and later ones have a default."""

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from balance_cli.api.artefacts import ARTEFACT_TYPES
from balance_cli.io.hdf5_tree import stored_field_name

LISTED = Path(__file__).parent / "stored_fields.txt"
"""Fields of each format, those of a part under its name; ` =`: with a default. New lines have one; none is removed."""


def test_every_field_that_files_hold_is_listed_for_ever() -> None:
    """A line that is missing in the code is a field that files of former versions hold: they could not be read."""
    now = [line for format, kind in ARTEFACT_TYPES.items() for line in (format, *field_lines(kind, "  "))]
    assert now == LISTED.read_text(encoding="utf-8").splitlines()


def field_lines(hint: Any, indent: str) -> Iterator[str]:
    """Names of the fields within a type, each part indented below its own name."""
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin in (tuple, dict, Mapping, typing.Annotated, typing.Union, types.UnionType):
        for part in arguments[:1] if origin is typing.Annotated else arguments:
            yield from field_lines(part, indent)
    elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        for item in dataclasses.fields(hint):
            missing = dataclasses.MISSING
            later = item.default is not missing or item.default_factory is not missing
            yield f"{indent}{stored_field_name(item)}{' =' if later else ''}"
            yield from field_lines(hints[item.name], indent + "  ")
