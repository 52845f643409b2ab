"""What of a closed model is needed: each effect's evidence, what can go, and what would do as well in its place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosed import Trial
from balance_cli.diagnosis.candidates import Candidate, candidate_at, candidates, smaller_places, tested
from balance_cli.diagnosis.confirm import SIGNIFICANT, STRONG, Fit, chance, fitted
from balance_cli.diagnosis.preference import SAME
from balance_cli.diagnosis.score import Score, best_scores, extended, stepped, with_candidates
from balance_cli.effects import Where
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.support import covariance_of
from balance_cli.geometry import DeclaredEffect, Geometry
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

Array = NDArray[np.float64]

# Rivals of a weak effect that are refitted, and how far their scores may fall short of its own.
MOST_RIVALS = 4
SHORT = 8.0
# Probability beyond which a motion of an effect is as well left out.
NEEDLESS = 1e-3


def wald(fit: Fit, names: Iterable[str], nulls: Iterable[float]) -> tuple[float, int]:
    """Chi-square of parameters against their nulls, the others free to follow (Wald), and how many are known."""
    parameters = fit.model.parameters
    free = [name for name, is_free in zip(parameters.names, parameters.free, strict=True) if is_free]
    covariance = covariance_of(fit.minimum.total.information)
    known = [
        (free.index(name), fit.theta[parameters.index(name)] - null)
        for name, null in zip(names, nulls, strict=True)
        if name in free and covariance[free.index(name), free.index(name)] > 0
    ]
    if not known:
        return 0.0, 0
    index, departure = np.array([i for i, _ in known]), np.array([d for _, d in known])
    block = covariance[np.ix_(index, index)]
    return float(departure @ np.linalg.lstsq(block, departure, rcond=1e-10)[0]), len(known)


def effect_wald(fit: Fit, one: PlacedEffect) -> tuple[float, int]:
    """The same for all of an effect's parameters that do something by themselves."""
    items = tested(one.parameters)
    return wald(fit, [one.full_name(item) for item in items], [item.fitted_null for item in items])


def without(fit: Fit, one: PlacedEffect, batches: Sequence[Batch]) -> Fit:
    """The model without an effect, refitted."""
    model, theta = extended(fit.model, fit.theta, _bare(fit.model.geometry, one))
    return fitted(model, theta, batches)


def _in_order(geometry: Geometry) -> list[PlacedEffect]:
    """Placed effects in the order in which the geometry declares them."""
    return [declared_effects(geometry.model_copy(update={"effects": (item,)}))[0] for item in geometry.effects]


def instead(fit: Fit, one: PlacedEffect, rival: Candidate, batches: Sequence[Batch]) -> Fit:
    """The model with a rival in the place of an effect, refitted from the best of its starts."""
    bare = _bare(fit.model.geometry, one)
    fits = []
    for number in range(len(rival.starts)):
        model, theta = extended(fit.model, fit.theta, with_candidates(bare, [(rival, number)], started=True))
        fits.append(fitted(model, theta, batches))
    return min(fits, key=lambda item: item.chi2)


def pruned(fit: Fit, batches: Sequence[Batch], count: int, number: int) -> tuple[Fit, tuple[Trial, ...]]:
    """The model without effects, and without motions of effects, that later ones have made needless."""
    trials: list[Trial] = []
    for one in sorted(declared_effects(fit.model.geometry), key=lambda item: effect_wald(fit, item)[0]):
        gain, known = effect_wald(fit, one)
        if gain < STRONG and chance(gain, max(known, 1), count) >= SIGNIFICANT:
            less = without(fit, one, batches)
            if chance(less.chi2 - fit.chi2, max(known, 1), count) >= SIGNIFICANT:
                trials.append(_removed(number, one, known, less.chi2 - fit.chi2))
                fit = less
                continue
        fit, smaller = _narrowed(fit, one, batches, number)
        trials += smaller
    return fit, tuple(trials)


def _removed(number: int, one: PlacedEffect, known: int, gain: float) -> Trial:
    return Trial(number, one.label, gain, known, 1.0, gain, "removed", "later effects have made it needless")


def _narrowed(fit: Fit, one: PlacedEffect, batches: Sequence[Batch], number: int) -> tuple[Fit, list[Trial]]:
    """The effect at a smaller place, as long as nothing is lost by it."""
    trials: list[Trial] = []
    while True:
        choices = [(where, *_lost(fit, one, where)) for where in smaller_places(one, fit.model.geometry)]
        choices = [item for item in choices if chance(item[1], max(item[2], 1), 1) > NEEDLESS]
        if not choices:
            return fit, trials
        where, _, known = min(choices, key=lambda item: item[1])
        less, smaller = _at(fit, one, where, batches)
        if chance(less.chi2 - fit.chi2, max(known, 1), 1) <= NEEDLESS:
            return fit, trials
        why = f"nothing is lost at {smaller.label}"
        trials.append(Trial(number, one.label, less.chi2 - fit.chi2, known, 1.0, less.chi2 - fit.chi2, "narrowed", why))
        fit, one = less, smaller


def _lost(fit: Fit, one: PlacedEffect, where: Where) -> tuple[float, int]:
    """Wald's chi-square of the parameters that the smaller place does not have."""
    kept = {item.name for item in candidate_at(one.effect.name, where, fit.model.geometry).one.parameters}
    gone = [item for item in tested(one.parameters) if item.name not in kept]
    return wald(fit, [one.full_name(item) for item in gone], [item.fitted_null for item in gone])


def _at(fit: Fit, one: PlacedEffect, where: Where, batches: Sequence[Batch]) -> tuple[Fit, PlacedEffect]:
    """The same effect at another place, refitted from the same values."""
    geometry = fit.model.geometry
    smaller = candidate_at(one.effect.name, where, geometry).one
    known = {item.name for item in smaller.parameters}
    effects = tuple(
        DeclaredEffect(name=item.name, where=where, parameters={k: v for k, v in item.parameters.items() if k in known})
        if placed.label == one.label
        else item
        for item, placed in zip(geometry.effects, _in_order(geometry), strict=True)
    )
    model, theta = extended(fit.model, fit.theta, geometry.model_copy(update={"effects": effects}))
    for item in smaller.parameters:
        was = one.full_name(item)
        theta[model.parameters.index(smaller.full_name(item))] = fit.theta[fit.model.parameters.index(was)]
    return fitted(model, theta, batches), smaller


def indistinguishable(
    fit: Fit, one: PlacedEffect, batches: Sequence[Batch], rivals: Iterable[str], less: Fit | None
) -> tuple[str, ...]:
    """Labels of what explains the same data within a log-likelihood of 3 when it stands in the effect's place.

    `less`: the model without a weak effect, refitted; the scores there say who else would gain as much.
    """
    if less is not None:
        near = _near(less, one, batches, less.chi2 - fit.chi2)[:MOST_RIVALS]
        ends = {item.candidate.label: fitted(*stepped(less.model, less.theta, batches, item), batches) for item in near}
    else:
        possible = {item.label: item for item in candidates(_bare(fit.model.geometry, one))}
        names = [name for name in rivals if name in possible][:MOST_RIVALS]
        ends = {name: instead(fit, one, possible[name], batches) for name in names}
    return tuple(name for name, end in ends.items() if end.chi2 - fit.chi2 <= SAME)


def _bare(geometry: Geometry, one: PlacedEffect) -> Geometry:
    kept = [
        item for item, placed in zip(geometry.effects, _in_order(geometry), strict=True) if placed.label != one.label
    ]
    return geometry.model_copy(update={"effects": tuple(kept)})


def _near(less: Fit, one: PlacedEffect, batches: Sequence[Batch], lost: float) -> list[Score]:
    """Candidates that score about as well as what was lost with the effect, the best first."""
    found = best_scores(less.model, less.theta, batches, candidates(less.model.geometry))
    near = [item for item in found if item.candidate.label != one.label and item.gain > lost - SHORT - 0.1 * lost]
    return sorted(near, key=lambda item: -item.gain)
