"""Loads whose load series, or whose two directions, contradict each other in sign or size although they were fitted.

Where one load series alone has each direction of a load, a unit that differs between them looks like a term |F|: the
fit is good, and the balance would be wrong by a factor in one direction. No balance responds to one direction more than
twice as much as to the other. Each direction of a load in each load series is therefore given a response of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.contradiction import PLAUSIBLE_FACTORS
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.load_series import describe_load_series
from balance_cli.calibration.series_causes import factor_words
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_SQUARED_T = 400.0
"""Squared response over its variance, of all channels, from which it is known to 5 %: a factor of two is then 10
standard errors. A channel that is precise, as a torque meter, does not stand for the others, which have a part in the
factor."""
MIN_ROWS = 3
"""Rows of a direction: two that stand out from a fit may be outliers that were too few to be excluded."""
MIN_CHANGE = 0.05
"""Share of a channel's range that a direction must cause: below it hysteresis and other loads act as much."""
LEAST_LIKENESS = 0.5
"""Cosine of two responses from which they are those of one load: exchanged channels make them unlike."""
MIN_STEP = 0.05
"""Share of the largest load of a direction by which two of its loads must differ to tell a response."""
MIN_OWN_SHARE = 0.05
"""Part of its column that the other directions and zeros must leave, as amplitude."""
MAX_SHARED = 1e-3
"""Part of a response that may go to other directions, in the generalized inverse of a singular matrix: rounding."""
MIN_DOF = 3
"""Degrees of freedom by which the responses are compared with their scatter: the t of fewer has no variance."""
MAX_DIRECTIONS = 200
"""Directions of all load series that are kept apart; with more of them each direction of a load is one."""


@dataclass(frozen=True)
class _Direction:
    """Rows (m,) in which load j has one sign in one load series; its response (c,) over the range of each channel."""

    j: int
    rows: Mask
    response: Array


def check_load_directions(points: CalibrationPoints, given: Mask, used: Mask) -> None:
    """Raise UserError for loads that contradict each other in sign or by more than a factor of two.

    `used` (m,): the rows that were fitted; `given` (m,): these, and those that were excluded. A load series that was
    excluded is compared, too, where one other direction of its load contradicts it, and none decides: the sound one may
    have been excluded.
    """
    out = given & ~used
    fitted = np.isin(points.load_series, points.load_series[used])
    series, number = np.unique(points.load_series[out & fitted], return_counts=True)
    # Where so many rows of one series are outliers, the series is wrong, and the rest of it was fitted.
    doubtful = out & fitted & np.isin(points.load_series, series[number >= MIN_ROWS])
    _refuse(points, _directions(points, used | doubtful), ties_alone=False)
    if np.any(out & ~fitted) and points.declared_response is None:
        _refuse(points, _directions(points, used | (out & ~fitted)), ties_alone=True)


def _refuse(points: CalibrationPoints, found: list[_Direction], ties_alone: bool) -> None:
    for j in dict.fromkeys(each.j for each in found):
        of_load = [each for each in found if each.j == j]
        pairs = [(a, b) for a, b in combinations(range(len(of_load)), 2) if _contradict(of_load[a], of_load[b])]
        if not pairs:
            continue
        against = [sum(place in pair for pair in pairs) for place in range(len(of_load))]
        wrong = int(np.argmax(against))
        other = next(a + b - wrong for a, b in pairs if wrong in (a, b))
        is_tie = against[wrong] == against[other]
        if is_tie or not ties_alone:
            raise _error(points, of_load[wrong], of_load[other], not is_tie)


def _contradict(one: _Direction, other: _Direction) -> bool:
    """Whether two directions have responses of other size or sign, as far as they are alike."""
    low, high = PLAUSIBLE_FACTORS
    cosine = one.response @ other.response / (np.linalg.norm(one.response) * np.linalg.norm(other.response))
    return bool(cosine < -LEAST_LIKENESS or (cosine > LEAST_LIKENESS and not low <= _factor(one, other) <= high))


def _factor(one: _Direction, other: _Direction) -> float:
    """How many times the stated loads of `one` are its true ones, if the other's are; negative for the other sign."""
    ratio = float(np.linalg.norm(one.response) / np.linalg.norm(other.response))
    return ratio if float(one.response @ other.response) >= 0.0 else -ratio


def _error(points: CalibrationPoints, wrong: _Direction, other: _Direction, is_minority: bool) -> UserError:
    name, place = points.components[wrong.j], _words(points, wrong)
    words = factor_words(_factor(wrong, other))
    doubt = "" if is_minority else ", or the reverse: no other load series shows which is wrong"
    return UserError(
        f"contradicts {_words(points, other)} in the sign or the size of {name}: {words}{doubt}",
        place,
        remedy="Correct the loads or the readings of the wrong one, or leave it out",
    )


def _words(points: CalibrationPoints, direction: _Direction) -> str:
    rows = np.flatnonzero(direction.rows)
    run = int(points.run[rows[0]])
    in_run = rows[points.run[rows] == run] - int(np.flatnonzero(points.run == run)[0])
    loads = points.x[points.run == run][:, [direction.j]] / np.max(np.abs(points.x[rows, direction.j]))
    return describe_load_series(in_run, points.run_names[run], [points.components[direction.j]], loads)


def _directions(points: CalibrationPoints, used: Mask) -> list[_Direction]:
    """The directions of all loads whose response the used rows (m,) tell, each time they are applied if they do."""
    series = np.unique(points.load_series, return_inverse=True)[1]
    for part in (_excursions(points.x, series, used), _by_series(series), np.zeros((len(series), points.x.shape[1]))):
        masks = _direction_masks(points.x, part, used)
        if 0 < len(masks) <= MAX_DIRECTIONS and (known := _responses(points, used, series, masks)) is not None:
            return known
    return []


def _responses(
    points: CalibrationPoints, used: Mask, series: NDArray[np.intp], masks: list[tuple[int, Mask]]
) -> list[_Direction] | None:
    """Responses that the rows tell of directions (load and rows); None where there are too few rows."""
    covered = np.zeros_like(points.x, bool)
    for j, rows in masks:
        covered[rows, j] = True
    rest = np.where(covered, 0.0, points.x)
    own = [np.where(rows, points.x[:, j], 0.0) for j, rows in masks]
    X = np.column_stack([*own, rest[:, np.any(rest[used] != 0.0, axis=0)]])[used]
    A, y = subtract_block_means(X, series[used]), subtract_block_means(points.channels[used], series[used])
    A = A / np.maximum(np.linalg.norm(A, axis=0), np.finfo(float).tiny)
    dof = len(A) - len(np.unique(series[used])) - A.shape[1]
    if dof < MIN_DOF:
        return None
    inverse = np.linalg.pinv(A.T @ A, hermitian=True)
    # Of columns that the rows do not tell apart, each would have a part of the response.
    is_told = np.diag(inverse @ A.T @ A) > 1.0 - MAX_SHARED
    coefficients = inverse @ (A.T @ y)
    spread = np.maximum(np.ptp(points.channels[used], axis=0), np.finfo(float).tiny)
    variance = np.sum((y - A @ coefficients) ** 2, axis=0) / dof + (np.finfo(float).eps * spread) ** 2
    known = []
    for place, (j, rows) in enumerate(masks):
        column = X[:, place] - X[:, place].mean()
        response = coefficients[place] / np.linalg.norm(subtract_block_means(X[:, [place]], series[used]))
        error2 = variance * inverse[place, place]
        t2 = float(np.sum((coefficients[place] / spread) ** 2) / np.sum(error2 / spread**2))
        change = float(np.max(np.abs(response) * np.ptp(column) / spread))
        if (
            is_told[place]
            and inverse[place, place] < MIN_OWN_SHARE**-2
            and t2 >= MIN_SQUARED_T
            and change >= MIN_CHANGE
        ):
            known.append(_Direction(j, rows, response / spread))
    return known


def _by_series(series: NDArray[np.intp]) -> Array:
    return np.asarray(series[:, None], float)


def _excursions(x: Array, series: NDArray[np.intp], used: Mask) -> Array:
    """Number (m, k) that changes wherever a load changes its sign, is zero, or another load series begins."""
    sign = np.where(used[:, None], np.sign(x), 0.0)
    changed = np.vstack([np.zeros((1, x.shape[1]), bool), sign[1:] != sign[:-1]])
    changed |= np.r_[False, series[1:] != series[:-1]][:, None]
    return np.asarray(np.cumsum(changed, axis=0), float)


def _direction_masks(x: Array, part: Array, used: Mask) -> list[tuple[int, Mask]]:
    """Load and rows (m,) of each direction with rows enough, and loads of two sizes, in each part (m, k) or (m, 1)."""
    masks = []
    for j in range(x.shape[1]):
        number = part[:, min(j, part.shape[1] - 1)]
        for name in np.unique(number[used]).tolist():
            for side in (1.0, -1.0):
                rows = used & (number == name) & (side * x[:, j] > 0.0)
                size = np.abs(x[rows, j])
                if len(size) >= MIN_ROWS and np.ptp(size) > MIN_STEP * np.max(size):
                    masks.append((j, rows))
    return masks
