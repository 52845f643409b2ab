"""Attitudes that the zeros of the load series contradict, with the direction of gravity that would agree.

A pitch with the wrong sign, an angle in radians or a rig whose level is not that of its axes leaves zeros that no
weight explains. The weight estimated from them would be taken off the mean loads of other attitudes.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.zero_equations import MISFIT_P_VALUE, ZeroEquations, zero_equations
from balance_cli.campaign.rig.attitude import gravity_directions, is_one_direction
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

CONTRADICTED_SHARE = 0.2
"""Share of what the attitudes change that a weight leaves: with one angle of the wrong sign it is a half, zeros of a
sound balance that return badly leave a few per cent."""
AGREEMENT = 0.1
"""Share of the residual that another direction of gravity may leave where it is named as the right one. Jumps of the
zeros fit no other direction ten times as well."""
LEAST_SIGNIFICANCE = 5.0
"""Standard errors by which a weight must be negative to contradict the attitudes: rarer than any chance."""


def undetermined_weight_notes(points: CalibrationPoints, fit: CalibrationModelFit) -> Iterator[str]:
    """Notes on why the weight of the metric part is not determined although runs state their attitude."""
    if points.gravity is None:
        return
    silent = np.unique(points.run[~np.isfinite(points.gravity).all(axis=1)])
    for run in silent:
        name = points.run_names[run]
        yield f"run {name} does not state its attitude: the weight of the metric part cannot be determined"
    if not len(silent) and not is_one_direction(points.gravity):
        needs = "needs load series in three attitudes out of line, with hub loads as components"
        why = describe_contradiction(points, fit) or f"it {needs}"
        yield f"the weight of the metric part is not determined: {why}; every attitude has a zero of its own"


def describe_contradiction(points: CalibrationPoints, fit: CalibrationModelFit) -> str:
    """Return in words how the zeros contradict the attitudes, empty where they do not."""
    equations = zero_equations(points, fit)
    white = None if equations is None else equations.whitened(equations.gravity)
    if equations is None or white is None:
        return ""
    c = len(equations.zeros)
    chi2, weight = _fit_weight(white, c)
    of_zeros = float(np.sum((white[:, -1] - _solution(white[:, :c], white[:, -1])[1]) ** 2))
    dof = len(white) - c - 4
    is_misfit = dof > 0 and of_zeros > 0.0 and float(stats.chi2.sf(chi2, dof)) < MISFIT_P_VALUE
    is_negative = weight < -LEAST_SIGNIFICANCE
    agreeing = _agreeing_direction(equations, chi2, is_negative) if is_misfit or is_negative else ""
    share = float(np.sqrt(chi2 / of_zeros)) if is_misfit else 0.0
    if not (is_negative or agreeing or share > CONTRADICTED_SHARE):
        return ""
    left = "the weight is negative" if is_negative else f"no weight explains {100.0 * share:.2g} % of their changes"
    but = f", but agree with {agreeing}" if agreeing else ""
    return f"the zeros contradict the stated attitudes ({left}){but}. Correct `pitch` and `roll`"


def _agreeing_direction(equations: ZeroEquations, chi2: float, is_negative: bool) -> str:
    """Return in words which other reading of the attitudes agrees with the zeros; empty where none does.

    It leaves a small share of chi-square `chi2`, or no more of it where that makes the weight positive.
    """
    c, best, least = len(equations.zeros), "", (1.0 if is_negative else AGREEMENT**2) * chi2
    for words, gravity in _readings_of_attitudes(equations.gravity):
        white = equations.whitened(gravity)
        assert white is not None
        other, weight = _fit_weight(white, c)
        if weight > LEAST_SIGNIFICANCE and other <= least * (1.0 + np.finfo(np.float32).eps):
            best, least = words, other
    return best


def _readings_of_attitudes(gravity: Array) -> Iterator[tuple[str, Array]]:
    """Other directions of gravity (s, 3) that may have been meant, in words; the simplest first."""
    pitch = np.arcsin(np.clip(gravity[:, 0], -1.0, 1.0))
    roll = np.arctan2(-gravity[:, 1], -gravity[:, 2])
    stated = np.degrees(np.column_stack([pitch, roll]))
    yield "angles in rad that are stated as deg", gravity_directions(np.degrees(stated))
    axes = [np.eye(3)[list(order)] for order in permutations(range(3))]
    turns = [np.array(signs)[:, None] * order for order, signs in product(axes, product((1.0, -1.0), repeat=3))]
    for turn in sorted(turns, key=lambda turn: -float(np.trace(turn))):
        yield _turned_words(turn), gravity @ turn.T


def _turned_words(turn: Array) -> str:
    """Describe a direction of gravity in which the components of the stated one have other signs or places."""
    known = {
        "-x, y, z": "the other sign of `pitch`",
        "x, -y, z": "the other sign of `roll`",
        "-y, -x, z": "`pitch` and `roll` exchanged",
    }
    parts = ", ".join("-" * bool(row.sum() < 0) + "xyz"[int(np.argmax(np.abs(row)))] for row in turn)
    return known.get(parts, f"gravity along ({parts}) of the rig where they say (x, y, z)")


def _fit_weight(white: Array, c: int) -> tuple[float, float]:
    """Chi-square of the whitened equations, and the weight over its standard error."""
    solution, fitted = _solution(white[:, :-1], white[:, -1])
    variance = np.linalg.pinv(white[:, :-1].T @ white[:, :-1])[c, c]
    return float(np.sum((white[:, -1] - fitted) ** 2)), float(
        solution[c] / np.sqrt(max(variance, np.finfo(float).tiny))
    )


def _solution(X: Array, y: Array) -> tuple[Array, Array]:
    solution = np.asarray(np.linalg.lstsq(X, y, rcond=None)[0], np.float64)
    return solution, np.asarray(X @ solution)
