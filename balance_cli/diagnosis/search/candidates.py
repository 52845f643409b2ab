"""Candidates: every effect of the library at every place that it can have, where the model does not have it yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.model import effects
from balance_cli.model.effects import Effect, EffectParameter, Where
from balance_cli.model.placed_effects import PlacedEffect, declared_effects, place_effect


@dataclass(frozen=True)
class Candidate:
    """An effect at a place, with the values from which a search may begin (fitted names and values).

    `chosen`: how many values in a start were chosen by the data that then judge it.
    """

    one: PlacedEffect
    starts: tuple[Mapping[str, float], ...]
    chosen: int = 0

    @property
    def label(self) -> str:
        """NAME@PLACE,PLACE."""
        return self.one.label

    @property
    def effect(self) -> Effect:
        """The effect itself."""
        return self.one.effect

    def at_null(self, start: Mapping[str, float]) -> DeclaredEffect:
        """The effect doing nothing; parameters that only shape what the others do are where the search begins."""
        values = {
            one.name: start.get(one.fitted_name, one.fitted_start) if one.nuisance else one.fitted_null
            for one in self.one.parameters
        }
        return self._declared(values)

    def at_start(self, start: Mapping[str, float]) -> DeclaredEffect:
        """The effect where a fit begins."""
        return self._declared({one.name: start.get(one.fitted_name, one.fitted_start) for one in self.one.parameters})

    def extra_starts(self, geometry: Geometry) -> Candidate:
        """The candidate with the further starts that a search scores."""
        extra_starts = self.effect.extra_starts
        return (
            self
            if extra_starts is None
            else replace(self, starts=(*self.starts, *extra_starts(geometry, self.one.where)))
        )

    def start_from_score(self, geometry: Geometry, number: int, step: Sequence[float]) -> Mapping[str, float]:
        """Values from which to begin at a start, where the score has found this `step` from the null."""
        own = {
            item.fitted_name: item.fitted_null + d
            for item, d in zip(parameters_of_interest(self.one.parameters), step, strict=True)
        }
        start_from_score, start = self.effect.start_from_score, self.starts[number]
        return start if start_from_score is None else start_from_score(geometry, self.one.where, start, own)

    def _declared(self, fitted: Mapping[str, float]) -> DeclaredEffect:
        values = {one.name: one.physical_value(fitted[one.name]) for one in self.one.parameters}
        finite = {name: float(value) for name, value in values.items() if abs(value) != float("inf")}
        return DeclaredEffect(name=self.effect.name, where=self.one.where, parameters=finite)


def parameters_of_interest(parameters: tuple[EffectParameter, ...]) -> tuple[EffectParameter, ...]:
    """Those that do something by themselves, of which the score test speaks."""
    return tuple(one for one in parameters if not one.nuisance)


def candidates(geometry: Geometry, empirical: bool = False) -> tuple[Candidate, ...]:
    """All candidates that the geometry's effects leave, empirical ones only where asked for."""
    taken = {(item.effect.name, item.where) for item in declared_effects(geometry)}
    names = {item.name for item in geometry.effects}
    found = []
    for effect in effects.EFFECTS:
        if effect.empirical and not empirical:
            continue
        if effect.at_most_once and effect.name in names:
            continue
        places = effect.places(geometry) if effect.search_places is None else effect.search_places(geometry)
        found += [candidate_at(effect.name, where, geometry) for where in places if (effect.name, where) not in taken]
    return tuple(found)


def candidate_at(name: str, where: Where, geometry: Geometry) -> Candidate:
    """The candidate of this name at this place. UserError where there is none."""
    one = place_effect(name, where, geometry)
    starts = ({},) if one.effect.starts is None else one.effect.starts(geometry, where)
    return Candidate(one, tuple(starts))


def smaller_places(candidate: PlacedEffect, geometry: Geometry) -> tuple[Where, ...]:
    """Places of the same effect with one name less (a support that does not give way in one of its motions)."""
    places = candidate.effect.places(geometry)
    less = [tuple(name for name in candidate.where if name != gone) for gone in candidate.where]
    return tuple(where for where in less if where and where in places)
