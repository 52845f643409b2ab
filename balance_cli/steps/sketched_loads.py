"""Columns that a sketch takes for hub loads, by their names and units."""

from __future__ import annotations

import re
from collections.abc import Sequence

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.importers.base import ForeignChannel
from balance_cli.io.units import FORCE, MOMENT
from balance_cli.steps.sketched_times import unit_of

FORCE_MEMBER = re.compile(r"(f|m|force|moment|torque|load|kraft|last)\b", re.IGNORECASE)
"""Names of members of a structure that may have its load."""
_AXES = re.compile(r"(?<![a-z])(?P<what>force|moment|torque)[^a-z]*(?P<axis>[xyz])$", re.IGNORECASE)
"""Names such as `Force_X` and `wrench.torque.z`."""
_TORQUE = re.compile(r"T([xyz])$", re.IGNORECASE)
"""Moments of force-torque sensors, beside forces that are called `Fx`, `Fy`, `Fz`."""


def guess_loads(
    channels: Sequence[ForeignChannel],
) -> tuple[dict[str, tuple[ForeignChannel, str]], list[ForeignChannel]]:
    """Return the channels whose name contains a component and whose unit is not another, and the others.

    It is no guess for files of zero and wind runs alone, which have no loads: what they call so are readings.
    """
    loads: dict[str, tuple[ForeignChannel, str]] = {}
    rest = []
    forces = {_component(channel) for channel in channels}
    has_forces = forces.issuperset(COMPONENTS[:3])
    for channel in channels:
        component = _component(channel) or (_torque(channel) if has_forces else None)
        unit = unit_of(channel.unit, FORCE, MOMENT)
        fits = component and (unit.dimension == UNIT_OF[component] if unit else not channel.unit)
        if component and fits and component not in [name for _, name in loads.values()]:
            loads[channel.name] = (channel, component)
        else:
            rest.append(channel)
    return loads, rest


def _component(channel: ForeignChannel) -> str | None:
    """The component in the name of a channel."""
    # A structure `sweep_Fx` holds its force beside times and channels that are none.
    member = re.split(r"[./]", channel.signal)[-1]
    words = re.split(r"[^A-Za-z]+", channel.signal if FORCE_MEMBER.match(member) else member)
    component = next((name for name in COMPONENTS if name.lower() in [word.lower() for word in words]), None)
    if component is None and (match := _AXES.search(channel.signal)):
        component = ("F" if match["what"].lower() == "force" else "M") + match["axis"].lower()
    return component


def _torque(channel: ForeignChannel) -> str | None:
    match = _TORQUE.match(channel.signal)
    return f"M{match[1].lower()}" if match else None
