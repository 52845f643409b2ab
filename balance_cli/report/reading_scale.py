"""Unit in which the page shows small readings: a millionth of a volt or of a ratio to the excitation, or a count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.units import NUMBER, RATIO, VOLTAGE


@dataclass(frozen=True)
class ReadingScale:
    """Symbol of a unit, and how many of it the base unit of a reading is."""

    symbol: str
    per_base_unit: float


MICROVOLTS = ReadingScale("\N{MICRO SIGN}V", 1e6)
SCALES = {VOLTAGE: MICROVOLTS, RATIO: ReadingScale("\N{MICRO SIGN}V/V", 1e6), NUMBER: ReadingScale("count", 1.0)}
"""By base unit of the readings."""


def reading_scale(geometry: Geometry, channel_names: Sequence[str]) -> ReadingScale:
    """The unit of some channels; microvolts where they differ, which a note on the page explains."""
    units = {channel.reading_unit for channel in geometry.channels if channel.name in channel_names}
    return SCALES.get(units.pop(), MICROVOLTS) if len(units) == 1 else MICROVOLTS
