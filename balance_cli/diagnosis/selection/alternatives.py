"""What would do as well in an effect's place, and what does better: sets that the data cannot tell apart."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates, tested
from balance_cli.diagnosis.search.point_mass import settled_mass, well_placed
from balance_cli.diagnosis.search.preference import SAME
from balance_cli.diagnosis.search.refit import PENALTY
from balance_cli.diagnosis.search.score_statistics import Score, best_scores, extended, stepped, with_candidates
from balance_cli.diagnosis.selection.confirm import STRONG
from balance_cli.diagnosis.selection.effect_selection import bare, pruned, without
from balance_cli.diagnosis.selection.effect_statistics import effect_wald
from balance_cli.diagnosis.selection.fit import Fit, fitted
from balance_cli.estimation.measurements import Batch
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

# Rivals of an effect that are refitted, and how far the scores of a weak one's may fall short of its own.
MOST_RIVALS = 4
SHORT = 8.0
MOST_REPLACED = 6


@dataclass(frozen=True)
class Standing:
    """What an effect of the closed model gains in chi-square, for how many known parameters, and what does as well."""

    gain: float
    parameters: int
    alike: tuple[str, ...]


@dataclass(frozen=True)
class Contested:
    """The fit with the better of each effect and its rivals, where each then stands, and what was put in its place."""

    fit: Fit
    standings: dict[str, Standing]
    trials: tuple[Trial, ...]


def contested(
    fit: Fit,
    batches: Sequence[Batch],
    given: Collection[str],
    rivals: Mapping[str, Sequence[str]],
    count: int,
    number: int,
    say: Callable[[str], None],
) -> Contested:
    """Every effect that is not `given` against its rivals: those of its round (labels), or of a weak one all.

    A rival takes the place of an effect where it explains more than can be chance or its parameters can make. What it
    makes needless goes, and all are looked at once more: two small effects may have stood for one of many parameters.
    """
    rivals, trials = dict(rivals), list[Trial]()
    standings: dict[str, Standing] = {}
    while label := next((one.label for one in _added(fit, given) if one.label not in standings), None):
        say(f"evidence of {label}")
        one = _placed(fit, label)
        gain, known = effect_wald(fit, one)
        less = without(fit, one, batches) if gain < STRONG else None
        ends = _ends(fit, one, batches, rivals.get(label, ()), less)
        better = _better(fit, one, ends)
        if better is None or len(trials) >= 2 * MOST_REPLACED:
            gain = gain if less is None else less.chi2 - fit.chi2
            alike = tuple(name for name, end in ends.items() if end.chi2 - fit.chi2 <= SAME)
            standings[label] = Standing(gain, known, alike)
            continue
        trials += _replaced(number, one, better, fit.chi2 - ends[better].chi2, known)
        rivals[better] = (label, *rivals.get(label, ()))
        fit, removed = pruned(ends[better], batches, count, number)
        trials += removed
        standings.clear()
    return Contested(fit, standings, tuple(trials))


def _added(fit: Fit, given: Collection[str]) -> list[PlacedEffect]:
    return [one for one in declared_effects(fit.model.geometry) if one.label not in given]


def _placed(fit: Fit, label: str) -> PlacedEffect:
    return next(one for one in declared_effects(fit.model.geometry) if one.label == label)


def _ends(
    fit: Fit, one: PlacedEffect, batches: Sequence[Batch], names: Sequence[str], less: Fit | None
) -> dict[str, Fit]:
    """The fits with rivals in the effect's place. `less`: the model without a weak one, whose scores name them."""
    if less is not None:
        near = _near(less, one, batches, less.chi2 - fit.chi2)[:MOST_RIVALS]
        return {item.candidate.label: _with(less, item, batches) for item in near}
    possible = {item.label: item for item in candidates(bare(fit.model.geometry, one))}
    known = [name for name in names if name in possible and name != one.label][:MOST_RIVALS]
    return {name: _instead(fit, one, possible[name], batches) for name in known}


def _better(fit: Fit, one: PlacedEffect, ends: Mapping[str, Fit]) -> str | None:
    """The rival that explains most, each parameter paid for; None where the effect itself is as good."""
    own = len(tested(one.parameters))
    worth = {
        label: fit.chi2 - end.chi2 - PENALTY * max(len(tested(_placed(end, label).parameters)) - own, 0)
        for label, end in ends.items()
    }
    best = max(worth, key=lambda label: worth[label], default=None)
    return best if best is not None and worth[best] > SAME else None


def _replaced(number: int, one: PlacedEffect, better: str, gain: float, known: int) -> tuple[Trial, Trial]:
    """Both put down: what came in, and what had to go."""
    nan = float("nan")
    return (
        Trial(number, one.label, nan, known, 1.0, -gain, "removed", f"{better} explains more in its place"),
        Trial(number, better, nan, known, 1.0, gain, "accepted", f"explains more than {one.label}"),
    )


def _with(less: Fit, score: Score, batches: Sequence[Batch]) -> Fit:
    """A candidate fitted from its score's step, or, a mass, from its best place."""
    if not score.candidate.chosen:
        return fitted(*stepped(less.model, less.theta, batches, score), batches)
    geometry = with_candidates(less.model.geometry, [(score.candidate, score.start)])
    model, null = extended(less.model, less.theta, geometry)
    return fitted(model, settled_mass(model, null, batches), batches)


def _instead(fit: Fit, one: PlacedEffect, rival: Candidate, batches: Sequence[Batch]) -> Fit:
    """The model with a rival in the place of an effect, refitted from the best of its starts."""
    others = bare(fit.model.geometry, one)
    (rival,) = well_placed([rival], *extended(fit.model, fit.theta, others), batches)
    if rival.chosen:
        model, null = extended(fit.model, fit.theta, with_candidates(others, [(rival, 0)]))
        return fitted(model, settled_mass(model, null, batches), batches)
    fits = []
    for number in range(len(rival.starts)):
        model, theta = extended(fit.model, fit.theta, with_candidates(others, [(rival, number)], started=True))
        fits.append(fitted(model, theta, batches))
    return min(fits, key=lambda item: item.chi2)


def _near(less: Fit, one: PlacedEffect, batches: Sequence[Batch], lost: float) -> list[Score]:
    """Candidates that score about as well as what was lost with the effect, the best first."""
    found = best_scores(less.model, less.theta, batches, candidates(less.model.geometry))
    near = [item for item in found if item.candidate.label != one.label and item.gain > lost - SHORT - 0.1 * lost]
    return sorted(near, key=lambda item: -item.gain)
