"""What a test hall allows: exciters, ranges, times and records (`format: balance-hall/1`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.declared_values import FrozenModel, Name, NonNegative, Positive
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from balance_cli.model.plate import carried_components
from balance_cli.simulation.noise import DeclaredNoise
from balance_cli.simulation.plans import MOST_SAMPLES, Component, Excitation, Phases

HALL_FORMAT = "balance-hall/1"
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
SAMPLES_PER_CYCLE = 5.0
"""Sample rate over the end of the band, where the acquisition does not say it."""
FILTER_SAMPLES = 4.0
"""Sample rate over the cutoff of the anti-alias filter."""
BAND_BELOW_CUTOFF = 0.75
"""End of the band over the cutoff of the anti-alias filter."""


class Exciter(FrozenModel):
    """Limits of the exciter of one component: `rms` and `peak` of its force [N] or moment [N m]."""

    rms: Positive | None = None
    peak: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> Exciter:
        if self.rms is None and self.peak is None:
            raise ValueError("give `rms` or `peak`")
        return self


class Hall(FrozenModel):
    """Constraints of a test hall.

    Without `exciters` every component can be excited, and a sweep takes at most `cell_share` of a cell's full range;
    always at most `margin` of it and of a channel's range. `simultaneous`: exciters that can run at once.
    `change_minutes`: time for another set-up (other components, another rotor speed); `overhead_minutes`: time that
    each run takes besides its record. `band` [Hz], `sample_rate` [Hz], `period` [s] and `periods` (numbers of periods
    to choose from) describe the records; `bands` and `excitations` are further choices, `levels` shares of the largest
    level, `rotor_speeds` [Hz] those at which sweeps can be made; `phases` are those of the multisines. `loads`:
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
    periods: Annotated[tuple[Annotated[int, Field(ge=2, le=MOST_PERIODS)], ...], Field(min_length=1)] = (7, 15)
    levels: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = (1.0, 0.4)
    rotor_speeds: Annotated[tuple[NonNegative, ...], Field(min_length=1)] = (0.0,)
    excitations: Annotated[tuple[Excitation, ...], Field(min_length=1)] = ("multisine",)
    phases: Phases = "schroeder"
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
        for name in ("periods", "levels", "rotor_speeds", "excitations", "bands"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                raise ValueError(f"`{name}` has a value twice")
        return self


class RecordSettings(FrozenModel):
    """Band [Hz], sample rate [Hz] and period [s] of the sweeps."""

    band: tuple[Positive, Positive]
    sample_rate: Positive
    period: Positive


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
    if max(hall.periods) * period * sample_rate > MOST_SAMPLES:
        fault = f"{max(hall.periods)} periods of {period:g} s are more than {MOST_SAMPLES} samples"
        raise UserError(fault, place="periods", remedy="Give fewer `periods` or a shorter `period`")
    fastest = max(hall.rotor_speeds)
    if fastest >= sample_rate / 2.0:
        fault = f"the rotor speed {fastest:g} Hz is not below half of the sample rate {sample_rate:g} Hz"
        raise UserError(fault, place="rotor_speeds", remedy="Give lower speeds or a higher `sample_rate`")
    return RecordSettings(band=band, sample_rate=sample_rate, period=period)


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


def _whole_samples(period: float, sample_rate: float) -> float:
    """A period of a whole, even number of samples."""
    return 2.0 * max(round(0.5 * period * sample_rate), 2) / sample_rate
