"""The runs from which a plan is chosen: sweeps, hits of a hammer and static runs."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.system import System
from balance_cli.planning.hall import (
    Hall,
    RecordSettings,
    excitable_components,
    hammer_points,
    hit_contact,
    hit_period,
    static_load_limits,
)
from balance_cli.planning.levels import hit_level, level_limits
from balance_cli.simulation.excitation import Power
from balance_cli.simulation.plans import Component, Excitation, LoadValues, StaticPlan, SweepPlan
from balance_cli.simulation.statics import static_load_points

MOST_CANDIDATES = 400
"""Runs that are rehearsed: each takes a second or two."""
STATIC_STEPS = 2
"""Steps of each load of a static run, up and down through zero: the loads tell most at their largest."""


@dataclass(frozen=True)
class CandidateRun:
    """A run that could be made: its plan, the `minutes` of its record, and what must be set up for it."""

    plan: SweepPlan | StaticPlan
    minutes: float

    @property
    def setup(self) -> tuple[object, ...]:
        """Components excited, point, rotor speed and mean loads: another set-up takes time to change to."""
        if isinstance(self.plan, StaticPlan):
            return ("static", self.plan.trim)
        point = self.plan.point.name if self.plan.point else ""
        return self.plan.excited, point, self.plan.rotor_speed, tuple(sorted((self.plan.steady or {}).items()))


@dataclass(frozen=True)
class SweepChoice:
    """What is chosen of a sweep; `largest` levels of its components alone, `power` of their lines."""

    excited: tuple[Component, ...]
    speed: float
    steady: LoadValues
    band: tuple[float, float]
    excitation: Excitation
    share: float
    periods: int
    largest: Mapping[Component, float]
    power: Power | None


def candidate_runs(
    geometry: Geometry,
    hall: Hall,
    settings: RecordSettings,
    system: System,
    powers: Mapping[Component, Power] | None = None,
) -> tuple[CandidateRun, ...]:
    """All runs that the hall allows: sweeps, hits at points, and static runs.

    `powers`: relative power of the lines of a component that is excited alone. Components that are excited together
    share the cells' range equally. Raises UserError where there are too many.
    """
    choices = tuple(_sweep_choices(geometry, hall, settings, system, powers or {}))
    sweeps = (
        CandidateRun(plan, plan.duration / 60.0 + hall.overhead_minutes) for plan in _sweeps(choices, hall, settings)
    )
    runs = (*sweeps, *_hammer_runs(geometry, hall, settings, system), *_static_runs(geometry, hall))
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


def _sweep_choices(
    geometry: Geometry, hall: Hall, settings: RecordSettings, system: System, powers: Mapping[Component, Power]
) -> Iterator[SweepChoice]:
    for trim in hall.trims:
        flat, shaped = (
            {limit.component: limit.level for limit in level_limits(geometry, hall, settings, system, each, trim)}
            for each in ({}, powers)
        )
        for excited, speed, band, excitation, share, periods in itertools.product(
            component_sets(geometry, hall),
            hall.rotor_speeds,
            (settings.band, *hall.bands),
            hall.excitations,
            hall.levels,
            settings.periods,
        ):
            # Where the band is another one, the limits of the shaped power do not hold.
            has_power = len(excited) == 1 and excitation == "multisine" and band == settings.band
            power = powers.get(excited[0]) if has_power else None
            largest = shaped if power else flat
            yield SweepChoice(excited, speed, trim, band, excitation, share, periods, largest, power)


def _sweeps(choices: tuple[SweepChoice, ...], hall: Hall, settings: RecordSettings) -> Iterator[SweepPlan]:
    for choice in choices:
        yield SweepPlan(
            run="-".join(_words(choice, settings)),
            excited=choice.excited,
            level=tuple(choice.share * choice.largest[name] / len(choice.excited) for name in choice.excited),
            excitation=choice.excitation,
            band=choice.band,
            period=settings.period,
            periods=choice.periods,
            sample_rate=settings.sample_rate,
            rotor_speed=choice.speed,
            phases=hall.phases if choice.excitation == "multisine" else "random",
            power=choice.power,
            steady=choice.steady or None,
        )


def _words(choice: SweepChoice, settings: RecordSettings) -> Iterator[str]:
    """Words of the name of a sweep."""
    yield "+".join(choice.excited)
    yield f"{100 * choice.share:g}"
    yield f"{choice.periods}p"
    if choice.speed:
        yield f"{choice.speed:g}Hz"
    if choice.band != settings.band:
        yield f"{choice.band[0]:g}-{choice.band[1]:g}"
    if choice.excitation != "multisine":
        yield choice.excitation
    for name, load in choice.steady.items():
        yield f"at-{name}={load:g}"


def _hammer_runs(geometry: Geometry, hall: Hall, settings: RecordSettings, system: System) -> Iterator[CandidateRun]:
    """Hits at each point, as many as the sweeps have periods."""
    for name, point in hammer_points(hall, geometry).items():
        contact, period = hit_contact(hall, settings), hit_period(hall, settings)
        level = hit_level(point, geometry, hall, settings, contact, system)
        for hits in settings.periods:
            plan = SweepPlan(
                run=f"hammer-{name}-{hits}p",
                excited=(point.component,),
                level=(level,),
                excitation="impact",
                contact=contact,
                band=settings.band,
                period=period,
                periods=hits,
                sample_rate=settings.sample_rate,
                point=point,
            )
            yield CandidateRun(plan, plan.duration / 60.0 + hall.overhead_minutes)


def _static_runs(geometry: Geometry, hall: Hall) -> Iterator[CandidateRun]:
    """A static run of each mean load, with all components one by one."""
    if hall.minutes_per_point is None:
        return
    largest = static_load_limits(geometry, hall)
    for trim in hall.trims:
        words = "-".join(f"{name}={load:g}" for name, load in trim.items())
        plan = StaticPlan(
            run=f"static-{words or 'bare'}", trim=words or "bare", trim_loads=trim, largest=largest, steps=STATIC_STEPS
        )
        rows = len(static_load_points(plan))
        yield CandidateRun(plan, rows * hall.minutes_per_point + hall.overhead_minutes)


def by_turns(candidates: tuple[CandidateRun, ...]) -> tuple[CandidateRun, ...]:
    """The candidates in turns: one of each set-up, the first at the largest level and least time, then the next."""
    turn: dict[tuple[object, ...], int] = {}
    places = []
    for item in candidates:
        places.append(turn.get(item.setup, 0))
        turn[item.setup] = places[-1] + 1
    return tuple(item for _, item in sorted(zip(places, candidates, strict=True), key=lambda pair: pair[0]))


def number_runs(runs: Iterable[CandidateRun]) -> tuple[CandidateRun, ...]:
    """The runs with unique names: those of the candidates, with a number in front."""
    return tuple(
        CandidateRun(item.plan.model_copy(update={"run": f"{i:02d}-{item.plan.run}"}), item.minutes)
        for i, item in enumerate(runs, 1)
    )
