"""Restarts of a fit that ended in a wrong minimum, with single motions of its effects restarted.

A motion of a large support that begins too stiff may end rigid while the others take over what it explains. No later
round would find it again, as a rig has one support, and pruning would drop the motion as needless. A mass that began
small and far away may stay there, at the wrong end of the valley of mass and arm.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.refit import SearchState, fit_until_stable
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import WORKERS
from balance_cli.model.placed_effects import declared_effects

Array = NDArray[np.float64]


def restart_one_by_one(state: SearchState, lines: SearchLines, settings: SearchSettings) -> SearchState:
    """Return the best of the fits in which the restarts of the effects, one after another, replace fitted values."""
    for _ in range(settings.rounds.max_restarts):
        fit = partial(fit_until_stable, lines=lines, settings=settings.fit)
        with ThreadPoolExecutor(WORKERS) as workers:
            ends = list(workers.map(fit, map(state.model.at, restarted_values(state, settings))))
        best = min(ends, key=lambda end: end.fit_criterion, default=state)
        if best.fit_criterion >= state.fit_criterion - settings.parameter_cost:
            break
        before, state = state, best
        slight = state.error > (1.0 - settings.rounds.min_progress) * before.error
        if slight or settings.fit.is_over or state.error <= settings.rounds.large_error:
            break
    return state


def restarted_values(state: SearchState, settings: SearchSettings) -> list[Array]:
    """Return the parameters (p,) of a state with each set of restart values of its effects.

    Where the error is small, those of point masses only, which are few.
    """
    vectors, is_stuck = list[Array](), state.error > settings.rounds.stuck_error
    for effect in declared_effects(state.geometry):
        hints = effect.effect.search
        if not is_stuck and hints.point_mass is None:
            continue
        full_names = {item.fitted_name: effect.full_name(item) for item in effect.parameters}
        for values in hints.restart_values(state.geometry, effect.where):
            theta = state.theta.copy()
            for name, value in values.items():
                theta[state.model.parameters.index(full_names[name])] = value
            vectors.append(theta)
    return vectors
