"""Types of declared values: numbers with limits, names, vectors, and the base of all parts of a geometry."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

LARGEST_VALUE = 1e15
"""Of any number of a geometry or a plan, in SI units: far beyond any rig, and its fourth power is still finite."""
LARGEST_EFFECT_PARAMETER = 1e30
"""The cubic stiffness of a cell whose elongations are nanometers is 1e24 N/m3 where a tenth of 1e6 N is cubic."""
MOST_PARTS = 500
"""Bodies, cells or channels; no rig has so many, and the equations of so many are still solved in seconds."""

SMALLEST_VALUE = 1e-15
"""Of a number that must be positive, or divides readings; the fourth power of its reciprocal is still finite."""


def _refuse_bool(value: object) -> object:
    """Refuse what Python, but no engineer, takes for a number."""
    if isinstance(value, bool):
        raise ValueError("should be a number, not true or false")
    return value


Name = Annotated[str, Field(min_length=1, max_length=200)]
Number = Annotated[float, BeforeValidator(_refuse_bool), Field(ge=-LARGEST_VALUE, le=LARGEST_VALUE)]
Vector = tuple[Number, Number, Number]
EffectNumber = Annotated[
    float, BeforeValidator(_refuse_bool), Field(ge=-LARGEST_EFFECT_PARAMETER, le=LARGEST_EFFECT_PARAMETER)
]
Positive = Annotated[float, BeforeValidator(_refuse_bool), Field(gt=SMALLEST_VALUE, le=LARGEST_VALUE)]
NonNegative = Annotated[float, BeforeValidator(_refuse_bool), Field(ge=0, le=LARGEST_VALUE)]
Array = NDArray[np.float64]


class FrozenModel(BaseModel):
    """Base of all parts: frozen, unknown keys refused, no infinities."""

    # A part is checked within the whole that is read: validators of the parts alone are not built.
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)


def name_as_mapping(value: object) -> object:
    """What is given by its name alone, in the form of what is given in full: `{name: NAME}`."""
    return {"name": value} if isinstance(value, str) else value
