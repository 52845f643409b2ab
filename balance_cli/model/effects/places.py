"""Places of effects: where in a rig an effect can act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel_groups import ALL, channel_groups
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Cell, Geometry

Where = tuple[str, ...]
"""A place: names of cells, channels, load components or motions; empty for an effect of the whole rig."""


@dataclass(frozen=True)
class Choice:
    """A parameter whose value is one of a few words; the first word is the default."""

    name: str
    words: tuple[str, ...]
    description: str


INSIDE, BESIDE = "inside", "beside"
SIDE = Choice("side", (INSIDE, BESIDE), "`inside` the cell, whose channels also read the force, or `beside` it.")


def whole_rig(_: Geometry) -> tuple[Where, ...]:
    """The only place of an effect of the whole rig."""
    return ((),)


def each_cell(geometry: Geometry) -> tuple[Where, ...]:
    """One place per cell."""
    return tuple((cell.name,) for cell in geometry.cells)


def each_cell_or_all(geometry: Geometry) -> tuple[Where, ...]:
    """All cells together, then one place per cell."""
    return ((ALL,), *each_cell(geometry))


def each_cell_and_side(geometry: Geometry) -> tuple[Where, ...]:
    """Two places per measured cell: inside it and beside it."""
    return tuple((cell, side) for (cell,) in each_measured_cell(geometry) for side in SIDE.words)


def each_measured_cell(geometry: Geometry) -> tuple[Where, ...]:
    """One place per cell that has a channel of its own, which tells its elongation at every instant."""
    measured = {channel.cell for channel in geometry.channels}
    return tuple((cell.name,) for cell in geometry.cells if cell.name in measured)


def each_channel(geometry: Geometry) -> tuple[Where, ...]:
    """One place per channel."""
    return tuple((channel.name,) for channel in geometry.channels)


def each_channel_or_group(geometry: Geometry) -> tuple[Where, ...]:
    """One place per channel, then one per group of channels."""
    return (*each_channel(geometry), *((name,) for name in channel_groups(geometry)))


def channels_at(geometry: Geometry, where: Where) -> tuple[str, ...]:
    """Names of the channels at a place, which is a channel or a group of channels."""
    return where if where[0] in geometry.channel_names else channel_groups(geometry)[where[0]]


def cell_at(geometry: Geometry, where: Where) -> Cell:
    """The cell at a place, whose first name is that of the cell."""
    return next(cell for cell in geometry.cells if cell.name == where[0])


def cells_at(geometry: Geometry, where: Where) -> list[int]:
    """Indices of the cells at a place, which is the name of one cell or `all`."""
    return [i for i, cell in enumerate(geometry.cells) if where == (ALL,) or cell.name in where]


def each_component(_: Geometry) -> tuple[Where, ...]:
    """One place per load component."""
    return tuple((name,) for name in COMPONENTS)


def each_component_and_motion(_: Geometry) -> tuple[Where, ...]:
    """One place per load component, then one per pair of a component and a force along which its exciter moves, too."""
    forces = tuple(name for name in COMPONENTS if name.startswith("F"))
    return (*((name,) for name in COMPONENTS), *((a, b) for a in COMPONENTS for b in forces if a != b))


def all_or_each_component(geometry: Geometry) -> tuple[Where, ...]:
    """All load components together, then one place per component."""
    return ((ALL,), *each_component(geometry))


def acts_on_loads(places: Callable[[Geometry], tuple[Where, ...]], geometry: Geometry) -> bool:
    """Whether these places are load components, whose group is `all`, too."""
    return (COMPONENTS[0],) in places(geometry)


def all_or_each_force(_: Geometry) -> tuple[Where, ...]:
    """All forces together, then one place per force."""
    return ((ALL,), *((name,) for name in COMPONENTS if name.startswith("F")))


def unit_components(where: Where) -> NDArray[np.float64]:
    """Ones (6,) at the components of a place, which is the name of one component or `all`."""
    return np.array([float(where == (ALL,) or name in where) for name in COMPONENTS])


def nonempty_subsets(names: tuple[str, ...]) -> tuple[Where, ...]:
    """All subsets of at least one of `names`, small subsets first, each in the order of `names`."""
    subsets = [tuple(name for i, name in enumerate(names) if bits >> i & 1) for bits in range(1, 2 ** len(names))]
    return tuple(sorted(subsets, key=lambda where: (len(where), [names.index(name) for name in where])))


@cache
def ordered_pairs(names: tuple[str, ...]) -> tuple[Where, ...]:
    """All pairs of two different names, in both orders."""
    return tuple((first, second) for first in names for second in names if first != second)
