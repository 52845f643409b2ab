"""Groups of channels that share a box, a kind of amplifier or a clock, and so may share a fault."""

from __future__ import annotations

from balance_cli.campaign.rig.geometry import Geometry

ALL = "all"
"""All channels, or, as the place of an effect of cells, all cells."""
STRAIN, PIEZO = "strain", "piezo"
"""All channels of cells that pass a constant load, and all that do not."""


def channel_groups(geometry: Geometry) -> dict[str, tuple[str, ...]]:
    """Return groups of several channels by name: those that the geometry declares, then those that most rigs have.

    The latter are `strain`, `piezo` and `all`; one whose name or members are already taken is left out.
    """
    of_cells = [channel for channel in geometry.channels if channel.cell_weights]
    usual = {
        STRAIN: tuple(channel.name for channel in of_cells if channel.measures_dc),
        PIEZO: tuple(channel.name for channel in of_cells if not channel.measures_dc),
        ALL: geometry.channel_names,
    }
    groups = {name: members for name, members in geometry.acquisition.groups.items() if len(members) > 1}
    taken = {*groups, *geometry.channel_names, *geometry.cell_names}
    for name, members in usual.items():
        is_new = name not in taken and set(members) not in map(set, groups.values())
        if len(members) > 1 and is_new:
            groups[name] = members
    return groups


def expand_group(where: tuple[str, ...], geometry: Geometry) -> tuple[str, ...]:
    """Return the channels of the group at a place; the place itself where it is not a group, or means `all`."""
    return where if len(where) != 1 or where[0] == ALL else channel_groups(geometry).get(where[0], where)
