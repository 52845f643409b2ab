"""Effects at their places: as declared in a geometry, as parameters of a model, and as terms of its equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.io.errors import UserError
from balance_cli.model import effects as library
from balance_cli.model.effects import Effect, EffectParameter, Where
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations
from balance_cli.model.parameters import ParameterSet

MOST_LISTED_PLACES = 20
"""More places than this are described in words: a longer list does not fit in an error message."""


def effect_label(name: str, where: Where) -> str:
    """NAME@PLACE,PLACE as on the command line."""
    return f"{name}@{','.join(where)}" if where else name


@dataclass(frozen=True)
class PlacedEffect:
    """An effect at one place, with its parameters there and their declared values.

    Where the effect has a choice, its word is the last name of `where`.
    """

    effect: Effect
    where: Where
    parameters: tuple[EffectParameter, ...]
    declared: Mapping[str, float | str]

    @property
    def label(self) -> str:
        """NAME@PLACE,PLACE as on the command line."""
        return effect_label(self.effect.name, self.where)

    def full_name(self, parameter: EffectParameter) -> str:
        """Name of a fitted parameter among all parameters of a model, as in `NAME@PLACE.gain`."""
        return f"{self.label}.{parameter.fitted_name}"

    def start(self, parameter: EffectParameter) -> float:
        """The fitted value at which a fit begins: the declared one, if there is one."""
        if parameter.name not in self.declared:
            return parameter.fitted_start
        return parameter.fitted_value(float(self.declared[parameter.name]))


def find_effect(name: str) -> Effect:
    """The effect of this name. Raises UserError where there is none."""
    by_name = {effect.name: effect for effect in library.EFFECTS}
    if name not in by_name:
        raise UserError(f"there is no effect `{name}`", place="effects", remedy=_nearest(name, tuple(by_name)))
    return by_name[name]


def place_effect(name: str, where: Sequence[str], geometry: Geometry) -> PlacedEffect:
    """The effect of this name at this place. Raises UserError where there is no such effect or place."""
    effect = find_effect(name)
    return _at_place(effect, _resolve_place(effect, tuple(where), effect.places(geometry)), geometry)


def _at_place(effect: Effect, where: Where, geometry: Geometry) -> PlacedEffect:
    return PlacedEffect(effect, where, effect.parameters(geometry, where), {})


def declare_effect(placed_effect: PlacedEffect, fitted: Mapping[str, float]) -> DeclaredEffect:
    """The effect declared at these fitted values, by fitted names; an infinite value is its null, and is left out."""
    values = {item.name: item.physical_value(fitted[item.fitted_name]) for item in placed_effect.parameters}
    finite = {name: float(value) for name, value in values.items() if abs(value) != float("inf")}
    return DeclaredEffect(name=placed_effect.effect.name, where=placed_effect.where, parameters=finite)


def _resolve_place(effect: Effect, where: Where, places: Sequence[Where]) -> Where:
    """The place as the effect names it; the order of the names matters only where the effect has both orders."""
    if where in places:
        return where
    if effect.choice and (*where, effect.choice.words[0]) in places:
        return (*where, effect.choice.words[0])
    same = [place for place in places if sorted(place) == sorted(where)]
    if same:
        return same[0]
    words = tuple(",".join(place) or "no place" for place in places)
    fault = f"`{effect.name}` has no place `{','.join(where)}`" if where else f"`{effect.name}` needs a place"
    remedy = (
        _nearest(",".join(where), words) if len(words) <= MOST_LISTED_PLACES else _nearest_of_many(effect, where, words)
    )
    raise UserError(fault, place="effects", remedy=remedy if places else "It has no place in this rig")


def _nearest(word: str, known: Sequence[str]) -> str:
    near = get_close_matches(word, known, 1)
    listed = f"There are: {', '.join(known)}"
    return f"Did you mean `{near[0]}`? {listed}" if near else listed


def _nearest_of_many(effect: Effect, where: Where, known: Sequence[str]) -> str:
    near = get_close_matches(",".join(where), known, 1, 0.0)
    guess = f"Did you mean `{near[0]}`? " if near and where else ""
    return f"{guess}Its place: {effect.place}"


def declared_effects(geometry: Geometry) -> tuple[PlacedEffect, ...]:
    """The effects of a geometry, in the order in which they act.

    Raises UserError for one that is unknown, has no such place or parameter, or is declared twice.
    """
    places: dict[str, Sequence[Where]] = {}  # those of crosstalk are hundreds, and a score test declares all of them
    placed = [_place_declared_effect(item, geometry, i, places) for i, item in enumerate(geometry.effects)]
    labels = [placed_effect.label for placed_effect in placed]
    for i, label in enumerate(labels):
        if label in labels[:i]:
            raise UserError(f"`{label}` is declared twice", place=f"effects[{i}]", remedy="Remove one of them")
    order = [effect.name for effect in library.EFFECTS]
    return tuple(sorted(placed, key=lambda item: (order.index(item.effect.name), item.where)))


def _place_declared_effect(
    item: DeclaredEffect, geometry: Geometry, index: int, places: dict[str, Sequence[Where]]
) -> PlacedEffect:
    """The effect of an item at its place; `places` holds those of the effects so far, by name."""
    place = f"effects[{index}]"
    try:
        effect = find_effect(item.name)
        if item.name not in places:
            places[item.name] = effect.places(geometry)
        where = _resolve_place(effect, _where_with_choice(item), places[item.name])
        placed_effect = _at_place(effect, where, geometry)
    except UserError as error:
        raise UserError(error.fault, error.file, place, error.remedy) from error
    names = tuple(parameter.name for parameter in placed_effect.parameters)
    choice = placed_effect.effect.choice
    numbers = {name: value for name, value in item.parameters.items() if choice is None or name != choice.name}
    for name, value in numbers.items():
        if name not in names:
            fault = f"`{placed_effect.label}` has no parameter `{name}`"
            raise UserError(fault, place=place, remedy=_nearest(name, (*names, *([choice.name] if choice else []))))
        if isinstance(value, str):
            fault = f"`{name}` of `{placed_effect.label}` is `{value}`, not a number"
            raise UserError(fault, place=place, remedy="Give a number in SI units")
    return PlacedEffect(placed_effect.effect, placed_effect.where, placed_effect.parameters, numbers)


def _where_with_choice(item: DeclaredEffect) -> Where:
    """The names of the place, followed by the declared word of the effect's choice."""
    choice = next((effect.choice for effect in library.EFFECTS if effect.name == item.name), None)
    if choice is None or choice.name not in item.parameters:
        return item.where
    word = str(item.parameters[choice.name])
    if word not in choice.words:
        fault = f"`{choice.name}` of `{item.name}` is `{word}`"
        raise UserError(fault, remedy=_nearest(word, choice.words))
    return (*item.where, word)


def needs_mean(geometry: Geometry) -> bool:
    """Whether an effect of the geometry needs the means and waveforms of the records."""
    return any(placed_effect.effect.needs_mean for placed_effect in declared_effects(geometry))


def effect_parameters(effects: Sequence[PlacedEffect]) -> ParameterSet:
    """Parameters of the effects; they start as declared and have no prior, or are held."""
    rows = [(placed_effect, parameter) for placed_effect in effects for parameter in placed_effect.parameters]
    bounds = np.array([parameter.fitted_bounds for _, parameter in rows]).reshape(-1, 2)
    return ParameterSet(
        names=tuple(placed_effect.full_name(parameter) for placed_effect, parameter in rows),
        units=tuple(parameter.fitted_unit for _, parameter in rows),
        value=np.array([placed_effect.start(parameter) for placed_effect, parameter in rows], float),
        sigma=np.array([0.0 if parameter.held else np.inf for _, parameter in rows], float),
        scale=np.array([parameter.fitted_scale for _, parameter in rows], float),
        lower=bounds[:, 0],
        upper=bounds[:, 1],
    )


def apply_placed_effects(
    equations: Equations, geometry: Geometry, effects: Sequence[PlacedEffect], value: Mapping[str, Dual]
) -> Equations:
    """The equations with these effects added in turn; `value` holds all parameters of the model by name."""
    for placed_effect in effects:
        values = {
            parameter.fitted_name: value[placed_effect.full_name(parameter)] for parameter in placed_effect.parameters
        }
        equations = placed_effect.effect.apply(equations, geometry, placed_effect.where, values)
    return equations


def parse_effect_word(word: str) -> tuple[str, Where]:
    """The name and the place of an effect as on the command line: NAME[@PLACE[,PLACE]]."""
    name, _, where = word.partition("@")
    return name.strip(), tuple(part.strip() for part in where.split(",") if part.strip())


def add_effects(geometry: Geometry, words: Sequence[str]) -> Geometry:
    """The geometry with effects added that are named as on the command line: NAME[@PLACE[,PLACE]]."""
    added = []
    for word in words:
        placed_effect = place_effect(*parse_effect_word(word), geometry)
        added.append(DeclaredEffect(name=placed_effect.effect.name, where=placed_effect.where))
    extended = geometry.model_copy(update={"effects": (*geometry.effects, *added)})
    declared_effects(extended)
    return extended


def without_effects(geometry: Geometry) -> Geometry:
    """The geometry of the rigid balance, without effects."""
    return geometry.model_copy(update={"effects": ()})
