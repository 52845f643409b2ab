"""Effects at their places: as declared, as parameters of a model, and as acting on its equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from balance_cli.effects import EFFECTS, Effect, EffectParameter, Where
from balance_cli.equations import Equations
from balance_cli.errors import UserError
from balance_cli.geometry import DeclaredEffect, Geometry
from balance_cli.jets import Jet
from balance_cli.model.parameters import ParameterSet


@dataclass(frozen=True)
class PlacedEffect:
    """An effect at one place, with its parameters there."""

    effect: Effect
    where: Where
    parameters: tuple[EffectParameter, ...]

    @property
    def label(self) -> str:
        """NAME@PLACE,PLACE as on the command line."""
        return f"{self.effect.name}@{','.join(self.where)}" if self.where else self.effect.name

    def full_name(self, parameter: EffectParameter) -> str:
        """Name of a parameter among all of a model: `channel-gain@x.strain.gain`."""
        return f"{self.label}.{parameter.name}"


def placed(name: str, where: Where, geometry: Geometry) -> PlacedEffect:
    """The effect of this name at this place. UserError where there is no such effect, or not there."""
    by_name = {effect.name: effect for effect in EFFECTS}
    if name not in by_name:
        near = get_close_matches(name, by_name, 1)
        raise UserError(
            f"there is no effect `{name}`",
            place="effect",
            remedy=f"Did you mean `{near[0]}`?" if near else f"There are: {', '.join(by_name)}",
        )
    effect = by_name[name]
    if where not in effect.places(geometry):
        there = "; ".join(",".join(place) or "no place" for place in effect.places(geometry))
        raise UserError(
            f"`{name}` has no place `{','.join(where)}`", place="effect", remedy=f"It can be at: {there or 'none here'}"
        )
    return PlacedEffect(effect, where, effect.parameters(geometry, where))


def declared_effects(geometry: Geometry) -> tuple[PlacedEffect, ...]:
    """The effects of a geometry, in the order in which they act."""
    found = [placed(item.name, item.where, geometry) for item in geometry.effects]
    order = [effect.name for effect in EFFECTS]
    return tuple(sorted(found, key=lambda item: order.index(item.effect.name)))


def effect_parameters(geometry: Geometry) -> ParameterSet:
    """Parameters of all declared effects: they start as declared and nothing more is known of them."""
    rows = [
        (one, parameter, _value(declared, parameter))
        for declared in geometry.effects
        for one in (placed(declared.name, declared.where, geometry),)
        for parameter in one.parameters
    ]
    return ParameterSet(
        names=tuple(one.full_name(parameter) for one, parameter, _ in rows),
        units=tuple(parameter.unit for _, parameter, _ in rows),
        value=np.array([value for *_, value in rows], float),
        sigma=np.full(len(rows), np.inf),
        scale=np.array([parameter.scale for _, parameter, _ in rows], float),
        lower=np.array([parameter.lower for _, parameter, _ in rows], float),
        upper=np.array([parameter.upper for _, parameter, _ in rows], float),
    )


def _value(declared: DeclaredEffect, parameter: EffectParameter) -> float:
    start = parameter.null if parameter.start is None else parameter.start
    return float(declared.parameters.get(parameter.name, start))


def with_effects(equations: Equations, geometry: Geometry, value: Mapping[str, Jet]) -> Equations:
    """The equations with every declared effect added, `value` holding all parameters of the model by name."""
    for one in declared_effects(geometry):
        values = {parameter.name: value[one.full_name(parameter)] for parameter in one.parameters}
        equations = one.effect.apply(equations, geometry, one.where, values)
    return equations


def declare(geometry: Geometry, names: Sequence[str], values: Sequence[float]) -> Geometry:
    """The geometry with its effects declared at these parameter values."""
    value = dict(zip(names, values, strict=True))
    effects = tuple(
        DeclaredEffect(
            name=one.effect.name,
            where=one.where,
            parameters={parameter.name: float(value[one.full_name(parameter)]) for parameter in one.parameters},
        )
        for one in declared_effects(geometry)
    )
    return geometry.model_copy(update={"effects": effects})


def add_effects(geometry: Geometry, words: Sequence[str]) -> Geometry:
    """The geometry with effects added as the command line names them: NAME[@PLACE[,PLACE]]."""
    added = []
    for word in words:
        name, _, where = word.partition("@")
        one = placed(name, tuple(part for part in where.split(",") if part), geometry)
        added.append(DeclaredEffect(name=one.effect.name, where=one.where))
    return geometry.model_copy(update={"effects": (*geometry.effects, *added)})
