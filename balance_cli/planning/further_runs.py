"""Runs that a hall does not offer, and that may tell what its own do not: rehearsed to be named, not to be planned.

One of each kind: the rotor turning, a higher band, a low level, mean loads, a force beside the hub, weights. Sweeps
excite all components at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.system import System
from balance_cli.model.system_response import solve
from balance_cli.planning.hall import COMPONENT_NAMES, Hall, RecordSettings, hammer_points
from balance_cli.planning.levels import STATIC_SHARE, LevelLimit
from balance_cli.simulation.plans import Component, ForcePoint, StaticPlan, SweepPlan

HIGHER_BAND = 2.0
"""End of the higher band, and its sample rate, over those of the hall."""
LOW_LEVEL = 0.1
"""Level of the low sweep over the largest: cubic forces are then a hundredth beside the linear ones."""
MEAN_SHARE = 0.3
"""Largest force of the mean and static loads over the range of a cell: what remains bears the sweep."""
FEWEST_PERIODS = 5
"""Periods of the sweeps: three remain steady on most rigs."""


@dataclass(frozen=True)
class FurtherRun:
    """A run beyond those of the hall, and `what` it is in words."""

    what: str
    plan: SweepPlan | StaticPlan


def further_runs(
    geometry: Geometry, hall: Hall, settings: RecordSettings, limits: tuple[LevelLimit, ...], system: System
) -> tuple[FurtherRun, ...]:
    """The kinds of runs that the hall does not offer."""
    names = tuple(limit.component for limit in limits)
    base = SweepPlan(
        run="further",
        excited=names,
        level=tuple(limit.level / len(names) for limit in limits),
        band=settings.band,
        period=settings.period,
        periods=max(FEWEST_PERIODS, min(settings.periods)),
        sample_rate=settings.sample_rate,
        phases="schroeder",
    )
    return tuple(_further_sweeps(geometry, hall, base, system)) + tuple(_weights(geometry, hall, settings, system))


def _further_sweeps(geometry: Geometry, hall: Hall, base: SweepPlan, system: System) -> Iterator[FurtherRun]:
    def changed(**changes: object) -> SweepPlan:
        return base.model_copy(update=changes)

    if geometry.rotor is not None and not any(hall.rotor_speeds):
        words = f"sweeps with the rotor turning at {geometry.rotor.speed:g} Hz (`rotor_speeds`)"
        yield FurtherRun(words, changed(rotor_speed=geometry.rotor.speed))
    end = HIGHER_BAND * base.band[1]
    rate = HIGHER_BAND * base.sample_rate
    words = f"sweeps up to {end:.4g} Hz (`band`)"
    yield FurtherRun(words, changed(band=(base.band[0], end), sample_rate=rate))
    low = tuple(LOW_LEVEL * level for level in base.level)
    yield FurtherRun(f"sweeps at {LOW_LEVEL:g} of the level (`levels`)", changed(level=low))
    if hall.trims == ({},):
        steady = mean_loads(geometry, base.band[0], system)
        name = max(steady, key=lambda key: abs(steady[key]) * (key == "Fz"))
        words = f"sweeps under a mean load of {name} {steady[name]:.3g} (`trims`)"
        yield FurtherRun(words, changed(steady={name: steady[name]}))
    if hall.hammer is None or not hammer_points(hall, geometry):
        point = _point_beside_hub(geometry)
        force = max(level for name, level in zip(base.excited, base.level, strict=True))
        yield FurtherRun(
            "a force beside the hub (`hammer`, or an exciter there)",
            changed(excited=(point.component,), level=(force,), point=point),
        )


def _point_beside_hub(geometry: Geometry) -> ForcePoint:
    """A point at the height of the cells, as far out as they are, and an oblique force."""
    reach = np.max(np.abs([cell.position for cell in geometry.cells]), axis=0)
    position = (float(reach[0]), 0.5 * float(reach[1]), float(np.mean([cell.position[2] for cell in geometry.cells])))
    return ForcePoint(name="beside the hub", position=position, direction=(0.5, 0.7, 1.0))


def _weights(geometry: Geometry, hall: Hall, settings: RecordSettings, system: System) -> Iterator[FurtherRun]:
    if hall.minutes_per_point is None and any(channel.measures_dc for channel in geometry.channels):
        largest = mean_loads(geometry, settings.band[0], system)
        plan = StaticPlan(run="further-static", largest=largest, steps=2)
        yield FurtherRun("a static run (`minutes_per_point`; `--points` plans its load points)", plan)


def mean_loads(geometry: Geometry, lowest: float, system: System) -> Mapping[Component, float]:
    """The load of each component that takes MEAN_SHARE of the range of the cell with the least."""
    solution = solve(system, np.array([STATIC_SHARE * lowest]))
    forces = np.abs(np.real(solution.forces[0, : len(geometry.cells)]))
    full = np.array([cell.full_range for cell in geometry.cells])
    share = np.max(forces / full[:, None], axis=0)
    return {name: float(MEAN_SHARE / share[i]) for i, name in enumerate(COMPONENT_NAMES) if share[i] > 1e-12}
