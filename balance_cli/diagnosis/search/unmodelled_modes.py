"""Where the library is exhausted: resonances of free shape, begun where most of the residual is.

They describe and do not explain. What they are worth is that hub loads come out right where the balance resonates in a
way that nobody has written down; what made them, someone has to look for at the frequencies found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.search.refit import PENALTY, SearchState, fit_until_stable
from balance_cli.diagnosis.search.score_statistics import extend_model
from balance_cli.diagnosis.search.search import SMALL_ERROR, search_round
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.estimation.likelihood import evaluate_batch as fitted_lines
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.model_error import add_model_error
from balance_cli.model.balance import BalanceModel
from balance_cli.model.placed_effects import declared_effects
from balance_cli.model.system import System, solve

Array = NDArray[np.float64]

MODE_EFFECT_NAME = "extra-mode"
# Frequencies at which a resonance is tried, and the share of one that belongs to it.
PEAKS = 5
PEAK_WIDTH = 0.08
# One for each direction at most.
MAX_MODES = 3


def add_unmodelled_modes(
    starting_models: Sequence[tuple[BalanceModel, Array]],
    lines: SearchLines,
    first_round: int,
    announce: Callable[[str], None],
) -> tuple[SearchState | None, tuple[Trial, ...]]:
    """The model with resonances that take their share off its error, and what was tried; None where none does.

    Of several beginnings the one that ends with the better description. The first one has all that was found before;
    what one of the others lacks of it is put down as removed.
    """
    announce("resonances without a cause")
    ends = [_add_modes(model, theta, lines, first_round) for model, theta in starting_models]
    worth = [_cost(state) for state, _ in ends]
    best = int(np.argmin(worth))
    state, trials = ends[best]
    if not any(trial.decision == "accepted" for trial in trials):
        return None, trials
    labels = [{one.label for one in declared_effects(model.geometry)} for model, _ in starting_models]
    gain = worth[best] - worth[0]
    return state, (
        *trials,
        *(_superseded_trial(first_round, label, gain) for label in sorted(labels[0] - labels[best])),
    )


def _cost(state: SearchState) -> float:
    """-2 ln likelihood, and what parameters cost."""
    return state.fitted + PENALTY * float(np.count_nonzero(state.model.parameters.free))


def _superseded_trial(number: int, label: str, gain: float) -> Trial:
    return Trial(number, label, 0.0, 1, 1.0, gain, "removed", "resonances alone describe more")


def _add_modes(
    model: BalanceModel, theta: Array, lines: SearchLines, first_round: int
) -> tuple[SearchState, tuple[Trial, ...]]:
    """The model with the resonances that are accepted from one beginning, or as it settles without any."""
    state = fit_until_stable(model, theta, lines)
    trials: list[Trial] = []
    for number in range(first_round, first_round + MAX_MODES):
        if state.error < SMALL_ERROR:
            break
        added = search_round(state, lines, number, trials, {}, unmodelled_mode_candidates(state, lines.fitted))
        if added is None:
            break
        state = orient_along_largest(added, lines)
    return state, tuple(trials)


def unmodelled_mode_candidates(state: SearchState, batches: Sequence[Batch]) -> tuple[Candidate, ...]:
    """The empirical candidates, begun at the frequencies where the model is most in error."""
    system = state.model.system(state.theta)
    starts = tuple({"frequency": peak} for peak in _error_peaks(add_model_error(batches, state.shares), system))
    pool = candidates(state.geometry, empirical=True)
    return tuple(replace(one, starts=starts) for one in pool if one.effect.empirical and starts)


def orient_along_largest(state: SearchState, lines: SearchLines) -> SearchState:
    """The same with each resonance at the direction in which it moves most: there its mass and shape are well told."""
    known = dict(zip(state.model.parameters.names, state.theta, strict=True))
    effects, taken = [], {item.where for item in state.geometry.effects if item.name == MODE_EFFECT_NAME}
    for item in state.geometry.effects:
        turned = item if item.name != MODE_EFFECT_NAME else _reorient(item, known)
        effects.append(item if turned.where in taken else turned)
    if tuple(effects) == state.geometry.effects:
        return state
    model, theta = extend_model(state.model, state.theta, state.geometry.model_copy(update={"effects": tuple(effects)}))
    return fit_until_stable(model, theta, lines, state.shares)


def _reorient(item: DeclaredEffect, known: Mapping[str, float]) -> DeclaredEffect:
    """With s the part of the new direction in the shape, m becomes m s^2 and the shape is divided by s."""
    prefix = f"{MODE_EFFECT_NAME}@{item.where[0]}."
    values = {name: known.get(prefix + name, value) for name, value in item.parameters.items()}
    shape = {name: float(value) for name, value in values.items() if name.startswith("shape_")}
    shape[f"shape_{item.where[0]}"] = 1.0
    largest = max((name for name in shape if name[-2:] in ("_x", "_y", "_z")), key=lambda name: abs(shape[name]))
    part = shape[largest]
    turned = {name: value / part for name, value in shape.items() if name != largest}
    mass = {"mass": float(values["mass"]) * part**2}
    rest = {name: value for name, value in values.items() if name not in (*shape, "mass")}
    return DeclaredEffect(name=MODE_EFFECT_NAME, where=(largest[-1],), parameters={**rest, **mass, **turned})


def _error_peaks(batches: Sequence[Batch], system: System) -> list[float]:
    """Frequencies [Hz] of the largest errors, each apart from the others."""
    found: list[float] = []
    frequency = np.concatenate([batch.frequency[batch.index] for batch in batches])
    left = np.concatenate([_line_chi2(batch, system) for batch in batches])
    left[frequency == 0] = 0.0
    while len(found) < PEAKS and left.any():
        peak = float(frequency[np.argmax(left)])
        found.append(peak)
        left[np.abs(frequency - peak) < PEAK_WIDTH * peak] = 0.0
    return found


def _line_chi2(batch: Batch, system: System) -> Array:
    """Chi-square (K,) of the lines."""
    return fitted_lines(batch, system, solve(system, batch.frequency, batch.spin)).chi2
