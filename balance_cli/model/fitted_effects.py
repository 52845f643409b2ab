"""Identified effects: the values of their parameters in a model, and the geometry that declares them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.model.effects import EffectParameter, Where
from balance_cli.model.placed_effects import PlacedEffect, declared_effects, effect_label


@dataclass(frozen=True)
class FittedParameter:
    """An identified parameter of an effect; sigma is 0 where it was held, infinite where it is unidentifiable.

    `interval`: the 95 % interval by the likelihood, where sigma does not describe it.
    """

    name: str
    value: float
    sigma: float
    unit: str
    interval: tuple[float, float] | None = None


@dataclass(frozen=True)
class FittedEffect:
    """An effect with its identified parameters; `choice` is the name of a parameter that is a word, and the word."""

    name: str
    where: Where
    parameters: tuple[FittedParameter, ...]
    choice: tuple[str, str] | None = None

    @property
    def label(self) -> str:
        """NAME@PLACE,PLACE as on the command line."""
        return effect_label(self.name, self.where if self.choice is None else (*self.where, self.choice[1]))


def fitted_effects(
    geometry: Geometry, names: Sequence[str], values: Iterable[float], sigma: Iterable[float]
) -> tuple[FittedEffect, ...]:
    """The effects of a geometry with values and standard deviations from the parameters of a model, by their names."""
    fitted = dict(zip(names, zip(values, sigma, strict=True), strict=True))

    def describe_parameter(entry: PlacedEffect, parameter: EffectParameter) -> FittedParameter:
        value, spread = (float(number) for number in fitted[entry.full_name(parameter)])
        sigma = parameter.physical_sigma(value, spread)
        return FittedParameter(parameter.name, parameter.physical_value(value), sigma, parameter.unit)

    def describe_effect(entry: PlacedEffect) -> FittedEffect:
        where, choice = _split_choice(entry)
        parameters = tuple(describe_parameter(entry, parameter) for parameter in entry.parameters)
        return FittedEffect(entry.effect.name, where, parameters, choice)

    return tuple(describe_effect(entry) for entry in declared_effects(geometry))


def _split_choice(entry: PlacedEffect) -> tuple[Where, tuple[str, str] | None]:
    """The place of an effect without its choice, and the choice."""
    choice = entry.effect.choice
    return (entry.where, None) if choice is None else (entry.where[:-1], (choice.name, entry.where[-1]))


def declare_fitted_effects(geometry: Geometry, names: Sequence[str], values: Sequence[float]) -> Geometry:
    """The geometry with its effects declared at these parameter values; an infinite value is its null, and left out."""
    effects = tuple(
        DeclaredEffect(
            name=entry.name,
            where=entry.where,
            parameters={
                **{item.name: item.value for item in entry.parameters if np.isfinite(item.value)},
                **dict([entry.choice] if entry.choice else []),
            },
        )
        for entry in fitted_effects(geometry, names, values, np.zeros(len(values)))
    )
    return geometry.model_copy(update={"effects": effects})
