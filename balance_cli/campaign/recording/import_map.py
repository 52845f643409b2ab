"""The map of an import: which channel of a foreign file is which of ours, and which run each file is."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE
from balance_cli.campaign.rig.declared_values import (
    FrozenModel,
    Name,
    NonNegative,
    Number,
    Positive,
    Vector,
    name_as_mapping,
)

Component = Literal["Fx", "Fy", "Fz", "Mx", "My", "Mz"]
Sign = Annotated[Literal[1, -1], Field()]
Row = Annotated[int, Field(ge=1, le=100_000)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Rate = Annotated[Positive, Field(le=LARGEST_MAGNITUDE)]


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str | int | float) else value


def _component_as_mapping(value: object) -> object:
    return {"component": value} if isinstance(value, str) else value


def _channel_as_mapping(value: object) -> object:
    return {"channel": value} if isinstance(value, str) else value


class TextSettings(FrozenModel):
    """How text files are read, where it is not to be found out; rows count from 1."""

    separator: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] | None = None
    name_row: Row | None = None
    unit_row: Row | None = None
    first_row: Row | None = None
    encoding: Annotated[str, Field(min_length=1, max_length=40)] | None = None


class _Scaled(FrozenModel):
    """A quantity is sign times scale times (the file's value less `offset`), in `unit` (default: that of the file)."""

    unit: Annotated[str, Field(min_length=1, max_length=40)] | None = None
    sign: Sign = 1
    scale: Number = 1.0
    offset: Number = 0.0

    @model_validator(mode="after")
    def _check_scale(self) -> _Scaled:
        if self.scale == 0.0:
            raise ValueError("`scale` is zero")
        return self


class MappedExcitation(_Scaled):
    """A channel of the file that is the supply of a bridge, and the `nominal` supply [V] of its sensitivity."""

    channel: Name
    nominal: Positive


class MappedChannel(_Scaled):
    """A channel of the file that is the channel `name` of the geometry, in volts.

    With `excitation` it is the ratio to the measured supply of its bridge, times the nominal one.
    """

    name: Name
    excitation: MappedExcitation | None = None


class MappedLoad(_Scaled):
    """A channel of the file that is a hub load."""

    component: Component


class MappedAngle(_Scaled):
    """A channel of the file that is an attitude angle, in deg by default."""

    angle: Literal["pitch", "roll"]


class MappedPointKind(FrozenModel):
    """A column of the file that says what kind of load point each row is, and its `words` for the kinds of ours."""

    channel: Name
    words: dict[str, Literal["tare", "load", "repeat", "check"]] = Field(default_factory=dict)


class MappedTemperature(_Scaled):
    """A channel of the file that is a temperature, in degC by default."""

    name: Name


class MappedLoadPoint(_Scaled):
    """A force at a point other than the hub: its channel in the file, position [m] and direction in rig axes."""

    channel: Name
    name: Name | None = None
    position: Vector
    direction: Vector

    @model_validator(mode="after")
    def _check_direction(self) -> MappedLoadPoint:
        if not any(self.direction):
            raise ValueError("`direction` has no length")
        return self


class TachometerFilter(FrozenModel):
    """The analog Butterworth low-pass that the tachometer passed before it was sampled."""

    order: Annotated[int, Field(ge=1, le=20)]
    cutoff: Positive


class MappedRotor(FrozenModel):
    """The rotor reference: the tachometer's channel, and how its pulses are found."""

    channel: Name
    kind: Literal["pulses", "counts", "times"] = "pulses"
    level: Number | None = None
    hysteresis: NonNegative | None = None
    slope: Literal["auto", "rising", "falling"] = "auto"
    pulses_per_revolution: Count = 1
    index: Literal["none", "gap", "wide"] = "none"
    counts_per_revolution: Positive | None = None
    offset_deg: Annotated[Number, Field(ge=-360, le=360)] = 0.0
    delay: Annotated[Number, Field(ge=-1, le=1)] = 0.0
    filter: TachometerFilter | None = None
    smooth: bool = True

    @model_validator(mode="after")
    def _check_kind(self) -> MappedRotor:
        if self.kind == "counts" and self.counts_per_revolution is None:
            raise ValueError("`kind: counts` needs `counts_per_revolution` (360 for an angle in degrees)")
        if self.index == "gap" and self.pulses_per_revolution < 3:
            raise ValueError("`index: gap` needs `pulses_per_revolution` of at least 3, the missing pulse among them")
        return self


class MappedRun(FrozenModel):
    """What the runs are whose files fit the pattern `file`; `{words}` of the pattern can be used in the texts."""

    file: Annotated[str, Field(min_length=1, max_length=300)]
    run: Name = "{stem}"
    kind: Literal["static", "zero", "sweep", "check", "wind"]
    trim: Name | None = None
    excited: Annotated[tuple[str, ...], BeforeValidator(_as_list)] = ()
    excitation: Name | None = None
    level: Annotated[tuple[Positive, ...], BeforeValidator(_as_list)] = ()
    period: Positive | None = None
    rotor_speed: NonNegative | None = None
    note: Annotated[str, Field(max_length=10_000)] | None = None
    recorded: Name | None = None
    channels: dict[str, Annotated[MappedChannel | None, BeforeValidator(name_as_mapping)]] = Field(default_factory=dict)
    loads: dict[str, Annotated[MappedLoad | None, BeforeValidator(_component_as_mapping)]] = Field(default_factory=dict)


class ImportMap(FrozenModel):
    """A map, as declared in YAML."""

    format: Literal["balance-import/1"]
    rig: Name
    text: TextSettings = TextSettings()
    time: Name | None = None
    time_unit: Literal["s", "ms", "us", "ns", "min", "h", "d"] | None = None
    sample_rate: Rate | None = None
    resample: Rate | None = None
    channels: dict[str, Annotated[MappedChannel, BeforeValidator(name_as_mapping)]]
    loads: dict[str, Annotated[MappedLoad, BeforeValidator(_component_as_mapping)]] = Field(default_factory=dict)
    series: Name | None = None
    point_kind: Annotated[MappedPointKind, BeforeValidator(_channel_as_mapping)] | None = None
    attitude: dict[str, MappedAngle] = Field(default_factory=dict)
    temperature: dict[str, Annotated[MappedTemperature, BeforeValidator(name_as_mapping)]] = Field(default_factory=dict)
    load_points: tuple[MappedLoadPoint, ...] = ()
    rotor: MappedRotor | None = None
    rotor2: MappedRotor | None = None
    runs: Annotated[tuple[MappedRun, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self) -> ImportMap:
        return self.with_checked_names()

    def with_checked_names(self) -> ImportMap:
        """Return the map. Raises ValueError where keys contradict each other."""
        if not self.channels:
            raise ValueError("`channels` has no entries")
        _refuse_repeats("channel", [channel.name for channel in self.channels.values()])
        _refuse_repeats("component", [load.component for load in self.loads.values()])
        _refuse_repeats("angle", [angle.angle for angle in self.attitude.values()])
        _refuse_repeats("temperature", [sensor.name for sensor in self.temperature.values()])
        if len(self.attitude) == 1:
            raise ValueError("`attitude` needs both pitch and roll")
        if self.time is not None and self.sample_rate is not None:
            raise ValueError("give either `time` or `sample_rate`, not both")
        if self.rotor2 is not None and self.rotor is None:
            raise ValueError("`rotor2` needs `rotor`")
        return self

    def for_run(self, entry: MappedRun) -> ImportMap:
        """The map with the channels and loads of an entry in place of its own; those that are null are left out.

        Raises ValueError where two channels of the file are then the same channel or component, or none is left.
        """
        changes = {
            field: {
                name: mapped
                for name, mapped in {**getattr(self, field), **getattr(entry, field)}.items()
                if mapped is not None
            }
            for field in ("channels", "loads")
            if getattr(entry, field)
        }
        return self.model_copy(update=changes).with_checked_names() if changes else self


def _refuse_repeats(what: str, names: list[str]) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(
            f"two channels of the file are the {what} `{repeated[0]}`; those of different files belong under "
            "`channels` or `loads` of the entries of `runs` that have them"
        )
