"""What a test hall allows: exciters, ranges, times and records (`format: balance-hall/1`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.declared_values import FrozenModel, Name, NonNegative, Positive, Vector
from balance_cli.campaign.rig.geometry import DeclaredLoadPoint, Geometry
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from balance_cli.planning.extended_model import effect_names
from balance_cli.simulation.noise import DeclaredNoise
from balance_cli.simulation.plans import (
    LONGEST_CONTACT,
    MOST_SAMPLES,
    Component,
    Excitation,
    ForcePoint,
    LoadValues,
    Phases,
)

COMPONENT_NAMES: tuple[Component, ...] = get_args(Component)

MOST_PERIODS = 1000
"""Periods of a run: at four seconds each a record of more than an hour."""
LINES_PER_HALF_WIDTH = 1.2
"""Spectral lines in the half-width, damping ratio times frequency, of the narrowest mode: a peak is not missed."""
BAND_BELOW_LOWEST_MODE = 0.1
"""Start of the band over the lowest mode: there the response is quasi-static, and stiffness alone counts."""
BAND_ABOVE_HARMONICS = 8.5
"""End of the band over the rotor speed: beyond harmonic 8, which `reduce` estimates by default."""
BAND_ABOVE_MODES = 1.3
"""End of the band over the highest mode: beyond it the mass dominates."""
USUAL_PERIODS = (7, 15)
"""Numbers of periods to choose from, where the hall does not say them: about half of the shorter record is steady."""
LEAST_LONGEST = 10.0
"""[s] that the longest record takes at least: beside an overhead of half a minute a shorter one wastes hall time."""
SAMPLES_PER_CYCLE = 5.0
"""Sample rate over the end of the band, where the acquisition does not say it."""
FILTER_SAMPLES = 4.0
"""Sample rate over the cutoff of the anti-alias filter."""
BAND_BELOW_CUTOFF = 0.75
"""End of the band over the cutoff of the anti-alias filter."""


WHOLE = 1e-6
"""Periods that are no more than this beyond a whole number are it: rounding."""
SHORTEST_HIT_PERIOD = 0.2
"""[s] between two hits: what comes sooner is a hammer that bounced (`signals.impact.DOUBLE_INTERVAL`)."""


class Exciter(FrozenModel):
    """Limits of the exciter of one component: `rms` and `peak` of its force [N] or moment [N m]."""

    rms: Positive | None = None
    peak: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> Exciter:
        if self.rms is None and self.peak is None:
            raise ValueError("give `rms` or `peak`")
        return self


class HammerPoint(FrozenModel):
    """A point at which a hammer can hit: `position` [m] and `direction` of the force."""

    position: Vector
    direction: Vector

    @model_validator(mode="after")
    def _check(self) -> HammerPoint:
        if not any(self.direction):
            raise ValueError("`direction` has no length")
        return self


class Hammer(FrozenModel):
    """A hammer: `peak` [N] and duration (`contact`, s) of its hits, `period` [s] from one hit to the next.

    `points` by name are those at which it can hit; without them the load points of the geometry that have a direction.
    """

    peak: Positive
    contact: Positive | None = None
    period: Annotated[float, Field(ge=SHORTEST_HIT_PERIOD, allow_inf_nan=False)] | None = None
    points: Annotated[Mapping[Name, HammerPoint], Field(min_length=1)] | None = None


class Hall(FrozenModel):
    """Constraints of a test hall.

    Without `exciters` every component can be excited, and a sweep takes at most `cell_share` of a cell's full range;
    always at most `margin` of it and of a channel's range. `simultaneous`: exciters that can run at once.
    `change_minutes`: time for another set-up (other components, another rotor speed); `overhead_minutes`: time that
    each run takes besides its record. `band` [Hz], `sample_rate` [Hz], `period` [s] and `periods` (numbers of periods
    to choose from, by default 7 and 15, and more where 15 take less than 10 s) describe the records; `bands` and
    `excitations` are further choices, `levels` shares of the largest level, `rotor_speeds` [Hz] those at which sweeps
    can be made, `trims` mean loads during a sweep; `phases` are those of the multisines, and `spectrum` says whether
    their power is put where it tells most. `hammer`: its hits.
    `minutes_per_point`: time of a load point, with which static runs can be chosen, too. `loads`:
    amplitude [N, N m] of the hub loads for which their sigma counts; `record_seconds`: length of a record with the
    rotor turning. `effects`: names of those that the plan considers, by default all. `static_loads`: largest load of
    each component in a static schedule.
    """

    format: Literal["balance-hall/1"]
    exciters: Annotated[Mapping[Component, Exciter], Field(min_length=1)] | None = None
    simultaneous: Annotated[int, Field(ge=1, le=len(COMPONENTS))] = 1
    change_minutes: NonNegative = 5.0
    overhead_minutes: NonNegative = 0.5
    band: tuple[Positive, Positive] | None = None
    sample_rate: Positive | None = None
    period: Positive | None = None
    periods: Annotated[tuple[Annotated[int, Field(ge=2, le=MOST_PERIODS)], ...], Field(min_length=1)] | None = None
    levels: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = (1.0, 0.4)
    rotor_speeds: Annotated[tuple[NonNegative, ...], Field(min_length=1)] = (0.0,)
    excitations: Annotated[tuple[Excitation, ...], Field(min_length=1)] = ("multisine",)
    trims: Annotated[tuple[LoadValues, ...], Field(min_length=1)] = ({},)
    phases: Phases = "low-crest"
    spectrum: Literal["optimal", "flat"] = "optimal"
    hammer: Hammer | None = None
    minutes_per_point: Positive | None = None
    bands: tuple[tuple[Positive, Positive], ...] = ()
    cell_share: Annotated[float, Field(gt=0, le=1)] = 0.05
    margin: Annotated[float, Field(gt=0, le=1)] = 0.8
    loads: Mapping[Component, Positive] | None = None
    static_loads: Annotated[Mapping[Component, Positive], Field(min_length=1)] | None = None
    record_seconds: Positive = 20.0
    noise: DeclaredNoise | None = None
    effects: tuple[Name, ...] | None = None

    @model_validator(mode="after")
    def _check(self) -> Hall:
        if self.exciters is not None and self.simultaneous > len(self.exciters):
            raise ValueError(f"`simultaneous` is {self.simultaneous}, but there are {len(self.exciters)} `exciters`")
        for band in (*self.bands, *([self.band] if self.band else [])):
            if not band[0] < band[1]:
                raise ValueError(f"a band of {band[0]:g} to {band[1]:g} Hz should rise")
        if "impact" in self.excitations:
            raise ValueError("`impact` is no choice of `excitations`: declare a `hammer`")
        for name in ("periods", "levels", "rotor_speeds", "excitations", "bands", "trims"):
            values = getattr(self, name) or ()
            if len({str(value) for value in values}) < len(values):
                raise ValueError(f"`{name}` has a value twice")
        return self


class RecordSettings(FrozenModel):
    """Band [Hz], sample rate [Hz] and period [s] of the sweeps, and the numbers of periods to choose from."""

    band: tuple[Positive, Positive]
    sample_rate: Positive
    period: Positive
    periods: tuple[int, ...]


def open_hall() -> Hall:
    """A hall without constraints: one exciter at a time, on any component."""
    return Hall(format="balance-hall/1")


def excitable_components(geometry: Geometry, hall: Hall) -> tuple[Component, ...]:
    """The components that the hall can excite and the balance carries, in order.

    Raises UserError where an exciter acts on a component that the balance does not carry.
    """
    carried = carried_components(geometry)
    if hall.exciters is None:
        return tuple(name for name in COMPONENT_NAMES if name in carried)
    wrong = [name for name in hall.exciters if name not in carried]
    if wrong:
        fault = f"the balance does not carry {', '.join(wrong)}"
        raise UserError(fault, place="exciters", remedy=f"Give exciters of {', '.join(carried)}")
    return tuple(name for name in COMPONENT_NAMES if name in hall.exciters)


def hit_period(hall: Hall, settings: RecordSettings) -> float:
    """Time [s] between two hits of the hammer: as declared, else a period of the sweeps, in whole samples."""
    declared = hall.hammer.period if hall.hammer else None
    period = declared or max(settings.period, SHORTEST_HIT_PERIOD)
    return math.ceil(period * settings.sample_rate - 1e-6) / settings.sample_rate


def hit_contact(hall: Hall, settings: RecordSettings) -> float:
    """Duration [s] of a hit: as declared, else one over the band's end (where its spectrum is then a third).

    Raises UserError where it is too long for the time between two hits.
    """
    declared = hall.hammer.contact if hall.hammer else None
    contact = declared or 1.0 / settings.band[1]
    if contact > LONGEST_CONTACT * hit_period(hall, settings):
        fault = (
            f"a contact of {contact:g} s is more than a twentieth of the {hit_period(hall, settings):g} s between hits"
        )
        raise UserError(fault, place="hammer", remedy="Give a shorter `contact` or a longer `period`")
    return contact


def hammer_points(hall: Hall, geometry: Geometry) -> dict[str, ForcePoint]:
    """The points at which the hammer can hit. Raises UserError where there are none."""
    if hall.hammer is None:
        return {}
    declared: Mapping[str, HammerPoint | DeclaredLoadPoint] = hall.hammer.points or geometry.load_points or {}
    points = {
        name: ForcePoint(name=name, position=point.position, direction=point.direction)
        for name, point in declared.items()
        if point.direction is not None
    }
    if not points:
        remedy = "Give `points`, or load points with a direction in the geometry"
        raise UserError("the hammer has no points to hit", place="hammer.points", remedy=remedy)
    return points


def static_load_limits(geometry: Geometry, hall: Hall | None) -> dict[Component, float]:
    """The largest static loads: of the hall, else the rated ones. Raises UserError where neither states any."""
    stated = dict(((hall.static_loads if hall else None) or geometry.rated_loads or {}).items())
    largest = {name: stated[name] for name in COMPONENT_NAMES if name in stated}
    if not largest:
        fault = "neither `static_loads` of the hall nor `rated_loads` of the geometry state the largest loads"
        raise UserError(fault, remedy="Add `static_loads: {Fx: ...}` to the hall file")
    return largest


def record_settings(geometry: Geometry, hall: Hall) -> RecordSettings:
    """Band, sample rate and period: those of the hall, else from the modes, the rotor speed and the filter.

    Raises UserError where the band does not end below half the sample rate, or a record would be too long.
    """
    band, sample_rate = _band_and_rate(geometry, hall)
    if band[1] >= sample_rate / 2.0:
        fault = f"the band ends at {band[1]:g} Hz, not below half of the sample rate {sample_rate:g} Hz"
        raise UserError(fault, place="band", remedy="Give a lower `band` or a higher `sample_rate`")
    period = hall.period or _whole_samples(_default_period(geometry), sample_rate)
    if band[1] * period - max(band[0] * period, 1.0) < 1.0:
        fault = f"a period of {period:g} s has no two lines from {band[0]:g} to {band[1]:g} Hz"
        raise UserError(fault, place="period", remedy="Give a longer `period` or a wider `band`")
    periods = hall.periods or _default_periods(period)
    if max(periods) * period * sample_rate > MOST_SAMPLES:
        fault = f"{max(periods)} periods of {period:g} s are more than {MOST_SAMPLES} samples"
        raise UserError(fault, place="periods", remedy="Give fewer `periods` or a shorter `period`")
    fastest = max(hall.rotor_speeds)
    if fastest >= sample_rate / 2.0:
        fault = f"the rotor speed {fastest:g} Hz is not below half of the sample rate {sample_rate:g} Hz"
        raise UserError(fault, place="rotor_speeds", remedy="Give lower speeds or a higher `sample_rate`")
    return RecordSettings(band=band, sample_rate=sample_rate, period=period, periods=periods)


def _band_and_rate(geometry: Geometry, hall: Hall) -> tuple[tuple[float, float], float]:
    frequency = modes(balance_model(geometry).system()).frequency
    speed = geometry.rotor.speed if geometry.rotor else 0.0
    reference = speed or 1.0
    lowest, highest = (frequency.min(), frequency.max()) if len(frequency) else (reference, reference)
    top = max(BAND_ABOVE_HARMONICS * speed, BAND_ABOVE_MODES * float(highest))
    anti_alias = geometry.acquisition.filter
    if anti_alias is not None:
        top = min(top, BAND_BELOW_CUTOFF * anti_alias.cutoff)
    band = hall.band or (BAND_BELOW_LOWEST_MODE * float(lowest), top)
    rate = FILTER_SAMPLES * anti_alias.cutoff if anti_alias is not None else SAMPLES_PER_CYCLE * band[1]
    return band, hall.sample_rate or rate


def _default_period(geometry: Geometry) -> float:
    table = modes(balance_model(geometry).system())
    half_width = table.damping_ratio * table.frequency
    narrow = half_width[half_width > 0]
    return LINES_PER_HALF_WIDTH / float(narrow.min()) if len(narrow) else 4.0


def _default_periods(period: float) -> tuple[int, ...]:
    """The usual numbers of periods, both larger by as much as makes the longest record last."""
    factor = max(1.0, LEAST_LONGEST / (max(USUAL_PERIODS) * period))
    return tuple(min(math.ceil(factor * count - WHOLE), MOST_PERIODS) for count in USUAL_PERIODS)


def _whole_samples(period: float, sample_rate: float) -> float:
    """A period of a whole, even number of samples."""
    return 2.0 * max(round(0.5 * period * sample_rate), 2) / sample_rate


def check_names(hall: Hall, geometry: Geometry) -> None:
    """Raise UserError where a hall names an unknown effect, or a channel that the geometry lacks."""
    known = effect_names()
    for name in hall.effects or ():
        if name not in known:
            raise UserError(f"`{name}` is no effect", place="effects", remedy=f"Give some of {', '.join(known)}")
    for name in hall.noise.channels if hall.noise else ():
        if name not in geometry.channel_names:
            remedy = f"Give some of {', '.join(geometry.channel_names)}"
            raise UserError(f"the geometry has no channel `{name}`", place="noise.channels", remedy=remedy)
