"""The choice of runs: what they teach per minute of hall time, greedily, then by exchange.

The worth of a campaign with the information I is the mean of two logarithms,

    1/2 mean over effects, places and parameters of ln (V_ii + 1 / (10 s)^2)      s: size of a change that matters
    - mean over components and harmonics of ln (total sigma of the hub load)

the first one a Ds-criterion with the fitted parameters as nuisance (Atkinson, Donev and Tobias, Optimum Experimental
Designs, 2007, section 10.3), with equal weight for each effect however many places it has. A run is added that raises
the worth most per minute, its own change of set-up included, until no run fits into the time; then single runs are
exchanged for others as long as the worth rises (Fedorov's exchange, ibid. section 12.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.deadline import Deadline
from balance_cli.planning.candidate_runs import CandidateRun
from balance_cli.planning.choices import Aim
from balance_cli.planning.detectability import InformationRows, information_rows, project_rows
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.hub_loads import LoadForecast, parameter_sigma, total_sigma
from balance_cli.planning.information import RunInformation
from balance_cli.planning.result import RankedRun

Array = NDArray[np.float64]
Index = NDArray[np.intp]

COARSEST_SIZE = 10.0
"""Scales of a parameter above which its standard deviation tells nothing: there a run has no worth yet."""
MOST_PASSES = 5
"""Passes of the exchange over all runs; two suffice nearly always."""
LEAST_RISE = 1e-6
"""Rise of the worth by which an exchange counts."""


@dataclass(frozen=True)
class Design:
    """The chosen runs as indices of the candidates, in the order in which they are made, and the minutes they take."""

    chosen: tuple[int, ...]
    minutes: float


@dataclass(frozen=True)
class Problem:
    """What a design is chosen for: candidates with their information, what is known before, times and aim."""

    candidates: Sequence[CandidateRun]
    information: Sequence[RunInformation]
    before: RunInformation
    model: ExtendedModel
    forecast: LoadForecast | None
    change_minutes: float
    aim: Aim

    def minutes(self, runs: Sequence[int]) -> float:
        """Time of runs: their records, and one change for each set-up, the first one included."""
        setups = {self.candidates[i].setup for i in runs}
        return sum(self.candidates[i].minutes for i in runs) + self.change_minutes * len(setups)

    @cached_property
    def _known_before(self) -> InformationRows:
        """That of priors and of the runs already made."""
        return information_rows(self.before.information + self.model.prior_information, self.model)

    @cached_property
    def _rows(self) -> tuple[InformationRows, ...]:
        """That of each candidate."""
        return tuple(information_rows(run.information, self.model) for run in self.information)

    def total(self, runs: Sequence[int]) -> InformationRows:
        """Information of priors, of the runs before, and of the chosen ones."""
        return sum((self._rows[i] for i in runs), self._known_before)

    def worth(self, runs: Sequence[int]) -> float:
        """Worth of what is known after the chosen runs."""
        return campaign_worth(self.total(runs), self.model, self.forecast, self.aim)

    def worth_with(self, known: InformationRows, run: int) -> float:
        """Worth of what is known after one run more than those of the total `known`."""
        return campaign_worth(known + self._rows[run], self.model, self.forecast, self.aim)


def campaign_worth(total: InformationRows, model: ExtendedModel, forecast: LoadForecast | None, aim: Aim) -> float:
    """Worth of the information of a campaign (see the head of the module)."""
    projected = project_rows(total, model)
    worth = 0.0
    if aim != "loads" or forecast is None:
        worth += effect_worth(projected.diagonal, model)
    if aim != "effects" and forecast is not None:
        worth -= float(np.mean(np.log(total_sigma(forecast, model, projected.covariance))))
    return worth


def effect_worth(diagonal: Array, model: ExtendedModel) -> float:
    """The part of the worth that comes from the effects, by the diagonal (t,) of V; zero without any."""
    if not model.candidates:
        return 0.0
    value = 0.5 * np.log(diagonal * model.scales**2 + COARSEST_SIZE**-2)
    names = model.tested_effects
    return float(np.mean([value[names == name].mean() for name in dict.fromkeys(names)]))


def choose_runs(problem: Problem, minutes: float, deadline: Deadline) -> Design:
    """The most informative runs within `minutes`; none where none fits. After the deadline none is exchanged."""
    selection = _add_greedily(problem, minutes)
    for _ in range(MOST_PASSES):
        if deadline.is_over:
            break
        better = _exchange_once(problem, selection, minutes)
        better = _add_greedily(problem, minutes, better)
        if better == selection:
            break
        selection = better
    ordered = _order_by_setup(problem, selection)
    return Design(tuple(ordered), problem.minutes(ordered))


def _add_greedily(problem: Problem, minutes: float, selection: Sequence[int] = ()) -> list[int]:
    selection = list(selection)
    worth, used = problem.worth(selection), problem.minutes(selection)
    while True:
        trials, known = [], problem.total(selection)
        for i in range(len(problem.candidates)):
            time = problem.minutes([*selection, i])
            if time <= minutes + 1e-9:
                gain = problem.worth_with(known, i) - worth
                trials.append((gain / max(time - used, 1e-9), -i, gain, time))
        rising = [trial for trial in trials if trial[2] > LEAST_RISE]
        if not rising:
            return selection
        _, negative, gain, time = max(rising)
        selection.append(-negative)
        worth, used = worth + gain, time


def _exchange_once(problem: Problem, selection: Sequence[int], minutes: float) -> list[int]:
    """One pass over the chosen runs, each of which the best other run may replace."""
    selection = list(selection)
    worth = problem.worth(selection)
    for place in range(len(selection)):
        best = (worth + LEAST_RISE, selection[place])
        known = problem.total([*selection[:place], *selection[place + 1 :]])
        for i in range(len(problem.candidates)):
            trial = [*selection[:place], i, *selection[place + 1 :]]
            if i != selection[place] and problem.minutes(trial) <= minutes + 1e-9:
                best = max(best, (problem.worth_with(known, i), i))
        worth, selection[place] = (best[0], best[1]) if best[1] != selection[place] else (worth, selection[place])
    return selection


def _order_by_setup(problem: Problem, selection: Sequence[int]) -> list[int]:
    """Runs of one set-up together, the set-ups in the order in which they were chosen first."""
    setups = list(dict.fromkeys(problem.candidates[i].setup for i in selection))
    return sorted(selection, key=lambda i: (setups.index(problem.candidates[i].setup), i))


def rank_runs(problem: Problem, selection: Sequence[int], deadline: Deadline) -> tuple[RankedRun, ...]:
    """Every candidate by itself after what is known before, those that teach most per minute first.

    After the deadline only the chosen ones.
    """
    before = problem.worth(())
    rows = []
    for i in dict.fromkeys((*selection, *range(len(problem.candidates)))):
        if i not in selection and deadline.is_over:
            break
        candidate = problem.candidates[i]
        minutes = problem.minutes([i])
        rows.append(RankedRun(candidate.plan.run, minutes, problem.worth([i]) - before, _load_ratio(problem, i)))
    return tuple(sorted(rows, key=lambda row: (-row.worth / row.minutes, row.run)))


def _load_ratio(problem: Problem, candidate: int) -> float | None:
    """Mean ratio of the part of the loads' sigma by the parameters, with a run over without; None without a rotor."""
    if problem.forecast is None:
        return None
    model, forecast = problem.model, problem.forecast
    with_run, without = (
        parameter_sigma(forecast, model, project_rows(problem.total(runs), model).covariance)
        for runs in ((candidate,), ())
    )
    known = (with_run > 0) & (without > 0)
    return float(np.exp(np.mean(np.log(with_run[known] / without[known])))) if known.any() else None
