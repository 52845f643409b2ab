"""All effects of a simulated rig, in the order in which they act."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import fields
from typing import Any, get_type_hints

from balance_cli.campaign.rig.declared_values import LARGEST_EFFECT_PARAMETER
from balance_cli.io.errors import UserError
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.extensions.cells import (
    CellDashpot,
    CellMisalignment,
    CellPosition,
    StructuralDamping,
    TransverseStiffness,
    ViscousDamping,
)
from balance_cli.simulation.extensions.loads import (
    ExciterLowPass,
    ExciterMass,
    ExciterMisalignment,
    ExciterPosition,
    ExciterStiffness,
    LoadDelay,
    LoadGain,
    LoadOffset,
    WeightMisalignment,
)
from balance_cli.simulation.extensions.nonlinear_cells import (
    AsymmetricDamping,
    AsymmetricFriction,
    CubicStiffness,
    DryFriction,
    FreePlay,
    QuadraticDamping,
    QuadraticStiffness,
    StribeckFriction,
)
from balance_cli.simulation.extensions.signals import (
    ChannelGain,
    ChannelNonlinearity,
    ChannelOffset,
    Crosstalk,
    HighPass,
    LowPass,
    MainsPickup,
    Saturation,
    TimeDelay,
)
from balance_cli.simulation.extensions.structure import (
    AddedMass,
    GravityStiffness,
    GyroscopicCoupling,
    MastBending,
    ParallelDashpot,
    ParallelStiffness,
    SupportFlexibility,
)

_EXTENSION_CLASSES: tuple[type[Extension], ...] = (
    SupportFlexibility,
    MastBending,
    AddedMass,
    GravityStiffness,
    GyroscopicCoupling,
    ParallelStiffness,
    ParallelDashpot,
    CellMisalignment,
    CellPosition,
    TransverseStiffness,
    CellDashpot,
    ViscousDamping,
    StructuralDamping,
    CubicStiffness,
    QuadraticStiffness,
    FreePlay,
    DryFriction,
    StribeckFriction,
    AsymmetricFriction,
    QuadraticDamping,
    AsymmetricDamping,
    ExciterMass,
    ExciterStiffness,
    ExciterLowPass,
    ExciterMisalignment,
    ExciterPosition,
    WeightMisalignment,
    LoadGain,
    LoadDelay,
    LoadOffset,
    ChannelGain,
    LowPass,
    HighPass,
    TimeDelay,
    Crosstalk,
    Saturation,
    ChannelNonlinearity,
    MainsPickup,
    ChannelOffset,
)
EXTENSIONS: dict[str, type[Extension]] = {kind.name: kind for kind in _EXTENSION_CLASSES}


def parameter_names(kind: type[Extension]) -> tuple[str, ...]:
    """Names of an effect's parameters."""
    return tuple(item.name for item in fields(kind) if item.name != "where")


def _nearest(name: str, known: Iterable[str]) -> str:
    known = tuple(known)
    close = difflib.get_close_matches(name, known, 1, 0.0)
    return f"Did you mean `{close[0]}`? Known: {', '.join(known)}" if close else f"Known: {', '.join(known) or 'none'}"


def extension(name: str, where: Iterable[str] = (), **parameters: float | str) -> Extension:
    """The extension of this name, at these places. Raises UserError for an unknown effect or parameter."""
    if name not in EXTENSIONS:
        raise UserError(f"there is no effect `{name}` to simulate", place="effects", remedy=_nearest(name, EXTENSIONS))
    kind = EXTENSIONS[name]
    known = parameter_names(kind)
    for parameter in parameters:
        if parameter not in known:
            fault = f"`{name}` has no parameter `{parameter}`"
            raise UserError(fault, place="effects", remedy=_nearest(parameter, known))
    if known and not parameters:
        fault, remedy = f"`{name}` has no parameter", f"Give it one of {', '.join(known)}"
        raise UserError(fault, place="effects", remedy=remedy)
    values: dict[str, Any] = {key: _value(kind, key, value) for key, value in parameters.items()}
    return kind(where=tuple(where), **values)


def _value(kind: type[Extension], parameter: str, value: float | str) -> float | str:
    if get_type_hints(kind)[parameter] is str:
        return str(value)
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not abs(number) <= LARGEST_EFFECT_PARAMETER:
        fault = f"`{parameter}` of `{kind.name}` is `{value}`, not a number of at most {LARGEST_EFFECT_PARAMETER:g}"
        raise UserError(fault, place="effects", remedy="Give a number in SI units")
    return number
