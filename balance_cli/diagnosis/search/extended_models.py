"""Models with candidates added, and parameters from which they are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.model.balance import BalanceModel, Estimate, balance_model
from balance_cli.model.effects import EFFECTS
from balance_cli.model.placed_effects import PlacedEffect, declared_effects, effect_parameters

Array = NDArray[np.float64]


def add_candidates(
    geometry: Geometry, candidates: Sequence[tuple[Candidate, int]], at_start_values: bool = False
) -> Geometry:
    """Return the geometry with candidates at their nulls, or at the start of this number where a fit begins."""
    added = [
        candidate.at_start(candidate.starts[number]) if at_start_values else candidate.at_null(candidate.starts[number])
        for candidate, number in candidates
    ]
    return geometry.model_copy(update={"effects": (*geometry.effects, *added)})


def add_all_starts(
    estimate: Estimate, trials: Sequence[tuple[Candidate, int]]
) -> tuple[Estimate, tuple[PlacedEffect, ...]]:
    """Return the estimate with every candidate at the null of every start, and the effects of the trials.

    None of them changes the equations, so that they can stand beside each other. A further start of a candidate is an
    effect of another name.
    """
    geometry = estimate.geometry
    null = extend_model(estimate, add_candidates(geometry, [t for t in trials if t[1] == 0]))
    extended = null.model
    further = {(item.label, k): _further_start(geometry, item, k) for item, k in trials if k > 0}
    order = [effect.name for effect in EFFECTS]
    effects = sorted(
        (*extended.effects, *further.values()), key=lambda item: order.index(item.effect.name.split("#")[0])
    )
    parameters = effect_parameters(tuple(further.values()))
    whole = BalanceModel(extended.geometry, extended.parameters + parameters, tuple(effects))
    placed = tuple(further[item.label, k] if k else item.placed_effect for item, k in trials)
    return whole.at(np.concatenate([null.theta, parameters.value])), placed


def _further_start(geometry: Geometry, candidate: Candidate, number: int) -> PlacedEffect:
    """A candidate at the null of a further start, under a name of its own."""
    alone = geometry.model_copy(update={"effects": (candidate.at_null(candidate.starts[number]),)})
    (placed,) = declared_effects(alone)
    return replace(placed, effect=replace(placed.effect, name=f"{placed.effect.name}#{number}"))


def extend_model(estimate: Estimate, geometry: Geometry) -> Estimate:
    """Return the model of a geometry with other effects, at the values of the estimate where it has the parameter.

    Parameters that are held in its model (sigma 0) are held in the new one.
    """
    extended, before = balance_model(geometry), estimate.model.parameters
    known = dict(zip(before.names, estimate.theta, strict=True))
    known_sigma = dict(zip(before.names, before.sigma, strict=True))
    parameters = extended.parameters
    values = [known.get(name, value) for name, value in zip(parameters.names, parameters.value, strict=True)]
    sigma = [known_sigma.get(name, s) for name, s in zip(parameters.names, parameters.sigma, strict=True)]
    return extended.with_sigma(np.array(sigma, float)).at(np.array(values, float))


def hold_other_parameters(extended: BalanceModel, model: BalanceModel, names: set[str]) -> BalanceModel:
    """Return the extended model with only the parameters of `model` and these names free."""
    free = names | set(model.parameters.names)
    parameters = extended.parameters
    sigma = [s if name in free else 0.0 for name, s in zip(parameters.names, parameters.sigma, strict=True)]
    return extended.with_sigma(np.array(sigma, float))


def free_names(model: BalanceModel) -> list[str]:
    """Return the names of the free parameters, in order."""
    return [name for name, free in zip(model.parameters.names, model.parameters.free, strict=True) if free]
