"""What `balance check` says of the maps of imports."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from balance_cli.campaign.recording.frf_map import read_frf_map
from balance_cli.campaign.recording.import_map_file import read_import_map
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.io.formats import FRF_MAP_FORMAT
from balance_cli.io.result_view import plural


def check_map(path: Path, format: str, geometry: Geometry | None) -> tuple[str, str, tuple[UserError, ...]]:
    """Return what a map is, its rig, and its faults, also against a geometry where one is given."""
    is_frf = format == FRF_MAP_FORMAT
    what = "map of frequency responses" if is_frf else "map of an import"
    try:
        rig, names, more = _frf_map(path) if is_frf else _import_map(path)
    except UserError as error:
        return what, "", (error,)
    about = f"{what} for rig `{rig}`: {plural(len(names), 'channel')}, {more}"
    return about, rig, _unknown_channels(path, "responses" if is_frf else "channels", names, geometry)


def _import_map(path: Path) -> tuple[str, list[str], str]:
    mapping = read_import_map(path)
    return mapping.rig, [channel.name for channel in mapping.channels.values()], plural(len(mapping.runs), "run")


def _frf_map(path: Path) -> tuple[str, list[str], str]:
    mapping = read_frf_map(path)
    names = [item.name for item in mapping.responses.values()]
    return mapping.rig, names, plural(len(mapping.references), "reference")


def _unknown_channels(path: Path, place: str, names: Iterable[str], geometry: Geometry | None) -> tuple[UserError, ...]:
    """Return the faults of the channels of a map that a geometry does not have."""
    known = None if geometry is None else set(geometry.channel_names)
    return tuple(
        UserError(f"the geometry has no channel `{name}`", str(path), place, "Correct the name")
        for name in names
        if known is not None and name not in known
    )
