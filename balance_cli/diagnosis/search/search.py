"""The search: while the model has an error, add the effect that reduces it most; restart where the search is stuck.

Every fit has a model error (see `estimation.model_error`), so that the ranking does not depend on the noise alone. The
search ends when no candidate lowers -2 ln likelihood both on the fitted lines and on the validation lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates, suspected_candidates
from balance_cli.diagnosis.search.initial_candidates import InitialCandidates
from balance_cli.diagnosis.search.refit import SearchState, fit_until_stable, fit_with_candidate, restart
from balance_cli.diagnosis.search.restarts import restart_one_by_one
from balance_cli.diagnosis.search.rounds import RoundResult, search_round
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.set_ups import add_set_ups_by_whole_fit
from balance_cli.diagnosis.search.trials import last_round
from balance_cli.diagnosis.search.unmodelled_modes import add_resonance_by_whole_fit
from balance_cli.diagnosis.search.whole_fits import add_all_by_whole_fit, add_body_by_whole_fit, add_by_whole_fit
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.io.percent import percent_text
from balance_cli.model.balance import Estimate
from balance_cli.model.placed_effects import declared_effects

Announce = Callable[[str], bool]

SUPERSEDED = "a fit of other effects from the beginning describes more"


@dataclass(frozen=True)
class SearchResult:
    """Where the search ended, what it tried, and for each effect the gains of all candidates of its round."""

    state: SearchState
    trials: tuple[Trial, ...] = ()
    alternatives: dict[str, dict[str, float]] = field(default_factory=dict)

    def add(
        self, state: SearchState, trials: Sequence[Trial], alternatives: dict[str, dict[str, float]]
    ) -> SearchResult:
        """Return the result after a further step."""
        return SearchResult(state, (*self.trials, *trials), {**self.alternatives, **alternatives})

    def supersede(self, first: int) -> SearchResult:
        """Return the result with what was accepted from a trial (index) on as removed: a whole fit takes its place."""
        trials = (
            replace(trial, decision="removed", reason=SUPERSEDED) if trial.decision == "accepted" else trial
            for trial in self.trials[first:]
        )
        return replace(self, trials=(*self.trials[:first], *trials))


def search(
    start: Estimate,
    lines: SearchLines,
    announce: Announce,
    initial_sets: Sequence[InitialCandidates],
    find_late: Callable[[], Sequence[Candidate]],
    of_set_ups: Sequence[Candidate],
    settings: SearchSettings,
) -> SearchResult:
    """Add effects one by one until none helps; where the error stays large, fit everything again from the regression.

    The effects that the data demand without a model come first, those of late channels together, which are looked for
    where much is missing. `of_set_ups`: what every set-up may have. `announce` returns whether the time is over.
    """
    result = _add_before_rounds(start, lines, initial_sets, find_late, settings)
    base, first = result.state, len(result.trials)
    result = _add_effects(result, 1, lines, announce, settings, of_set_ups)
    if result.state.error <= settings.rounds.stuck_error or announce("whole fits of a further body"):
        return result
    last = last_round(result.trials)
    # A body far from its null, in whose place the rounds took what is not there.
    with_body, trials, gains = add_body_by_whole_fit(base, result.state, lines, last + 1, settings)
    if with_body is None:
        return result.add(result.state, trials, gains)
    result = result.supersede(first).add(with_body, trials, gains)
    return _add_effects(result, last + 2, lines, announce, settings)


def _add_before_rounds(
    start: Estimate,
    lines: SearchLines,
    initial_sets: Sequence[InitialCandidates],
    find_late: Callable[[], Sequence[Candidate]],
    settings: SearchSettings,
) -> SearchResult:
    """What the data demand without a model, then the common effects and those that the user names."""
    result = SearchResult(fit_until_stable(start, lines, settings.fit))
    if result.state.error > settings.rounds.stuck_error:
        result = result.add(*add_all_by_whole_fit(result.state, find_late(), lines, settings))
    for initial_set in initial_sets:
        present = {effect.label for effect in declared_effects(result.state.geometry)}
        if settings.fit.is_over:
            break
        if not present.isdisjoint(item.label for item in initial_set.candidates):
            continue
        result = _add_initial_candidate(result, initial_set, lines, settings)
    result = result.add(*add_by_whole_fit(result.state, lines, settings))
    for word in settings.suspected:
        pool = () if settings.fit.is_over else suspected_candidates(word, result.state.geometry)
        added = search_round(result.state, lines, 1, pool, settings) if pool else RoundResult(None)
        result = result.add(added.state or result.state, added.trials, added.alternatives)
    return result


def _add_effects(
    result: SearchResult,
    first_round: int,
    lines: SearchLines,
    announce: Announce,
    settings: SearchSettings,
    of_set_ups: Sequence[Candidate] = (),
) -> SearchResult:
    """Add effects one by one until none helps; where the error stays large, fit everything again.

    Where the first one leaves a large error, those `of_set_ups` are tried in its place, all at once.
    """
    limits, stuck, sought = settings.rounds, False, False
    base, first, tried = result.state, len(result.trials), None
    for number in range(first_round, first_round + limits.max_effects):
        state = result.state
        stage = f"search, round {number}: model error {percent_text(state.error)} %"
        if state.error < limits.small_error or announce(stage):
            break
        added = search_round(state, lines, number, candidates(state.geometry, excluded=settings.excluded), settings)
        result = result.add(added.state or state, added.trials, added.alternatives)
        if number == first_round:
            found, trials, gains = add_set_ups_by_whole_fit(base, result.state, of_set_ups, lines, number, settings)
            result = result if found is None else result.supersede(first)
            result = result.add(found or result.state, trials, gains)
            if found is not None:
                continue
        if not stuck and _is_slow(state, added.state, settings):
            better = None if sought else _describe_anew(base, result, first, lines, number, settings)
            sought = True
            if better is None:
                restarted = restart_if_better(result.state, lines, settings)
                stuck, tried = restarted is None, result.state
                better = None if restarted is None else replace(result, state=restarted)
            if better is not None:
                result = better
                continue
        elif added.state is not None:
            stuck = False
        if added.state is None:
            break
    if result.state.error > limits.large_error and result.state is not tried:
        result = replace(result, state=restart_if_better(result.state, lines, settings) or result.state)
    return result


def _describe_anew(
    base: SearchState, result: SearchResult, first: int, lines: SearchLines, number: int, settings: SearchSettings
) -> SearchResult | None:
    """The result with a body or one resonance in place of all that was accepted from trial `first` on, after `base`.

    None where little is missing, or where neither describes all.
    """
    if result.state.error <= settings.rounds.stuck_error:
        return None
    state, trials, gains = add_body_by_whole_fit(base, result.state, lines, number, settings, quick=True)
    if state is None:
        state, trials = add_resonance_by_whole_fit(base, result.state, lines, number, settings)
    return None if state is None else result.supersede(first).add(state, trials, gains)


def _is_slow(before: SearchState, after: SearchState | None, settings: SearchSettings) -> bool:
    """Whether a round that left a large error made little progress: the fit may be in a wrong minimum."""
    if before.error <= settings.rounds.large_error:
        return False
    return after is None or after.error > settings.rounds.slow_progress * before.error


def _add_initial_candidate(
    result: SearchResult, initial_set: InitialCandidates, lines: SearchLines, settings: SearchSettings
) -> SearchResult:
    """Add the candidate of a set that fits the data of the whole rig best."""
    state = result.state
    ends = {item.label: fit_with_candidate(state, item, lines, settings.fit) for item in initial_set.candidates}
    gains = {label: state.fit_criterion - end.fit_criterion for label, end in ends.items()}
    best = min(ends, key=lambda label: ends[label].fit_criterion)
    is_added = initial_set.is_certain or gains[best] > settings.parameter_cost
    trials = [
        Trial(
            round=0,
            label=label,
            score=initial_set.gain,
            parameters=1,
            p_value=0.0,
            gain=gain - settings.parameter_cost,
            decision="accepted" if label == best and is_added else "rejected",
            reason=initial_set.reason if label == best else "another one fits the plate better",
        )
        for label, gain in gains.items()
    ]
    return result.add(ends[best], trials, {best: gains}) if is_added else result.add(state, trials, {})


def restart_if_better(state: SearchState, lines: SearchLines, settings: SearchSettings) -> SearchState | None:
    """Return the same effects, fitted again from other values; None where no fit is better.

    The regression comes first. Where its error is large too, single motions are restarted, one after another.
    """
    if settings.fit.is_over:
        return None
    restarted = restart(state, lines, settings.fit)
    best = restarted if restarted.fit_criterion < state.fit_criterion else state
    if best.error > settings.rounds.large_error:
        best = restart_one_by_one(best, lines, settings)
    return best if best.fit_criterion < state.fit_criterion - settings.parameter_cost else None
