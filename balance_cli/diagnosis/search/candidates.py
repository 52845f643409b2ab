"""Candidates of the search: every effect of the library at every place where the model does not have it yet."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.model import effects
from balance_cli.model.effects import Effect, EffectParameter, Where
from balance_cli.model.placed_effects import (
    PlacedEffect,
    declare_effect,
    declared_effects,
    effect_label,
    find_effect,
    parse_effect_word,
    place_effect,
)


@dataclass(frozen=True)
class Candidate:
    """An effect at a place, with the values from which a search may begin (fitted names and values).

    `fitted_start_values`: how many values of each start were determined from the data that the score test uses.
    """

    placed_effect: PlacedEffect
    starts: tuple[Mapping[str, float], ...]
    fitted_start_values: int = 0

    @property
    def label(self) -> str:
        """The name and the places of the effect, as NAME@PLACE,PLACE."""
        return self.placed_effect.label

    @property
    def effect(self) -> Effect:
        """The effect of the library that is placed here."""
        return self.placed_effect.effect

    def at_null(self, start: Mapping[str, float]) -> DeclaredEffect:
        """The effect declared at its null, with its nuisance parameters at their starting values."""
        return declare_effect(
            self.placed_effect,
            {
                item.fitted_name: start.get(item.fitted_name, item.fitted_start) if item.nuisance else item.fitted_null
                for item in self.placed_effect.parameters
            },
        )

    def at_start(self, start: Mapping[str, float]) -> DeclaredEffect:
        """The effect declared at the values from which a fit begins."""
        values = {
            item.fitted_name: start.get(item.fitted_name, item.fitted_start) for item in self.placed_effect.parameters
        }
        return declare_effect(self.placed_effect, values)

    def extra_starts(self, geometry: Geometry) -> Candidate:
        """The candidate with the further starts that a search scores."""
        extra_starts = self.effect.search.extra_starts
        if extra_starts is None:
            return self
        return replace(self, starts=(*self.starts, *extra_starts(geometry, self.placed_effect.where)))

    def start_from_score(self, geometry: Geometry, number: int, step: Sequence[float]) -> Mapping[str, float]:
        """Values from which a fit begins, given the `step` from the null that the score test estimates at a start."""
        estimate = {
            item.fitted_name: item.fitted_null + change
            for item, change in zip(parameters_of_interest(self.placed_effect.parameters), step, strict=True)
        }
        start_from_score, start = self.effect.search.start_from_score, self.starts[number]
        return (
            start if start_from_score is None else start_from_score(geometry, self.placed_effect.where, start, estimate)
        )


def parameters_of_interest(parameters: tuple[EffectParameter, ...]) -> tuple[EffectParameter, ...]:
    """The parameters that have an effect by themselves, which the score test tests."""
    return tuple(item for item in parameters if not item.nuisance)


def candidates(
    geometry: Geometry, empirical: bool = False, excluded: Collection[str] = (), on_request: bool = False
) -> tuple[Candidate, ...]:
    """All candidates that the effects of the geometry leave; empirical ones and those on request only if asked for.

    `excluded`: names of effects, or names with the first part of a place (`NAME@CELL`), that are none.
    """
    present = {(item.effect.name, item.where) for item in declared_effects(geometry)}
    names = {item.name for item in geometry.effects}
    pool = []
    for effect in effects.EFFECTS:
        if (effect.empirical and not empirical) or (effect.search.at_most_once and effect.name in names):
            continue
        if effect.search.on_request and not on_request:
            continue
        places = (effect.search.places or effect.places)(geometry)
        pool += [
            candidate_at(effect.name, where, geometry)
            for where in places
            if (effect.name, where) not in present and not is_excluded(effect.name, where, excluded)
        ]
    return tuple(pool)


def is_excluded(name: str, where: Where, excluded: Collection[str]) -> bool:
    """Whether one of the words is the name of the effect, or its name with the first part of the place."""
    return any(effect_label(name, where[:count]) in excluded for count in range(len(where) + 1))


def candidate_at(name: str, where: Where, geometry: Geometry) -> Candidate:
    """The candidate of this name at this place. Raises UserError where the effect cannot be there."""
    placed_effect = place_effect(name, where, geometry)
    starts = placed_effect.effect.search.starts
    return Candidate(placed_effect, ({},) if starts is None else tuple(starts(geometry, where)))


def suspected_candidates(word: str, geometry: Geometry) -> tuple[Candidate, ...]:
    """The candidates that a user means by NAME[@PLACE]: the one at that place, or those at all places of the effect.

    Empty where the geometry has one of them. Raises UserError for an unknown effect or place.
    """
    name, where = parse_effect_word(word)
    places = [place_effect(name, where, geometry).where] if where else list(find_effect(name).places(geometry))
    present = {(item.effect.name, item.where) for item in declared_effects(geometry)}
    if any((name, place) in present for place in places):
        return ()
    return tuple(candidate_at(name, place, geometry) for place in places)


def check_exclusion(word: str, geometry: Geometry) -> None:
    """Raise UserError unless the rig can have the effect NAME[@PLACE], at a place or at places that begin so."""
    name, where = parse_effect_word(word)
    if not any(place[: len(where)] == where for place in find_effect(name).places(geometry)):
        place_effect(name, where, geometry)


def smaller_places(candidate: PlacedEffect, geometry: Geometry) -> tuple[Where, ...]:
    """Places of the same effect with one name and some parameters less (a support that is rigid in one of its motions).

    A place with as many parameters is another one: a mass along the axis of an exciter, not across it.
    """
    effect, places = candidate.effect, candidate.effect.places(geometry)
    smaller = [tuple(name for name in candidate.where if name != removed) for removed in candidate.where]
    smaller = [where for where in smaller if where and where in places]
    return tuple(where for where in smaller if len(effect.parameters(geometry, where)) < len(candidate.parameters))
