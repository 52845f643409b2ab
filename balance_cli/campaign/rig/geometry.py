"""The rig as declared: YAML -> Geometry (`format: balance-geometry/1`), checked once, frozen afterwards."""

from __future__ import annotations

from collections.abc import Container
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.declared_values import (
    MOST_PARTS,
    Array,
    EffectNumber,
    FrozenModel,
    Name,
    NonNegative,
    Number,
    Positive,
    Vector,
    name_as_mapping,
)
from balance_cli.campaign.rig.load_component import LoadComponent
from balance_cli.campaign.rig.torque_meter import TorqueMeter
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural
from balance_cli.io.units import VOLTAGE


class Inertia(FrozenModel):
    """Inertia about the body's own center [kg m2]; products are positive integrals of xy dm."""

    xx: NonNegative
    yy: NonNegative
    zz: NonNegative
    xy: Number = 0.0
    xz: Number = 0.0
    yz: Number = 0.0

    def tensor(self) -> Array:
        """The inertia tensor (3, 3) [kg m2]: products enter with a minus sign."""
        return np.array(
            [[self.xx, -self.xy, -self.xz], [-self.xy, self.yy, -self.yz], [-self.xz, -self.yz, self.zz]], float
        )


class Body(FrozenModel):
    """A lumped mass: mass [kg], position of its center [m], inertia about that center."""

    name: Name
    mass: Positive
    position: Vector
    inertia: Inertia


class Cell(FrozenModel):
    """A load cell: acts along `axis` at `position` [m]; stiffness [N/m], or cell and beam in series.

    Without either the geometry can be calibrated, but has no mechanics.
    """

    name: Name
    position: Vector
    axis: Vector
    stiffness: Positive | None = None
    series: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    full_range: Positive

    @model_validator(mode="after")
    def _check_one_stiffness(self) -> Cell:
        if self.stiffness is not None and self.series is not None:
            raise ValueError("give either `stiffness` or `series`, not both")
        if float(np.linalg.norm(self.axis)) == 0.0:
            raise ValueError("`axis` has no length")
        return self

    @property
    def effective_stiffness(self) -> float:
        """Stiffness along the axis [N/m]; springs in series add their compliances (paper, section 3)."""
        if self.stiffness is not None:
            return self.stiffness
        if self.series is None:
            raise UserError(f"cell `{self.name}` has no stiffness", place="cells", remedy="Add `stiffness` or `series`")
        return 1.0 / sum(1.0 / k for k in self.series)

    @property
    def direction(self) -> Array:
        """Unit vector (3,) along the axis."""
        axis: Array = np.asarray(self.axis, float)
        unit: Array = axis / np.linalg.norm(axis)
        return unit


class AnalogFilter(FrozenModel):
    """The anti-alias filter of the acquisition: Butterworth low-pass of `order` at `cutoff` [Hz]."""

    type: Literal["butterworth"]
    order: Annotated[int, Field(ge=1, le=20)]
    cutoff: Positive


class Acquisition(FrozenModel):
    """The data acquisition: its anti-alias filter, the same in every channel and load signal.

    `groups`: by name, channels that share a box, and so one clock and one filter.
    """

    filter: AnalogFilter | None = None
    groups: dict[Name, Annotated[tuple[Name, ...], Field(min_length=1)]] = Field(default_factory=dict)

    @model_serializer(mode="wrap")
    def _leave_out_absent_groups(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without groups where none is declared, as before there were any."""
        plain: dict[str, Any] = serialize(self)
        return {key: value for key, value in plain.items() if value or key != "groups"}


class DeclaredLoadPoint(FrozenModel):
    """A point of the metric side at which forces act: `position` [m] and, where it is fixed, their `direction`."""

    position: Vector
    direction: Vector | None = None

    @model_validator(mode="after")
    def _check_direction(self) -> DeclaredLoadPoint:
        if self.direction is not None and float(np.linalg.norm(self.direction)) == 0.0:
            raise ValueError("`direction` has no length")
        return self


class Tolerances(FrozenModel):
    """Standard deviations of the declared values: relative, except `centre_of_gravity` in m; 0 means exact."""

    stiffness: NonNegative = 0.0
    mass: NonNegative = 0.0
    centre_of_gravity: NonNegative = 0.0
    inertia: NonNegative = 0.0
    damping_ratio: NonNegative = 0.0
    sensitivity: NonNegative = 0.0


class Rotor(FrozenModel):
    """The rotor: number of blades and nominal speed [Hz]."""

    blades: Annotated[int, Field(ge=1)]
    speed: Positive


class DeclaredEffect(FrozenModel):
    """An effect beyond the rigid plate: its name, its places, its parameters (a choice between words is a text)."""

    name: Name
    where: tuple[str, ...] = ()
    parameters: dict[str, EffectNumber | str] = Field(default_factory=dict)


class Geometry(FrozenModel):
    """A rotor balance as declared. Compared by content.

    `bodies`, stiffness of the cells and `damping_ratio` may be absent where the balance is only calibrated, and so may
    the cells themselves: `name`, `rig` and `channels` are enough.
    """

    format: Literal["balance-geometry/1"]
    name: Name
    rig: Name
    hub: Vector = (0.0, 0.0, 0.0)
    bodies: Annotated[tuple[Body, ...], Field(min_length=1, max_length=MOST_PARTS)] = ()
    cells: Annotated[tuple[Cell, ...], Field(min_length=1, max_length=MOST_PARTS)] = ()
    torque_meter: TorqueMeter | None = None
    torque_meters: Annotated[tuple[TorqueMeter, ...], Field(min_length=1, max_length=MOST_PARTS)] | None = None
    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=MOST_PARTS)]
    acquisition: Acquisition = Acquisition()
    damping_ratio: NonNegative | None = None
    tolerances: Tolerances = Tolerances()
    rotor: Rotor | None = None
    freedom: Annotated[tuple[Literal["x", "y", "z", "psi", "theta", "phi"], ...], Field(min_length=1)] = FREEDOMS  # type: ignore[assignment]
    effects: tuple[DeclaredEffect, ...] = ()
    components: (
        Annotated[tuple[Annotated[LoadComponent, BeforeValidator(name_as_mapping)], ...], Field(min_length=1)] | None
    ) = None
    rated_loads: dict[Name, Positive] | None = None
    load_points: dict[Name, DeclaredLoadPoint] | None = None

    @model_serializer(mode="wrap")
    def _leave_out_absent_parts(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the lists that a geometry for calibration alone does not have: they must not be empty in a file."""
        plain: dict[str, Any] = serialize(self)
        return {key: value for key, value in plain.items() if value or key not in ("bodies", "cells", "torque_meters")}

    def __repr__(self) -> str:
        cells, channels = plural(len(self.cells), "cell"), plural(len(self.channels), "channel")
        return f"Geometry {self.name} of rig {self.rig}: {cells}, {channels}"

    def reading_units(self, names: Container[str]) -> dict[str, str]:
        """Base unit of each of these channels that is not read in V."""
        return {
            channel.name: channel.reading_unit
            for channel in self.channels
            if channel.name in names and channel.reading_unit != VOLTAGE
        }

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of all channels, in declared order."""
        return tuple(channel.name for channel in self.channels)

    @property
    def shaft_meters(self) -> tuple[TorqueMeter, ...]:
        """All torque meters, those of one shaft from the hub to its end."""
        return (self.torque_meters or ()) if self.torque_meter is None else (self.torque_meter,)

    @property
    def modal_damping_ratio(self) -> float:
        """The damping ratio of every mode; raises UserError where it is not declared."""
        if self.damping_ratio is None:
            raise UserError("`damping_ratio` is missing", place="damping_ratio", remedy="Add it to the geometry")
        return self.damping_ratio

    @property
    def cell_names(self) -> tuple[str, ...]:
        """Names of all cells, in declared order."""
        return tuple(cell.name for cell in self.cells)
