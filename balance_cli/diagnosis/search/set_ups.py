"""Effects that every set-up of the exciters has, with values of its own: they are tried all at once.

Each exciter moves a mass beyond its force cell. With two exciters in a set-up, in three set-ups, that is five masses,
and what one of them alone describes is small beside what the others leave: the rounds of the search took bodies and
dampers in their place (chi-square 23 900 per degree of freedom; with the masses together 1.00). The same holds for the
stiffness of stingers. Where the first round leaves a large error, a whole fit from where it began has all of them, and
keeps those that it finds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.search.refit import SearchState, whole_fit
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.whole_fits import describes_more, whole_fit_trial
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.estimation.model_error import add_model_error
from balance_cli.signals.run_spectrum import RunSpectrum


def set_up_candidates(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings
) -> tuple[Candidate, ...]:
    """Return the effects of set-ups at their places, one of those that act in the same runs along the same motion."""
    every = candidates(geometry, excluded=settings.excluded, on_request=True)
    pool = [item for item in every if item.effect.search.in_every_set_up]
    found = dict[tuple[str, frozenset[str], str], Candidate]()
    for item in sorted(pool, key=lambda item: len(item.placed_effect.where)):
        excited, along = item.placed_effect.where[0], item.placed_effect.where[-1]
        moved = frozenset(run.run for run in runs if excited in run.components)
        if moved:
            found.setdefault((item.effect.name, moved, along), item)
    return tuple(found.values())


def add_set_ups_by_whole_fit(
    base: SearchState,
    current: SearchState,
    pool: Sequence[Candidate],
    lines: SearchLines,
    number: int,
    settings: SearchSettings,
) -> tuple[SearchState | None, tuple[Trial, ...], dict[str, dict[str, float]]]:
    """Return `base` with those effects of the pool that a whole fit with all of them finds, trials, and gains.

    None where the `current` state has no large error, or those found leave one: so many values describe a part of any
    cause, and all of the pool have values that hardly matter, along which a fit is slow.
    Trials have this round `number`.
    """
    largest = settings.rounds.large_error
    if len(pool) < 2 or current.error <= largest or settings.fit.is_over:
        return None, (), {}
    end = whole_fit(base, pool, lines, settings)
    found = _found(end, pool, lines, settings) if describes_more(end, current, settings) else []
    if not found:
        return None, (), {}
    end = whole_fit(base, found, lines, settings)
    gain = base.fit_criterion - end.fit_criterion - settings.parameter_cost * (len(end.theta) - len(base.theta))
    is_accepted = end.error <= largest and describes_more(end, current, settings)
    trials = tuple(whole_fit_trial(item.label, gain, is_accepted, number) for item in found)
    return (end, trials, {item.label: {item.label: gain} for item in found}) if is_accepted else (None, trials, {})


def _found(
    end: SearchState, pool: Sequence[Candidate], lines: SearchLines, settings: SearchSettings
) -> list[Candidate]:
    """Those of the pool of which a parameter is far from its null, against its standard deviation in this fit."""
    weighted = add_model_error(lines.fitted, end.shares)
    parameters = end.model.parameters
    curvature = data_curvature(weighted, end.system()) + prior_curvature(parameters, end.theta)
    variance = np.diag(covariance_from_information(curvature.information))
    names = [name for name, free in zip(parameters.names, parameters.free, strict=True) if free]
    # A place along which the rig cannot move has no information, and no variance.
    variance = np.where(variance > 0.0, variance, np.inf)
    square = dict(zip(names, end.theta[parameters.free] ** 2 / variance, strict=True))
    return [
        item
        for item in pool
        if any(
            square[f"{item.label}.{parameter.fitted_name}"] > settings.parameter_cost
            for parameter in item.placed_effect.parameters
        )
    ]
