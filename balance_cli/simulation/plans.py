"""Plans of simulated campaigns: the kinds of runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.declared_values import FrozenModel, Name, NonNegative, Positive, Vector
from balance_cli.simulation.noise import DeclaredNoise

Component = Literal["Fx", "Fy", "Fz", "Mx", "My", "Mz"]
Excitation = Literal["multisine", "random", "sine-sweep", "stepped", "impact"]
Phases = Literal["random", "schroeder", "low-crest"]
LoadValues = Mapping[Component, float]
assert get_args(Component) == COMPONENTS

HARMONICS = 8
MOST_SAMPLES = 2_000_000
"""Of a simulated record of any rig: forty minutes at 800 Hz. `campaign.MOST_MEMORY` allows fewer on most rigs."""
LONGEST_CONTACT = 0.05
"""Of a hit of a hammer over the time between two: what is longer is no impact."""
MOST_STEPS = 10_000
"""Of a static run, of each component."""


class Plan(FrozenModel):
    """Base of all runs; the name is also that of a file in the output folder."""

    run: Annotated[str, Field(min_length=1, max_length=200)]

    @model_validator(mode="after")
    def _check_name(self) -> Plan:
        if "/" in self.run or not self.run.isprintable() or not self.run.strip(" .") or len(self.run.encode()) > 200:
            raise ValueError(f"the run name {self.run!r} is not the name of a file")
        return self


class StaticPlan(Plan):
    """Each component up to `largest`, through zero and back, in `steps` steps, about the `trim_loads`; or `points`."""

    kind: Literal["static"] = "static"
    trim: str = "bare"
    trim_loads: LoadValues = Field(default_factory=dict)
    largest: Mapping[Component, Positive] = Field(default_factory=dict)
    steps: Annotated[int, Field(ge=1, le=MOST_STEPS)] = 5
    points: Annotated[tuple[LoadValues, ...], Field(max_length=MOST_STEPS)] | None = None

    @model_validator(mode="after")
    def _check_loads(self) -> StaticPlan:
        if bool(self.largest) == bool(self.points):
            raise ValueError("give either `largest` or `points`")
        return self


class RecordPlan(Plan):
    """Base of the sampled runs."""

    sample_rate: Positive = 800.0
    rotor_speed: NonNegative = 0.0


def _check_record(plan: ZeroPlan | SweepPlan | RotorPlan) -> None:
    """Raise ValueError where the record of a plan has too few or too many samples, or too few for its rotor."""
    samples = plan.duration * plan.sample_rate
    if not 2.0 <= samples <= MOST_SAMPLES:
        raise ValueError(f"its duration times `sample_rate` is {samples:.3g} samples, not 2 to {MOST_SAMPLES}")
    if plan.rotor_speed >= plan.sample_rate / 2.0:
        raise ValueError(f"`rotor_speed` {plan.rotor_speed:g} Hz is not below half of `sample_rate`")


def _check_band(key: str, band: tuple[float, float], sample_rate: float) -> None:
    """Raise ValueError unless a band [Hz] rises and ends below half the sample rate."""
    if not band[0] < band[1] < sample_rate / 2.0:
        shown = f"`{key}` {band[0]:g} to {band[1]:g} Hz"
        raise ValueError(f"{shown} should rise and end below half of `sample_rate` {sample_rate:g} Hz")


class ZeroPlan(RecordPlan):
    """A record without loads."""

    kind: Literal["zero"] = "zero"
    duration: Positive = 10.0

    @model_validator(mode="after")
    def _check(self) -> ZeroPlan:
        _check_record(self)
        return self


class ForcePoint(FrozenModel):
    """A named point of the metric side beside the hub at which one force acts: `position` [m] and `direction`."""

    name: Name
    position: Vector
    direction: Vector

    @model_validator(mode="after")
    def _check(self) -> ForcePoint:
        if not any(self.direction):
            raise ValueError("`direction` has no length")
        return self

    def wrench(self, hub: Vector) -> NDArray[np.float64]:
        """Hub loads (6,) per newton of the force."""
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        return np.concatenate([direction, np.cross(np.array(self.position) - np.array(hub), direction)])

    @property
    def component(self) -> Component:
        """The force that is driven most."""
        return get_args(Component)[int(np.argmax(np.abs(self.direction)))]  # type: ignore[no-any-return]


class SweepPlan(RecordPlan):
    """Exciters on one or more components; `level` is the rms of each [N, N m], `band` in Hz.

    `periods` periods of `period` s. Several components excited at once by multisines get interleaved lines (each its
    own) or, without `interleaved`, all lines each. Their phases are random, or with `schroeder` and `low-crest` those
    of a small peak. `power`: relative power of a multisine's line from each frequency [Hz] on. `steady`: mean loads.
    A random excitation has no period, but the same duration. `impact` is a hammer: a half sine of `contact` s in each
    period. With a `point` the excitation is one force there, and `excited` the component that it drives most.
    """

    kind: Literal["sweep"] = "sweep"
    excited: Annotated[tuple[Component, ...], Field(min_length=1)]
    level: tuple[Positive, ...]
    excitation: Excitation = "multisine"
    period: Positive = 4.0
    periods: Annotated[int, Field(ge=1)] = 7
    band: tuple[Positive, Positive] = (2.0, 150.0)
    steps: Annotated[int, Field(ge=2)] = 149
    interleaved: bool = True
    phases: Phases = "random"
    power: Annotated[tuple[tuple[Positive, Positive], ...], Field(min_length=1)] | None = None
    steady: LoadValues | None = None
    contact: Positive | None = None
    point: ForcePoint | None = None

    @model_validator(mode="after")
    def _check(self) -> SweepPlan:
        if len(set(self.excited)) < len(self.excited):
            raise ValueError("`excited` names a component twice")
        if len(self.level) != len(self.excited):
            raise ValueError("give one `level` for each of `excited`")
        _check_record(self)
        _check_band("band", self.band, self.sample_rate)
        if self.phases != "random" and len(self.excited) > 1 and not self.interleaved:
            raise ValueError(f"with `phases: {self.phases}` components excited together need `interleaved` lines")
        self._check_excitation()
        if self.period * self.sample_rate < 2.0:
            raise ValueError(f"`period` {self.period:g} s is shorter than two samples")
        if self.excitation == "multisine" and self._lines < len(self.excited):
            raise ValueError(f"`band` holds {self._lines} multiples of 1/`period`, fewer than components `excited`")
        return self

    def _check_excitation(self) -> None:
        """Raise ValueError where settings do not belong to the excitation."""
        if self.power is not None:
            edges = [edge for edge, _ in self.power]
            if self.excitation != "multisine" or edges != sorted(set(edges)):
                raise ValueError("`power` is that of a multisine, and its frequencies should rise")
        if (self.excitation == "impact") != (self.contact is not None):
            raise ValueError("`contact` [s] belongs to `excitation: impact`, and to nothing else")
        if self.contact is not None and self.contact > LONGEST_CONTACT * self.period:
            raise ValueError(f"`contact` {self.contact:g} s is more than a twentieth of the time between two hits")
        if self.point is not None and self.steady:
            raise ValueError("`steady` loads act at the hub: give them without a `point`")
        if self.point is not None and (len(self.excited) > 1 or self.excited[0] != self.point.component):
            raise ValueError(f"with this `point`, `excited` is {self.point.component}: what the force drives most")

    @property
    def _lines(self) -> int:
        """Multiples of 1/period within the band."""
        first, last = (edge * self.period for edge in self.band)
        return math.floor(last + 1e-9) - max(math.ceil(first - 1e-9), 1) + 1

    @property
    def duration(self) -> float:
        """Length of the record [s]."""
        return self.period * self.periods


class LoadStep(FrozenModel):
    """A change of the mean loads (a collective step) at `time`, over `duration` [s]."""

    time: Positive
    duration: Positive = 0.8
    loads: LoadValues


class RotorPlan(RecordPlan):
    """A turning rotor: loads known (`check`) or not recorded (`wind`).

    `harmonics`: amplitudes [N, N m] of harmonics 1, 2 ... of a component; their phases are random, and the amplitudes
    vary by `scatter` (relative). `steady`: mean loads; `turbulence`: rms of random loads within `turbulence_band` [Hz];
    `drift` of the speed (relative); a `step` of the mean loads. Without `pulses` the loads are the same, but the record
    is one at rest: loads of `rotor_speed` and its multiples, as those of a cutting tool, without a rotor.
    """

    kind: Literal["check", "wind"] = "check"
    rotor_speed: Positive
    duration: Positive = 20.0
    harmonics: Mapping[Component, tuple[NonNegative, ...]] = Field(default_factory=dict)
    scatter: NonNegative = 0.3
    steady: LoadValues = Field(default_factory=dict)
    turbulence: Mapping[Component, NonNegative] = Field(default_factory=dict)
    turbulence_band: tuple[Positive, Positive] = (0.5, 100.0)
    drift: Annotated[float, Field(ge=0, lt=1)] = 0.0
    drift_period: Positive = 23.0
    step: LoadStep | None = None
    pulses: bool = True

    @model_validator(mode="after")
    def _check(self) -> RotorPlan:
        _check_record(self)
        revolutions = self.duration * self.rotor_speed * (1.0 - self.drift)
        if revolutions <= 2.0:
            shown = f"{self.duration:g} s is {revolutions:.3g} revolutions"
            raise ValueError(f"`duration` {shown}, two pulses need more than 2")
        if self.turbulence:
            _check_band("turbulence_band", self.turbulence_band, self.sample_rate)
        return self


SampledPlan = ZeroPlan | SweepPlan | RotorPlan
AnyPlan = StaticPlan | SampledPlan


class CampaignPlan(FrozenModel):
    """The runs of a campaign, in their order; `balance plan` adds rig, noise, and a forecast that is not simulated."""

    format: Literal["balance-plan/1"] | None = None
    rig: Name | None = None
    noise: DeclaredNoise | None = None
    forecast: Mapping[str, Any] | None = None
    runs: Annotated[tuple[Annotated[AnyPlan, Field(discriminator="kind")], ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_unique_names(self) -> CampaignPlan:
        names = [plan.run for plan in self.runs]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"run names are not unique: {', '.join(repeated)}")
        return self

    def select_runs(self, names: Sequence[str]) -> CampaignPlan:
        """Only the runs of these names."""
        return self.model_copy(update={"runs": tuple(plan for plan in self.runs if plan.run in names)})
