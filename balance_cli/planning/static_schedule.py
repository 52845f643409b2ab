"""Static load schedules: which load points tell the terms of the calibration model, for a given number of points.

The readings of a channel are a zero and a sum of terms of the loads (see `calibration/terms.py`). With the design X
(N, p) of N points, the zero included, the coefficients have the covariance s^2 (X' X)^-1. A D-optimal schedule has the
largest det X'X (Kiefer and Wolfowitz, Can. J. Math. 12 (1960) 363); it is found by adding points one by one, then by
exchanging them (Fedorov, Theory of Optimal Experiments, 1972). It is compared with the same number of points with one
load at a time, up and down in steps: that schedule cannot tell the products of two loads at all.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.term_support import find_supported_terms
from balance_cli.calibration.terms import Term, all_terms, term_values
from balance_cli.io.errors import UserError
from balance_cli.planning.choices import TermSet

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LEVELS: dict[TermSet, tuple[float, ...]] = {
    "linear": (-1.0, 1.0),
    "quadratic": (-1.0, -0.5, 0.5, 1.0),
    "all": (-1.0, -2.0 / 3.0, -1.0 / 3.0, 1.0 / 3.0, 2.0 / 3.0, 1.0),
}
"""Loads of a point over the largest ones: the six functions of one load need three levels on either side."""
REGULARIZATION = 1e-6
"""Information that every coefficient has at first, per point: so that the determinant of few points is not zero."""
MOST_PASSES = 20
"""Passes of the exchange; it ends when none raises the determinant, usually after three to six."""
LEAST_RISE = 1e-9
"""Rise of the log-determinant by which an exchange counts."""
MOST_POINTS = 2000
"""Load points of a schedule: weeks of work."""


@dataclass(frozen=True)
class ScheduleDesign:
    """A schedule of load points (n, k) in units of the largest loads, and what it tells.

    `sigma` (p,): standard deviation of each coefficient (reading at the largest loads) over that of one reading,
    infinite for an aliased term; `aliased` {term: why} are the terms that the points cannot tell.
    """

    points: Array
    sigma: Array
    aliased: dict[str, str]

    @property
    def median_sigma(self) -> float:
        """Median of sigma over the terms that are determined; NaN where none is."""
        determined = self.sigma[np.isfinite(self.sigma)]
        return float(np.median(determined)) if len(determined) else float("nan")


@dataclass(frozen=True)
class StaticSchedule:
    """A D-optimal schedule beside one load at a time with as many points.

    `components` (k,), `largest` (k,) [N, N m]; `terms` (p,) by name. `efficiency`: ratio of the two determinants of the
    terms that both tell, per term: so many times as many points would one load at a time need.
    """

    components: tuple[str, ...]
    largest: tuple[float, ...]
    terms: tuple[str, ...]
    optimal: ScheduleDesign
    one_at_a_time: ScheduleDesign
    efficiency: float


def schedule_terms(count: int, term_set: TermSet) -> tuple[Term, ...]:
    """The terms of `count` loads: `linear`, `quadratic` (loads, squares and products) or `all` (AIAA R-091)."""
    everything = all_terms(count)
    if term_set == "all":
        return everything
    loads = [f"l{i}" for i in range(count)]
    names = {*loads}
    if term_set == "quadratic":
        names |= {f"{name}^2" for name in loads} | {f"{a} {b}" for a, b in itertools.combinations(loads, 2)}
    return tuple(term for term in everything if term.name(loads) in names)


def plan_static_schedule(
    components: Sequence[str], largest: Sequence[float], points: int, term_set: TermSet, together: int
) -> StaticSchedule:
    """Choose the given number of load points, each with at most `together` loads.

    Raises UserError where the points are fewer than the coefficients, or too many.
    """
    terms = schedule_terms(len(components), term_set)
    if not len(terms) + 1 <= points <= MOST_POINTS:
        fault = f"{points} points are not {len(terms) + 1} (the coefficients) to {MOST_POINTS}"
        remedy = "Give fewer points" if points > MOST_POINTS else "Give more points, or fewer --terms"
        raise UserError(fault, "--points", remedy=remedy)
    candidates = candidate_points(len(components), min(together, len(components)), LEVELS[term_set])
    selection = _exchange(_design(terms, candidates), _start(_design(terms, candidates), points))
    optimal = _describe(candidates[np.sort(selection)], terms, components)
    single = _describe(one_load_at_a_time(len(components), points), terms, components)
    return StaticSchedule(
        components=tuple(components),
        largest=tuple(largest),
        terms=tuple(term.name(components) for term in terms),
        optimal=optimal,
        one_at_a_time=single,
        efficiency=_efficiency(optimal, single, terms),
    )


def candidate_points(count: int, together: int, steps: Sequence[float]) -> Array:
    """All points (n, count) with at most `together` loads at the levels, the unloaded one included."""
    rows = [np.zeros(count)]
    for size in range(1, together + 1):
        for places in itertools.combinations(range(count), size):
            for levels in itertools.product(steps, repeat=size):
                row = np.zeros(count)
                row[list(places)] = levels
                rows.append(row)
    return np.array(rows)


def one_load_at_a_time(count: int, points: int) -> Array:
    """Points (points, count) of each load in turn, up and down in equal steps, as near as can be as many each."""
    shares = np.full(count, (points - 1) // count)
    shares[: (points - 1) % count] += 1
    rows = [np.zeros(count)]
    for place, share in enumerate(shares):
        for level in np.concatenate([np.arange(1, (share + 1) // 2 + 1), -np.arange(1, share // 2 + 1)]):
            row = np.zeros(count)
            row[place] = level / ((share + 1) // 2 if level > 0 else share // 2)
            rows.append(row)
    return np.array(rows)


def _design(terms: Sequence[Term], x: Array) -> Array:
    """The design (n, 1 + p) of points (n, k): the zero and the terms."""
    return np.column_stack([np.ones(len(x)), term_values(terms, x)])


def _start(X: Array, points: int) -> Index:
    """Points added one by one, each where the variance of the prediction is largest."""
    inverse = np.eye(X.shape[1]) / REGULARIZATION
    selection = []
    for _ in range(points):
        variance = np.einsum("np,pq,nq->n", X, inverse, X)
        best = int(np.argmax(variance))
        selection.append(best)
        step = inverse @ X[best]
        inverse = inverse - np.outer(step, step) / (1.0 + variance[best])
    return np.array(selection, np.intp)


def _exchange(X: Array, selection: Index) -> Index:
    """Fedorov's exchange: each point by the candidate that raises the determinant most, while any does.

    With d(a, b) = a' M^-1 b the determinant grows by (1 + d(new, new)) (1 - d(old, old)) + d(old, new)^2.
    """
    selection = selection.copy()
    ridge = REGULARIZATION * np.eye(X.shape[1])
    for _ in range(MOST_PASSES):
        changed = False
        for place in range(len(selection)):
            inverse = np.linalg.inv(X[selection].T @ X[selection] + ridge)
            through = X @ inverse
            variance = np.sum(through * X, axis=1)
            cross = through @ X[selection[place]]
            growth = (1.0 + variance) * (1.0 - variance[selection[place]]) + cross**2
            best = int(np.argmax(growth))
            if np.log(max(growth[best], 1e-300)) > LEAST_RISE and best != selection[place]:
                selection[place], changed = best, True
        if not changed:
            break
    return selection


def _describe(x: Array, terms: Sequence[Term], components: Sequence[str]) -> ScheduleDesign:
    """What a schedule tells, all its points having one zero in common."""
    support = find_supported_terms(terms, x, np.zeros(len(x), np.intp), components, jointly=True)
    determined = [i for i, term in enumerate(terms) if term not in support.unsupported]
    X = _design([terms[i] for i in determined], x)
    sigma = np.full(len(terms), np.inf)
    sigma[determined] = np.sqrt(np.diag(np.linalg.inv(X.T @ X)))[1:]
    return ScheduleDesign(x, sigma, {term.name(components): why for term, why in support.unsupported.items()})


def _efficiency(optimal: ScheduleDesign, single: ScheduleDesign, terms: Sequence[Term]) -> float:
    determined = [
        term for i, term in enumerate(terms) if np.isfinite(optimal.sigma[i]) and np.isfinite(single.sigma[i])
    ]
    logs = []
    for design in (optimal, single):
        X = _design(determined, design.points)
        logs.append(float(np.linalg.slogdet(X.T @ X)[1]))
    return float(np.exp((logs[0] - logs[1]) / (len(determined) + 1)))
