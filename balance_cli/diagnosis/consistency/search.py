"""The search for the mistakes in a campaign: the one that removes most of the contradictions, then the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from balance_cli.diagnosis.consistency.evidence import Evidence
from balance_cli.diagnosis.consistency.hypotheses import Hypothesis, undo
from balance_cli.diagnosis.consistency.residuals import SIGNIFICANT, residuals
from balance_cli.diagnosis.consistency.trials import (
    TIE,
    State,
    Trial,
    changes_residuals,
    energy_after,
    make_state,
    ranked_trials,
    suspect_channels,
)

MOST_MISTAKES = 8
"""More are not looked for: the campaign is then not to be repaired by naming them."""
AGREEING_SHARE = 0.5
"""Of the squared residuals of a run that has a mistake without showing it by itself: what undoing leaves at most."""
ALTERNATIVE_SHARE = 0.5
"""Of the gain of a mistake in a run: where another run could have it with so much gain, both are named."""


@dataclass(frozen=True)
class Mistake:
    """A mistake that was found: what undoes it as a factor, and the runs that show it.

    `everywhere`: no run in which it would show is without it. `alternative_runs`: as likely, it is these that are wrong
    in the same way. `rivals` explain the same runs as well.
    """

    hypothesis: Hypothesis
    factor: float
    runs: tuple[str, ...]
    everywhere: bool
    alternative_runs: tuple[str, ...] = ()
    rivals: tuple[Hypothesis, ...] = ()


def find_mistakes(
    runs: Sequence[Evidence], by_source: tuple[tuple[int, ...], ...]
) -> tuple[list[Mistake], list[Evidence]]:
    """Return the mistakes, the clearest first, and the runs with all of them undone.

    `by_source` are the channels of each cell.
    """
    state = make_state(list(runs), by_source)
    mistakes: list[Mistake] = []
    while state.runs and len(mistakes) < MOST_MISTAKES:
        trials = ranked_trials(state)
        if not trials:
            break
        best, corrected = _spread(state, trials[0])
        mistakes.append(_describe(state, corrected, best, trials))
        state = corrected
    return mistakes, state.runs


def _spread(state: State, trial: Trial) -> tuple[Trial, State]:
    """Return the trial for the runs that show it, and for those that agree with these only if they have it, too.

    Second, the state with the mistake undone in them.
    """
    shown = tuple(index for index in trial.members if len(trial.members) == 1 or _gain(state, trial, index) > 0)
    corrected = make_state(_undo(state.runs, trial, shown), state.by_source)
    if len(trial.members) == 1:
        return trial, corrected
    rest = [
        index
        for index in state.all_runs
        if index not in shown and changes_residuals(trial.hypothesis, state.runs[index])
    ]
    agree = tuple(
        index
        for index in rest
        if energy_after(trial.hypothesis, corrected.runs[index], trial.value, corrected.weights[index])
        < AGREEING_SHARE * corrected.energy[index].sum()
    )
    members = tuple(sorted({*shown, *agree}))
    return replace(trial, members=members), make_state(_undo(state.runs, trial, members), state.by_source)


def _gain(state: State, trial: Trial, index: int) -> float:
    """Return what a run gains by itself, not compared with other runs."""
    weight = replace(state.weights[index], runs=np.inf)
    run = state.runs[index]
    before = float(residuals(run, run.forces, run.loads, weight).energy.sum())
    return before - energy_after(trial.hypothesis, run, trial.value, weight)


def _undo(runs: Sequence[Evidence], trial: Trial, members: tuple[int, ...]) -> list[Evidence]:
    result = list(runs)
    for index in members:
        corrected = undo(trial.hypothesis, result[index], trial.value)
        result[index] = replace(result[index], forces=corrected.forces, loads=corrected.loads)
    return result


def _contradicts(corrected: State, trial: Trial, index: int) -> bool:
    """Whether a run in which a mistake was not undone would become worse by undoing it."""
    run, weights = corrected.runs[index], corrected.weights[index]
    if not changes_residuals(trial.hypothesis, run):
        return False
    after = energy_after(trial.hypothesis, run, trial.value, weights)
    return after - float(corrected.energy[index].sum()) > SIGNIFICANT


def _describe(state: State, corrected: State, best: Trial, trials: Sequence[Trial]) -> Mistake:
    others = [index for index in state.all_runs if index not in best.members]
    everywhere = not any(_contradicts(corrected, best, index) for index in others)
    alternatives = {
        state.runs[trial.members[0]].run
        for trial in trials[1:]
        if len(trial.members) == len(best.members) == 1 and trial.members != best.members
        if trial.hypothesis == best.hypothesis and trial.gain > ALTERNATIVE_SHARE * best.gain
        if not suspect_channels(corrected, trial.members[0])
    }
    rivals = tuple(
        trial.hypothesis
        for trial in trials[1:]
        if trial.gain >= (1.0 - TIE) * best.gain and trial.hypothesis.kind == best.hypothesis.kind
        if set(trial.members) == set(best.members) and len(trial.hypothesis.indices) == len(best.hypothesis.indices)
        if trial.gain_by_predictions >= (1.0 - TIE) * best.gain_by_predictions - SIGNIFICANT
    )
    names = tuple(state.runs[index].run for index in best.members)
    return Mistake(best.hypothesis, best.value, names, everywhere, tuple(sorted(alternatives)), rivals)
