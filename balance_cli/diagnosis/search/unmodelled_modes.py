"""Unmodelled modes: resonances of free shape, added where no physical effect of the library explains the residual.

They describe the residual without explaining it. With them the hub loads are correct where the balance resonates in an
unknown way; the cause has to be looked for at the identified frequencies. A resonance may have hidden an effect of the
library, which is then found beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.diagnosis.fit_settings import FitSettings
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.refit import SearchState, fit_until_stable, fit_with_candidate
from balance_cli.diagnosis.search.rounds import rank_candidates, search_round
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.trials import refit_trial
from balance_cli.diagnosis.search.whole_fits import describes_more, whole_fit_trial
from balance_cli.diagnosis.settings import SearchSettings, UnmodelledModeSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.likelihood import evaluate_batch
from balance_cli.estimation.model_error import add_model_error
from balance_cli.model.balance import Estimate
from balance_cli.model.placed_effects import declared_effects, effect_label, find_effect
from balance_cli.model.system import System
from balance_cli.model.system_response import solve

Array = NDArray[np.float64]
Announce = Callable[[str], bool]


def add_unmodelled_modes(
    starts: Sequence[Estimate],
    lines: SearchLines,
    first_round: int,
    announce: Announce,
    settings: SearchSettings,
) -> tuple[SearchState | None, tuple[Trial, ...]]:
    """The model with the resonances that reduce its error, and the trials; None where no resonance is accepted.

    Of several starts the one that ends with the best description is returned. The first one has all effects
    found before; those of its effects that the returned model lacks are listed as removed.
    """
    results = [_add_modes(start, lines, first_round, announce, settings) for start in starts]
    costs = [_cost(state, settings.parameter_cost) for state, _ in results]
    best = int(np.argmin(costs))
    state, trials = results[best]
    if not any(trial.decision == "accepted" for trial in trials):
        return None, trials
    before, after = _labels(starts[0].geometry), _labels(state.geometry)
    gain, removed = costs[best] - costs[0], sorted(before - after)
    reason = "resonances alone describe more"
    superseded = (refit_trial(first_round, label, gain, "removed", reason, score=0.0) for label in removed)
    return state, (*trials, *superseded)


def _labels(geometry: Geometry) -> set[str]:
    """The labels of the effects of a geometry."""
    return {effect.label for effect in declared_effects(geometry)}


def _cost(state: SearchState, parameter_cost: float) -> float:
    """-2 ln likelihood plus the cost of the free parameters."""
    return state.fit_criterion + parameter_cost * float(np.count_nonzero(state.model.parameters.free))


def _add_modes(
    start: Estimate, lines: SearchLines, first_round: int, announce: Announce, settings: SearchSettings
) -> tuple[SearchState, tuple[Trial, ...]]:
    """The stable fit of one starting model with the resonances that are accepted, and the effects beside them.

    A resonance may have hidden an effect, and a further one would describe it badly: the best of both is added.
    """
    state = fit_until_stable(start, lines, settings.fit)
    trials: list[Trial] = []
    modes = 0
    for number in range(first_round, first_round + settings.modes.max_rounds):
        if state.error < settings.rounds.small_error or (modes and announce("effects beside a resonance")):
            break
        added = search_round(state, lines, number, _pool(state, lines, modes, settings), settings)
        trials += added.trials
        if added.state is None:
            break
        is_mode = len(_empirical_effects(added.state)) > len(_empirical_effects(state))
        modes += is_mode
        state = move_to_best_places(added.state, lines, settings.fit) if is_mode else added.state
    return state, tuple(trials)


def add_resonance_by_whole_fit(
    base: SearchState, current: SearchState, lines: SearchLines, number: int, settings: SearchSettings
) -> tuple[SearchState | None, tuple[Trial, ...]]:
    """Return the state `base` with one resonance that describes it all, as `whole_fits.add_body_by_whole_fit`.

    Beside two close modes of the plate, whose order a resonance exchanges, its score and first steps from `base` lead
    into a wrong minimum, and the rounds up to `current` take what is not there. None where the resonance leaves a
    large error. Trials have this round `number`.
    """
    pool = unmodelled_mode_candidates(base, lines.fitted, settings.modes, settings.excluded)
    trials: list[Trial] = []
    for start in pool[0].starts[: settings.modes.max_whole_fits] if pool else ():
        if settings.fit.is_over:
            break
        at_peak = [replace(item, starts=(start,)) for item in pool]
        best = rank_candidates(base, lines, at_peak, settings)[0].candidate
        end = fit_with_candidate(base, best, lines, settings.fit)
        accepted = end.error <= settings.rounds.large_error and describes_more(end, current, settings)
        cost = settings.parameter_cost * (len(end.theta) - len(base.theta))
        trials.append(whole_fit_trial(best.label, base.fit_criterion - end.fit_criterion - cost, accepted, number))
        if accepted:
            return move_to_best_places(end, lines, settings.fit), tuple(trials)
    return None, tuple(trials)


def _pool(state: SearchState, lines: SearchLines, modes: int, settings: SearchSettings) -> tuple[Candidate, ...]:
    """The resonances that may still be added; beside the first one all effects, which it had hidden."""
    pool: tuple[Candidate, ...] = ()
    if modes < settings.modes.max_modes:
        pool = unmodelled_mode_candidates(state, lines.fitted, settings.modes, settings.excluded)
    return (*pool, *candidates(state.geometry, excluded=settings.excluded)) if modes else pool


def _empirical_effects(state: SearchState) -> list[str]:
    """The labels of the empirical effects of a model."""
    return [effect.label for effect in declared_effects(state.geometry) if effect.effect.empirical]


def unmodelled_mode_candidates(
    state: SearchState, batches: Sequence[Batch], settings: UnmodelledModeSettings, excluded: Collection[str]
) -> tuple[Candidate, ...]:
    """The empirical candidates, started at the frequencies of the largest model errors."""
    system = state.system(derivatives=False)
    peaks = _error_peaks(add_model_error(batches, state.shares), system, settings)
    candidates_at_peaks = []
    for candidate in candidates(state.geometry, empirical=True, excluded=excluded):
        start_at_frequency = candidate.effect.search.start_at_frequency
        if candidate.effect.empirical and start_at_frequency is not None and peaks:
            candidates_at_peaks.append(replace(candidate, starts=tuple(start_at_frequency(peak) for peak in peaks)))
    return tuple(candidates_at_peaks)


def move_to_best_places(state: SearchState, lines: SearchLines, settings: FitSettings) -> SearchState:
    """The same model with each effect declared at the place where its parameters are determined best."""
    fitted = dict(zip(state.model.parameters.names, state.theta.tolist(), strict=True))
    effects = best_places(state.geometry.effects, fitted)
    if effects == state.geometry.effects:
        return state
    moved = extend_model(state, state.geometry.model_copy(update={"effects": effects}))
    return fit_until_stable(moved, lines, settings, state.shares)


def best_places(declared: Sequence[DeclaredEffect], fitted: Mapping[str, float]) -> tuple[DeclaredEffect, ...]:
    """The effects at their best places, no two of the same kind at one place; those that come first move first."""
    occupied = {(item.name, item.where) for item in declared}
    effects = []
    for item in declared:
        moved = _move_to_best_place(item, fitted)
        effects.append(item if (moved.name, moved.where) in occupied else moved)
        occupied.add((moved.name, moved.where))
    return tuple(effects)


def _move_to_best_place(item: DeclaredEffect, fitted: Mapping[str, float]) -> DeclaredEffect:
    """The declared effect at its best place, `fitted` being all parameters of the model by their full names."""
    best_place = find_effect(item.name).search.best_place
    if best_place is None:
        return item
    label = effect_label(item.name, item.where)
    values = {name: float(fitted.get(f"{label}.{name}", value)) for name, value in item.parameters.items()}
    where, parameters = best_place(item.where, values)
    return DeclaredEffect(name=item.name, where=where, parameters=dict(parameters))


def _error_peaks(batches: Sequence[Batch], system: System, settings: UnmodelledModeSettings) -> list[float]:
    """Frequencies [Hz] of the largest model errors, no two within the width of a peak."""
    peaks: list[float] = []
    frequency = np.concatenate([batch.line_frequency for batch in batches])
    chi2 = np.concatenate([_line_chi2(batch, system) for batch in batches])
    chi2[frequency == 0] = 0.0
    while len(peaks) < settings.max_peaks and chi2.any():
        peak = float(frequency[np.argmax(chi2)])
        peaks.append(peak)
        chi2[np.abs(frequency - peak) < settings.peak_width * peak] = 0.0
    return peaks


def _line_chi2(batch: Batch, system: System) -> Array:
    """Chi-square (K,) of the spectral lines."""
    return evaluate_batch(batch, system, solve(system, batch.frequency, batch.spin)).chi2
