"""Geometry files in YAML: reading with all faults named by file, place and remedy, writing, and digests."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import geometry_faults
from balance_cli.io.atomic import atomic_write
from balance_cli.io.errors import UserError
from balance_cli.io.formats import GEOMETRY_FORMAT
from balance_cli.io.sniff import describe_file, is_hdf5, require_file
from balance_cli.io.text_output import write_text
from balance_cli.io.validation import validation_faults
from balance_cli.io.yaml_file import read_yaml


def load_geometry(path: Path) -> Geometry:
    """The geometry declared in a YAML file. Raises UserError for its first fault."""
    geometry, faults = read_geometry(path)
    if geometry is None or faults:
        raise faults[0]
    return geometry


def read_geometry(path: Path) -> tuple[Geometry | None, tuple[UserError, ...]]:
    """The geometry in a YAML file, if it can be read, and all its faults."""
    try:
        geometry, faults = _parse(_read_yaml(Path(path)))
    except UserError as error:
        return None, (error.with_location(file=str(path)),)
    return geometry, tuple(fault.with_location(file=str(path)) for fault in faults)


def save_geometry(path: Path, geometry: Geometry) -> None:
    """Write a geometry as YAML, whole or not at all."""
    text = yaml.safe_dump(geometry_to_dict(geometry), sort_keys=False, allow_unicode=True, default_flow_style=None)
    with atomic_write(Path(path)) as part:
        write_text(part, text)


def geometry_to_dict(geometry: Geometry) -> dict[str, Any]:
    """The geometry as plain dicts, lists, numbers and strings; keys that are not set are left out."""
    plain: dict[str, Any] = geometry.model_dump(mode="json", exclude_none=True)
    return plain


def geometry_from_dict(declared: object) -> Geometry:
    """The inverse of `geometry_to_dict`, with all checks. Raises UserError for the first fault."""
    geometry, faults = _parse(declared)
    if geometry is None or faults:
        raise faults[0]
    return geometry


def geometry_digest(geometry: Geometry) -> str:
    """Hex SHA-256 of the content: equal for two files that declare the same geometry in different form."""
    text = json.dumps(geometry_to_dict(geometry), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _parse(declared: object) -> tuple[Geometry | None, tuple[UserError, ...]]:
    if not isinstance(declared, dict):
        raise UserError(
            "is not a geometry: no keys in it", remedy=f"The first line should be `format: {GEOMETRY_FORMAT}`"
        )
    if declared.get("format", GEOMETRY_FORMAT) != GEOMETRY_FORMAT or not set(declared) & set(Geometry.model_fields):
        problem = f"is `{declared['format']}`" if "format" in declared else "is missing"
        raise UserError(f"`format` {problem}", place="format", remedy=f"It should be `format: {GEOMETRY_FORMAT}`")
    try:
        geometry = Geometry.model_validate(declared)
    except ValidationError as error:
        return None, validation_faults(Geometry, error)
    return geometry, tuple(geometry_faults(geometry))


def _read_yaml(path: Path) -> object:
    require_file(path)
    if not path.is_file() or is_hdf5(path):
        raise UserError(
            f"is {describe_file(path)}, where a geometry was expected", remedy="Give the YAML file of the rig"
        )
    return read_yaml(path, "a geometry")
