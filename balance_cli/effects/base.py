"""What an effect is: one physical thing that the rigid balance lacks, whole in one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from balance_cli.equations import Equations
from balance_cli.geometry import Geometry
from balance_cli.jets import Jet

Where = tuple[str, ...]


@dataclass(frozen=True)
class EffectParameter:
    """One parameter: unit, the value at which it does nothing, bounds, the size of a change that matters, a sentence.

    `start` is where a fit begins when the null itself is singular for other parameters (a mass without compliance
    does nothing).
    """

    name: str
    unit: str
    null: float
    scale: float
    sentence: str
    lower: float = -np.inf
    upper: float = np.inf
    start: float | None = None


@dataclass(frozen=True)
class Effect:
    """An effect: what it is, where it holds, where it was published, and what it adds to the equations.

    `places(geometry)` are all places that it can have; `parameters(geometry, where)` its parameters there;
    `apply(equations, geometry, where, values)` adds it, `values` being the parameters as jets by name. At the null of
    every parameter the equations are left as they are. `trace` says what it leaves in a residual, `separated_by` which
    measurement tells it from what looks alike.
    """

    name: str
    summary: str
    validity: str
    reference: str
    trace: str
    separated_by: str
    places: Callable[[Geometry], tuple[Where, ...]]
    parameters: Callable[[Geometry, Where], tuple[EffectParameter, ...]]
    apply: Callable[[Equations, Geometry, Where, Mapping[str, Jet]], Equations]


def each_cell(geometry: Geometry) -> tuple[Where, ...]:
    """One place a cell."""
    return tuple((cell.name,) for cell in geometry.cells)


def each_channel(geometry: Geometry) -> tuple[Where, ...]:
    """One place a channel."""
    return tuple((channel.name,) for channel in geometry.channels)


def nowhere_in_particular(_: Geometry) -> tuple[Where, ...]:
    """The one place of an effect of the whole rig."""
    return ((),)
