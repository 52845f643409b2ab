"""A recorded channel as a geometry declares it: what it measures, and its own dynamics."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from balance_cli.campaign.rig.declared_values import (
    MOST_PARTS,
    SMALLEST_VALUE,
    Array,
    FrozenModel,
    Name,
    Number,
    Positive,
    Vector,
)
from balance_cli.io.errors import UserError
from balance_cli.io.units import NUMBER, RATIO, VOLTAGE, parse_unit


class Accelerometer(FrozenModel):
    """An accelerometer at `position` [m], sensitive along `axis`, on the metric or the non-metric side."""

    position: Vector
    axis: Vector
    side: Literal["metric", "non-metric"] = "metric"

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: Vector) -> Vector:
        if float(np.linalg.norm(axis)) == 0.0:
            raise ValueError("`axis` has no length")
        return axis

    @property
    def direction(self) -> Array:
        """Unit vector (3,) along the axis."""
        axis = np.asarray(self.axis, float)
        return np.asarray(axis / np.linalg.norm(axis), float)


class Channel(FrozenModel):
    """A recorded channel: what it measures, its sensitivity and its own first-order dynamics.

    It measures a `cell`, the weighted sum of several `cells`, a torque meter or an `accelerometer`. Its sensitivity
    is in V/N, V/(N m) or V/(m/s2). A channel without any of them, such as a bridge of an internal balance, can be
    calibrated only. `unit` is that of its readings: V (the default), a ratio to the excitation (mV/V), or a number
    (counts).
    """

    name: Name
    cell: str | None = None
    cells: Annotated[dict[Name, Number], Field(min_length=1, max_length=MOST_PARTS)] | None = None
    torque_meter: bool | Name = False
    accelerometer: Accelerometer | None = None
    sensitivity: Number = 1.0
    unit: str | None = None
    lowpass: Positive | None = None
    time_constant: Positive | None = None
    range: Positive | None = None

    @model_validator(mode="after")
    def _check_one_source(self) -> Channel:
        sources = (
            self.cell is not None,
            self.cells is not None,
            bool(self.torque_meter),
            self.accelerometer is not None,
        )
        if sum(sources) > 1:
            raise ValueError(
                "give either `cell: NAME` or one of `cells: {NAME: WEIGHT}`, `torque_meter: true`, `accelerometer`"
            )
        if self.cells is not None and min(map(abs, self.cells.values())) <= SMALLEST_VALUE:
            raise ValueError(f"a weight in `cells` is zero, or below {SMALLEST_VALUE:g}")
        if abs(self.sensitivity) <= SMALLEST_VALUE:
            raise ValueError(f"`sensitivity` is zero, or below {SMALLEST_VALUE:g}")
        if self.measures_mechanics and "sensitivity" not in self.model_fields_set:
            raise ValueError("`sensitivity` is missing")
        return self

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, text: str | None) -> str | None:
        try:
            return None if text is None else parse_unit(text, VOLTAGE, RATIO, NUMBER).dimension
        except UserError as error:
            raise ValueError(f"{error.fault} ({error.remedy})") from None

    @property
    def reading_unit(self) -> str:
        """Base unit of the readings: `V`, `V/V` or `1`."""
        return self.unit or VOLTAGE

    @property
    def cell_weights(self) -> dict[str, float]:
        """Weight of each cell whose force the channel reads; empty for a torque meter or an accelerometer."""
        if self.cells is not None:
            return dict(self.cells)
        return {} if self.cell is None else {self.cell: 1.0}

    @property
    def source(self) -> str:
        """What the channel measures, in words that are equal for channels of one source; empty where it is unknown."""
        if self.torque_meter:
            return "torque meter" if self.torque_meter is True else f"torque meter {self.torque_meter}"
        if self.accelerometer is not None:
            return f"accelerometer {self.accelerometer.position} {self.accelerometer.axis} {self.accelerometer.side}"
        if self.cells is not None:
            return "cells " + " + ".join(f"{weight:g} {name}" for name, weight in sorted(self.cells.items()))
        return "" if self.cell is None else f"cell {self.cell}"

    @property
    def sensitivity_unit(self) -> str:
        """Unit of the sensitivity."""
        if self.accelerometer is not None:
            return "V/(m/s2)"
        return "V/(N m)" if self.torque_meter else "V/N"

    @property
    def measures_mechanics(self) -> bool:
        """Whether the channel measures a declared part of the rig: cells, a torque meter, or an acceleration."""
        return bool(self.source)

    @property
    def measures_dc(self) -> bool:
        """Whether the channel passes a constant load: no high-pass, and no accelerometer, which rests under it."""
        return self.time_constant is None and self.accelerometer is None
