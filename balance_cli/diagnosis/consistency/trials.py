"""Trials of single mistakes in one run or in all: what each gains, and whether it is to be accepted.

A mistake is accepted where it removes nearly all of the residuals that it concerns. A true effect that the geometry
lacks (a delay, a flexible support, a hose) bends a response; no sign, order or factor straightens it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence, with_references
from balance_cli.diagnosis.consistency.exchanges import RunExchanges, exchanges_in_all, find_exchanges
from balance_cli.diagnosis.consistency.hypotheses import (
    EXCHANGE_CHANNELS,
    EXCHANGE_LOADS,
    SCALE_LOADS,
    TURN_LOADS,
    Hypothesis,
    candidate_hypotheses,
    effect_of_mistake,
    estimate_factor,
    undo,
    without_scaled_pairs,
)
from balance_cli.diagnosis.consistency.load_axes import signed_loads
from balance_cli.diagnosis.consistency.residuals import (
    REMAINING_SHARE,
    SIGNIFICANT,
    Residuals,
    Weights,
    residual_weights,
    residuals,
)

Array = NDArray[np.float64]

LARGEST_MISFIT = 0.1
"""Sum of squares that may remain once a factor is undone, over that without the channels or loads: their pattern must
be that of the prediction (a correlation of 0.95), or a small factor would silence anything."""
TIE = 1e-2
"""Relative difference of two gains below which the mistake is named that no run contradicts, then the simpler one."""


@dataclass(frozen=True)
class Trial:
    """A hypothesis for some runs (indices), its factor, and what it gains: in all, and by geometry and other runs.

    `exceptions`: some of the runs contradict it.
    """

    hypothesis: Hypothesis
    members: tuple[int, ...]
    value: float
    gain: float
    exceptions: bool = False
    gain_by_predictions: float = 0.0


@dataclass(frozen=True)
class State:
    """All runs with their weights, their residuals as recorded and the energies of these; the channels of each cell."""

    runs: list[Evidence]
    weights: list[Weights]
    recorded: list[Residuals]
    energy: list[Array]
    by_source: tuple[tuple[int, ...], ...]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.runs[0].forces.shape[1])

    @property
    def all_runs(self) -> tuple[int, ...]:
        """Indices of all runs."""
        return tuple(range(len(self.runs)))


def make_state(runs: list[Evidence], by_source: tuple[tuple[int, ...], ...]) -> State:
    """Return the state of these runs, each compared with the others as they are now."""
    runs = with_references(runs)
    weights = [residual_weights(run) for run in runs]
    recorded = [residuals(run, run.forces, run.loads, w) for run, w in zip(runs, weights, strict=True)]
    return State(runs, weights, recorded, [part.energy for part in recorded], by_source)


def ranked_trials(state: State) -> list[Trial]:
    """Return the hypotheses that pass; first the one to be accepted, then by falling gain."""
    suspicious = [suspect_channels(state, index) for index in state.all_runs]
    if not any(suspicious):
        return []
    exchanges = [find_exchanges(*items) for items in zip(state.runs, state.weights, state.energy, strict=True)]
    trials: list[Trial] = []
    for index in state.all_runs:
        if suspicious[index]:
            trials += _trials_for(state, (index,), suspicious[index], exchanges)
    if len(state.runs) > 1:
        trials += _trials_for(state, state.all_runs, sorted(set().union(*map(set, suspicious))), exchanges)
    if not trials:
        return []
    best = max(trial.gain for trial in trials)
    near = [trial for trial in trials if trial.gain >= (1.0 - TIE) * best]
    clear = (1.0 - TIE) * max(trial.gain_by_predictions for trial in near) - SIGNIFICANT
    first = min(near, key=lambda trial: (trial.exceptions, trial.gain_by_predictions < clear))
    ranked = sorted(trials, key=lambda trial: -trial.gain)
    return [first, *(trial for trial in ranked if trial is not first)]


def suspect_channels(state: State, index: int) -> list[int]:
    """Return the channels of a run with a significant residual of any kind."""
    energy, c = state.energy[index], state.channels
    bad = (energy[:c] > SIGNIFICANT) | (energy[c : 2 * c] > SIGNIFICANT)
    for pair, value in zip(state.runs[index].pairs, energy[2 * c :], strict=True):
        bad[list(pair)] |= value > SIGNIFICANT
    return [int(i) for i in np.flatnonzero(bad)]


def _trials_for(
    state: State, members: tuple[int, ...], suspicious: Sequence[int], exchanges: Sequence[RunExchanges]
) -> list[Trial]:
    c = state.channels
    responds = any(np.any(state.energy[index][: 2 * c] > SIGNIFICANT) for index in members)
    components = sorted({j for index in members for j in state.runs[index].applied}) if responds else []
    trials = []
    pairs = exchanges_in_all([exchanges[index] for index in members])
    axes = signed_loads([state.runs[index] for index in members]) if components else None
    turned = [] if axes is None else [Hypothesis(TURN_LOADS, axes)]
    for hypothesis in [*candidate_hypotheses(suspicious, components, pairs, state.by_source), *turned]:
        concerned = tuple(index for index in members if changes_residuals(hypothesis, state.runs[index]))
        if concerned and (len(members) == 1 or len(concerned) > 1):
            trial = _try(state, hypothesis, concerned)
            trials += [] if trial is None else [trial]
    return trials


def changes_residuals(hypothesis: Hypothesis, run: Evidence) -> bool:
    """Whether a mistake would change the residuals of a run."""
    if hypothesis.kind == TURN_LOADS:
        return any(hypothesis.indices[j] != j + 1 for j in run.applied)
    if hypothesis.kind in (EXCHANGE_LOADS, SCALE_LOADS):
        return bool(set(hypothesis.indices) & set(run.applied))
    present = np.isfinite(run.forces[:, list(hypothesis.indices)]).all(axis=0)
    if hypothesis.kind == EXCHANGE_CHANNELS:
        return bool(present.reshape(-1, 2).all(axis=1).any())
    return bool(present.any())


def _try(state: State, hypothesis: Hypothesis, members: tuple[int, ...]) -> Trial | None:
    """Return the hypothesis with its best factor, without the runs that it contradicts; None where it does not pass.

    Where only check runs show it, also without the runs that it leaves as they are: sweeps to compare with.
    """
    exceptions = False
    for _ in range(2):
        energies = _compare(state, hypothesis, members)
        gains = energies.gains
        supporting = tuple(index for index, gain in zip(members, gains, strict=True) if gain > -SIGNIFICANT)
        if len(supporting) == len(members):
            passed = energies.pass_test(hypothesis) and energies.beside_strongest_line >= 0
            own = energies.by_predictions
            return Trial(hypothesis, members, energies.factor, float(sum(gains)), exceptions, own) if passed else None
        shown = tuple(index for index, gain in zip(members, gains, strict=True) if gain > SIGNIFICANT)
        members, exceptions = (supporting if _has_sweeps(state, shown) else shown), True
        if len(members) < 2:
            return None
    return None


def _has_sweeps(state: State, members: tuple[int, ...]) -> bool:
    return any(state.runs[index].rows.kind == "sweep" for index in members)


@dataclass(frozen=True)
class _Energies:
    """Energies (runs, columns) before a mistake is undone, after, and without what it concerns; c channels.

    `beside_strongest_line`: what check runs gain by a factor at all lines but that at which they gain most. A line near
    a mode may be far from what the bands of the sweeps predict, in all channels alike; a factor is one of all lines.
    """

    factor: float
    before: Array
    after: Array
    nothing: Array
    channels: int
    beside_strongest_line: float

    @property
    def gains(self) -> list[float]:
        """What each run gains, as the energy of all columns; negative where it contradicts."""
        return [float(gain) for gain in (self.before - self.after).sum(axis=1)]

    @property
    def by_geometry(self) -> Array:
        """What each run gains by the geometry alone."""
        return np.asarray((self.before - self.after)[:, : self.channels].sum(axis=1))

    @property
    def by_predictions(self) -> float:
        """What the runs gain without pairs, which show that two channels differ but not which of them is wrong."""
        return float((self.before - self.after)[:, : 2 * self.channels].sum())

    def pass_test(self, hypothesis: Hypothesis) -> bool:
        """Whether the columns that change lose nearly all of a significant energy, and no evidence becomes worse."""
        changed = np.abs(self.before - self.after) > 1e-9 * (self.before + self.after) + 1e-12
        lost, left = float(self.before[changed].sum()), float(self.after[changed].sum())
        if not lost > SIGNIFICANT or left > REMAINING_SHARE * lost:
            return False
        if hypothesis.has_factor and left >= LARGEST_MISFIT * float(self.nothing[changed].sum()):
            return False
        pairs = (self.before - self.after)[:, 2 * self.channels :].sum()
        return bool(self.by_geometry.sum() > -SIGNIFICANT and pairs > -SIGNIFICANT)


def _compare(state: State, hypothesis: Hypothesis, members: tuple[int, ...]) -> _Energies:
    """Return the energies of a hypothesis in these runs; several sweeps are not compared with each other.

    Several check runs are compared with the sweeps, which do not have the mistake.
    """
    effects, among = [], len(members) > 1 and _has_sweeps(state, members)
    for index in members:
        weight = without_scaled_pairs(hypothesis, state.runs[index], state.weights[index])
        weight = replace(weight, runs=np.inf) if among else weight
        effects.append(effect_of_mistake(hypothesis, state.runs[index], weight, state.recorded[index]))
    factor = estimate_factor(effects) if hypothesis.has_factor else 0.0
    after = [effect.with_factor(factor) if hypothesis.has_factor else effect.undone for effect in effects]
    return _Energies(
        factor,
        np.array([effect.recorded.energy for effect in effects]),
        np.array([part.energy for part in after]),
        np.array([effect.undone.energy for effect in effects]),
        state.channels,
        sum(
            _gain_beside_strongest_line(state.runs[index], effect.recorded, part)
            for index, effect, part in zip(members, effects, after, strict=True)
            if hypothesis.has_factor and state.runs[index].rows.kind == "check"
        ),
    )


def _gain_beside_strongest_line(run: Evidence, before: Residuals, after: Residuals) -> float:
    """Return what a run gains by other runs and by pairs of channels, without the line that gains most."""
    first, second = (np.hstack([part.runs, part.pairs]) for part in (before, after))
    gains = np.sum(np.abs(first) ** 2 - np.abs(second) ** 2, axis=1)
    bands, place = np.unique(run.rows.band, return_inverse=True)
    # A line that lies between two bands is in both.
    line = np.concatenate([[0], np.cumsum(np.diff(bands) > 1)])[place]
    by_line = np.bincount(line, gains)
    return float(by_line.sum() - by_line.max())


def energy_after(hypothesis: Hypothesis, run: Evidence, factor: float, weights: Weights) -> float:
    """Return the energy of all columns of a run once a mistake is undone."""
    corrected = undo(hypothesis, run, factor)
    return float(residuals(run, corrected.forces, corrected.loads, weights).energy.sum())
