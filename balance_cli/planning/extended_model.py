"""The model of a plan: the balance with every candidate effect at its null, all derivatives at once."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.candidates import Candidate, candidates, parameters_of_interest
from balance_cli.diagnosis.search.extended_models import (
    add_candidates,
    extend_model,
    free_names,
    hold_other_parameters,
)
from balance_cli.diagnosis.search.projected_scores import ParameterIndices
from balance_cli.model import effects
from balance_cli.model.balance import BalanceModel, Estimate
from balance_cli.model.effects import EffectParameter
from balance_cli.model.system import System

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class ExtendedModel:
    """The balance `model` at `theta` (p,) with its `candidates` at their nulls.

    `indices` are those of the fitted parameters and of each candidate's parameters of interest among the free ones.
    `candidate_count` is the number of effects that a diagnosis would try, which corrects its level; it is larger than
    that of the candidates where these are a selection.
    """

    model: BalanceModel
    theta: Array
    candidates: tuple[Candidate, ...]
    indices: ParameterIndices
    candidate_count: int

    @property
    def size(self) -> int:
        """Number of free parameters, those of the candidates included."""
        return int(np.count_nonzero(self.model.parameters.free))

    @property
    def prior_information(self) -> Array:
        """Information (p, p) of the priors; none for a parameter without one."""
        sigma = self.model.parameters.sigma[self.model.parameters.free]
        return np.diag(1.0 / sigma**2)

    @cached_property
    def system(self) -> System:
        """The system at `theta`, the same for every run."""
        return self.model.system(self.theta)

    @cached_property
    def tested_effects(self) -> NDArray[np.str_]:
        """The effect's name (t,) of every tested parameter, in the order of the candidates."""
        return np.array([each.effect.name for each in self.candidates for _ in self.items(each)])

    @cached_property
    def scales(self) -> Array:
        """The size (t,) of a change that matters, of every tested parameter in the order of the candidates."""
        return np.array([item.fitted_scale for each in self.candidates for item in self.items(each)])

    def items(self, candidate: Candidate) -> tuple[EffectParameter, ...]:
        """The parameters of interest of a candidate, in the order of its indices."""
        return parameters_of_interest(candidate.placed_effect.parameters)


def extended_model(estimate: Estimate, names: Collection[str] | None = None) -> ExtendedModel:
    """The model with all effects of the library that it lacks, or only those of these names, at their nulls.

    A candidate is represented by its first start: `diagnose` tries several, and finds what the best of them finds.
    """
    everything = candidates(estimate.geometry)
    chosen = tuple(item for item in everything if names is None or item.effect.name in names)
    geometry = add_candidates(estimate.geometry, [(item, 0) for item in chosen])
    null = extend_model(estimate, geometry)
    tested = [
        [item.placed_effect.full_name(each) for each in parameters_of_interest(item.placed_effect.parameters)]
        for item in chosen
    ]
    extended = hold_other_parameters(null.model, estimate.model, {name for each in tested for name in each})
    indices = ParameterIndices.from_names(free_names(extended), tested)
    return ExtendedModel(extended, null.theta, chosen, indices, len(everything))


def effect_names() -> tuple[str, ...]:
    """Names of the effects that a plan can consider: those of the library that explain, not the empirical ones."""
    return tuple(effect.name for effect in effects.EFFECTS if not effect.empirical)
