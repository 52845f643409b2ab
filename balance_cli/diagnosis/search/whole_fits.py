"""Effects that are tried by whole fits where a model misses a large part of the response: their scores are too small.

A delay of all channels against the loads (a command recorded in place of the force, one late box) turns the phase at
a resonance by tens of degrees. A fit without it ends at a damping far above the declared one, which turns the phase in
the same way, and there the score of the delay is small. With the effect in the model a regression on the equations of
motion comes near the truth (`estimation.starting_values`). The channels of a cell cannot show such an effect, as all
have it.

A support as soft and as heavy as the balance splits a mode in two far from its place. A fit without it ends between
the two, where no small compliance helps; a mode of free shape and a false gain of the load would describe more. Such a
body is also tried where the rounds of the search have ended with a large error: a lighter one is hidden by what they
take in its place. The modes of a heavy one may all be below those of the balance. No start has all of its motions right
then; from the lowest lines on, where each is a deflection, a regression finds them together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from balance_cli.campaign.rig.channel_groups import ALL, channel_groups
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.body_fits import fit_by_bands, fit_by_measured_motion
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.search.refit import SearchState, whole_fit
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import gain_p_value

REASON = "the model misses a large part of the response, and a whole fit with it describes more"


def add_all_by_whole_fit(
    state: SearchState, together: Sequence[Candidate], lines: SearchLines, settings: SearchSettings
) -> tuple[SearchState, tuple[Trial, ...], dict[str, dict[str, float]]]:
    """Return the state with several candidates at once, fitted from their starts, as `add_by_whole_fit`.

    One alone is left to the rounds of the search, and so are all of them where little is missing.
    """
    if len(together) < 2 or state.error <= settings.rounds.stuck_error:
        return state, (), {}
    end = whole_fit(state, together, lines, settings)
    accepted = describes_more(end, state, settings)
    gain = state.fit_criterion - end.fit_criterion - settings.parameter_cost * (len(end.theta) - len(state.theta))
    trials = tuple(whole_fit_trial(item.label, gain, accepted, 1) for item in together)
    return (end, trials, {item.label: {item.label: gain} for item in together}) if accepted else (state, trials, {})


def describes_more(end: SearchState, current: SearchState, settings: SearchSettings) -> bool:
    """Return whether a whole fit has a clearly smaller error than the current state, on the validation lines, too."""
    is_smaller = end.error < settings.rounds.slow_progress * current.error
    return is_smaller and end.validation_criterion < current.validation_criterion


def add_by_whole_fit(
    state: SearchState, lines: SearchLines, settings: SearchSettings
) -> tuple[SearchState, tuple[Trial, ...], dict[str, dict[str, float]]]:
    """Return the state with the common effect that describes most, the trials, and the gains of all by its label.

    The state stays where its error is not gross, and where no effect lowers the error clearly on both sets of lines.
    """
    if state.error <= settings.rounds.gross_error:
        return state, (), {}
    attempts = (*_common_attempts(state, settings), *_attempts_with_bodies(state, settings))
    accepted, trials, gains = _best_whole_fit(state, state, attempts, lines, 1, settings)
    return accepted or state, trials, gains


def add_body_by_whole_fit(
    base: SearchState,
    current: SearchState,
    lines: SearchLines,
    number: int,
    settings: SearchSettings,
    quick: bool = False,
) -> tuple[SearchState | None, tuple[Trial, ...], dict[str, dict[str, float]]]:
    """Return the state `base` with a further body that describes more than the `current` one, as `add_by_whole_fit`.

    `current`: where rounds from `base` have ended, with a large error. None without such a body. Trials have this round
    `number`. `quick`: without the restarts, which are many.
    """
    attempts = [item for item in _attempts_with_bodies(base, settings) if item.is_enough or not quick]
    return _best_whole_fit(base, current, attempts, lines, number, settings)


@dataclass(frozen=True)
class _Attempt:
    """A whole fit with the candidate of a label, from one start; None where the start does not exist.

    With `is_enough` no further one of the same candidate is tried where this one leaves no large error.
    """

    label: str
    fit: Callable[[SearchState, SearchLines, SearchSettings], SearchState | None]
    is_enough: bool = False

    @classmethod
    def from_start(cls, candidate: Candidate) -> _Attempt:
        """The attempt from the first start of a candidate."""
        return cls(candidate.label, lambda base, lines, settings: whole_fit(base, [candidate], lines, settings))


def _best_whole_fit(
    base: SearchState,
    current: SearchState,
    attempts: Sequence[_Attempt],
    lines: SearchLines,
    number: int,
    settings: SearchSettings,
) -> tuple[SearchState | None, tuple[Trial, ...], dict[str, dict[str, float]]]:
    """The whole fit of `base` with one candidate that describes clearly more than `current`, None without one."""
    ends, done = dict[str, SearchState](), set[str]()
    for attempt in attempts:
        if settings.fit.is_over:
            break
        end = None if attempt.label in done else attempt.fit(base, lines, settings)
        if end is None:
            continue
        if attempt.label not in ends or end.fit_criterion < ends[attempt.label].fit_criterion:
            ends[attempt.label] = end
        if attempt.is_enough and end.error <= settings.rounds.large_error:
            done.add(attempt.label)
    gains = {
        label: base.fit_criterion - end.fit_criterion - settings.parameter_cost * (len(end.theta) - len(base.theta))
        for label, end in ends.items()
    }
    best = max(gains, key=lambda label: gains[label], default=None)
    accepted = best if best is not None and describes_more(ends[best], current, settings) else None
    trials = tuple(whole_fit_trial(label, gain, label == accepted, number) for label, gain in gains.items())
    if accepted is None:
        return None, trials, {}
    return ends[accepted], trials, {accepted: gains}


def _common_attempts(state: SearchState, settings: SearchSettings) -> Sequence[_Attempt]:
    """The effects that turn the phase of a channel, at the group of most channels, or of the loads of all exciters."""
    place, found = _widest_group(state.geometry), list[_Attempt]()
    for item in candidates(state.geometry, excluded=settings.excluded):
        where, hints = item.placed_effect.where, item.effect.search
        ratio, starts = hints.channel_ratio, hints.whole_fit_starts
        if where == (place,) and ratio is not None and not ratio.sensitivity:
            found.append(_Attempt.from_start(item))
        elif where == (ALL,) and starts is not None:
            found += [_Attempt.from_start(replace(item, starts=(start,))) for start in starts(state.geometry)]
    return found


def _attempts_with_bodies(state: SearchState, settings: SearchSettings) -> Sequence[_Attempt]:
    """The effects that bring a further body: by bands, from its measured motion, and from restarts far from their null.

    The bands find a heavy body from a light one. A soft one has no band below its resonance; its motion shows it.
    """
    pool = [
        item
        for item in candidates(state.geometry, excluded=settings.excluded)
        if item.effect.search.restarts is not None and item.effect.search.point_mass is None
    ]
    restarts = [
        replace(item, starts=({**item.starts[0], **values},))
        for item in pool
        for values in item.effect.search.restart_values(state.geometry, item.placed_effect.where)
    ]
    return [
        *(_Attempt(item.label, partial(fit_by_bands, item), is_enough=True) for item in pool),
        *(_Attempt(item.label, partial(fit_by_measured_motion, item), is_enough=True) for item in pool),
        *map(_Attempt.from_start, restarts),
    ]


def _widest_group(geometry: Geometry) -> str:
    """The group of most channels, or the only channel."""
    groups = channel_groups(geometry)
    return max(groups, key=lambda name: len(groups[name]), default=geometry.channel_names[0])


def whole_fit_trial(label: str, gain: float, accepted: bool, number: int) -> Trial:
    """Return the trial of one effect in a whole fit of round `number`."""
    return Trial(
        round=number,
        label=label,
        score=float("nan"),
        parameters=1,
        p_value=gain_p_value(gain, 1),
        gain=gain,
        decision="accepted" if accepted else "rejected",
        reason=REASON if accepted else "a whole fit with it describes no more",
    )
