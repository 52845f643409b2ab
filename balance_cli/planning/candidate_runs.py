"""The runs from which a plan is chosen, at levels that exciters, cells and channels can bear."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve
from balance_cli.planning.hall import Hall, RecordSettings, excitable_components
from balance_cli.simulation.excitation import multisine
from balance_cli.simulation.load_signals import OVERSAMPLING
from balance_cli.simulation.plans import Component, Excitation, SweepPlan

Array = NDArray[np.float64]

CREST_FACTOR = 4.0
"""Peak over rms of a signal of many lines with random phases: exceeded by one period of 600 lines in 25.

It is that of cells and channels, too: their resonances mix the phases of any excitation."""
LINES = 2000
"""Frequencies at which the response is summed for the level: several in the width of a mode of damping ratio 0.005."""
MOST_CANDIDATES = 400
"""Runs that are rehearsed: each takes a second or two."""


@dataclass(frozen=True)
class CandidateRun:
    """A sweep that could be made: its plan, the `minutes` of its record, and what must be set up for it."""

    plan: SweepPlan
    minutes: float

    @property
    def setup(self) -> tuple[tuple[str, ...], float]:
        """Components excited and rotor speed: another set-up takes time to change to."""
        return self.plan.excited, self.plan.rotor_speed


@dataclass(frozen=True)
class LevelLimit:
    """The largest rms level [N, N m] of one component alone, and what limits it."""

    component: Component
    level: float
    reason: str


def candidate_runs(
    geometry: Geometry, hall: Hall, settings: RecordSettings, limits: Sequence[LevelLimit]
) -> tuple[CandidateRun, ...]:
    """All sweeps that the hall allows: components, excitation, band, level, periods and rotor speed.

    Components that are excited together share the cells' range equally. Raises UserError where there are too many.
    """
    largest = {limit.component: limit.level for limit in limits}
    runs = tuple(
        _candidate(excited, speed, band, excitation, share, periods, settings, largest, hall)
        for excited in component_sets(geometry, hall)
        for speed in hall.rotor_speeds
        for band in (settings.band, *hall.bands)
        for excitation in hall.excitations
        for share in hall.levels
        for periods in hall.periods
    )
    if len(runs) > MOST_CANDIDATES:
        fault = f"{len(runs)} runs to choose from, more than {MOST_CANDIDATES}"
        raise UserError(fault, place="levels, periods, bands", remedy="Give fewer values to choose from")
    return runs


def component_sets(geometry: Geometry, hall: Hall) -> Iterator[tuple[Component, ...]]:
    """Each component alone, and every set of as many as can be excited at once."""
    names = excitable_components(geometry, hall)
    for name in names:
        yield (name,)
    count = min(hall.simultaneous, len(names))
    if count > 1:
        yield from itertools.combinations(names, count)


def _candidate(
    excited: tuple[Component, ...],
    speed: float,
    band: tuple[float, float],
    excitation: Excitation,
    share: float,
    periods: int,
    settings: RecordSettings,
    largest: dict[Component, float],
    hall: Hall,
) -> CandidateRun:
    level = tuple(share * largest[name] / len(excited) for name in excited)
    words = ["+".join(excited), f"{100 * share:g}", f"{periods}p"]
    words += [f"{speed:g}Hz"] if speed else []
    words += [f"{band[0]:g}-{band[1]:g}"] if band != settings.band else []
    words += [excitation] if excitation != "multisine" else []
    plan = SweepPlan(
        run="-".join(words),
        excited=excited,
        level=level,
        excitation=excitation,
        band=band,
        period=settings.period,
        periods=periods,
        sample_rate=settings.sample_rate,
        rotor_speed=speed,
        phases=hall.phases if excitation == "multisine" else "random",
    )
    return CandidateRun(plan, plan.duration / 60.0 + hall.overhead_minutes)


def level_limits(geometry: Geometry, hall: Hall, settings: RecordSettings, system: System) -> tuple[LevelLimit, ...]:
    """The largest level of each component that can be excited, and what limits it."""
    frequency = np.linspace(*settings.band, LINES)
    solution = solve(system, frequency)
    crest = excitation_crest_factor(geometry, hall, settings)
    volts = np.sqrt(np.mean(np.abs(response(system, solution)) ** 2, axis=0))
    forces = np.sqrt(np.mean(np.abs(solution.forces) ** 2, axis=0))[: len(geometry.cells)]
    return tuple(
        min(_limits_of(name, geometry, hall, crest, volts, forces), key=lambda item: item.level)
        for name in excitable_components(geometry, hall)
    )


def excitation_crest_factor(geometry: Geometry, hall: Hall, settings: RecordSettings) -> float:
    """The largest peak over rms of any excitation that the hall can choose.

    That of a multisine with fixed phases is computed, for each band and each number of components at once.
    """
    if hall.phases == "random" or set(hall.excitations) != {"multisine"}:
        return CREST_FACTOR
    time = np.arange(round(OVERSAMPLING * settings.period * settings.sample_rate)) / (
        OVERSAMPLING * settings.sample_rate
    )
    counts = {len(names) for names in component_sets(geometry, hall)}
    rng = np.random.default_rng(0)  # not used by fixed phases
    waves = [
        multisine(time, settings.period, band, 1.0, rng, count, shift, hall.phases)
        for band in (settings.band, *hall.bands)
        for count in counts
        for shift in range(count)
    ]
    return max(float(np.abs(wave).max()) for wave in waves)


def _limits_of(
    name: Component, geometry: Geometry, hall: Hall, crest: float, volts: Array, forces: Array
) -> Iterator[LevelLimit]:
    """Every limit of the level of one component; `volts` (c, 6) and `forces` (cells, 6) are rms per unit of level.

    `crest` is the peak over rms of the excitation.
    """
    column = COMPONENTS.index(name)
    exciter = hall.exciters[name] if hall.exciters else None
    if exciter is not None and exciter.rms is not None:
        yield LevelLimit(name, exciter.rms, "rms of the exciter")
    if exciter is not None and exciter.peak is not None:
        yield LevelLimit(name, exciter.peak / crest, "peak of the exciter")
    share = min(hall.margin, 1.0 if exciter else hall.cell_share)
    for cell, force in zip(geometry.cells, forces[:, column], strict=True):
        if force > 0:
            yield LevelLimit(name, share * cell.full_range / (CREST_FACTOR * force), f"range of cell {cell.name}")
    for channel, volt in zip(geometry.channels, volts[:, column], strict=True):
        if channel.range is not None and volt > 0:
            limit = hall.margin * channel.range / (CREST_FACTOR * volt)
            yield LevelLimit(name, limit, f"range of channel {channel.name}")
    if exciter is None and any(meter.component == name for meter in geometry.shaft_meters):
        yield from _torque_limit(name, geometry, hall)


def _torque_limit(name: Component, geometry: Geometry, hall: Hall) -> Iterator[LevelLimit]:
    """The torque meter has no declared range: its rated load limits it, else the cells' range at the hub's height."""
    rated = (geometry.rated_loads or {}).get(name)
    reach = max(float(np.linalg.norm(np.asarray(cell.position)[:2])) for cell in geometry.cells)
    largest = rated if rated is not None else min(cell.full_range for cell in geometry.cells) * max(reach, 0.1)
    yield LevelLimit(name, hall.cell_share * largest / CREST_FACTOR, "range of the torque meter, taken from the cells")
