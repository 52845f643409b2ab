"""Where a fit with effects begins: channels aligned with one another, then the equations of motion as a regression.

Far from the truth the likelihood has many minima, for resonances must first be brought to lie over one another. Two
estimates have hardly any, and come first:

1. Channels of one spring read the same force f, whatever the plate does: y_i = g_i f. With f eliminated line by line,
   what is left of the y_i tells delays, gains and filters of one channel against the other.
2. The cells measure their own forces f, so the motion x of the balance, lower body and all, is nearly known. All
   equations of a line at once,

       A(w) x = F u,        R x = f,

   are more than the unknown x; with x eliminated by least squares, what is left is free of the plate's resonances.
   (With x taken from some of the equations exactly, it would have the poles of those.) Variable projection: Golub and
   Pereyra, SIAM J. Numer. Anal. 10 (1973) 413; the derivative is that of Kaufman, BIT 15 (1975) 49.

The motion of a flexible part is not measured, and its resonance stays. At low frequency it is only a deflection that
grows with w^2, so lines are taken in from there upwards, each band beginning where the one below it ended (as Bunks et
al., Geophysics 60 (1995) 1457, do with waves).

Both are biased by noise, as every equation error is, and serve as a start only. Of an effect that is hardly above the
noise the second says little: then it is better to begin with that effect where it stands, and the rest fitted round it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.channel_alignment import alignment_residual
from balance_cli.estimation.equations_of_motion import motion_residuals
from balance_cli.estimation.levenberg_marquardt import minimize
from balance_cli.estimation.likelihood import Curvature
from balance_cli.estimation.regression_residual import RegressionResidual, line_stride
from balance_cli.model.parameters import ParameterSet
from balance_cli.model.system import System

Array = NDArray[np.float64]

# Scales within which effects are sought: what two channels share cannot be seen in their ratio, for one.
EFFECT_PRIOR_SCALES = 100.0
# The same where a fit goes on at once: what the regression hardly sees should stay where it is.
REGRESSION_PRIOR_SCALES = 10.0
# Scales within which an effect stays where it stands.
FIXED_EFFECT_SCALES = 1e-3
# Highest frequencies [Hz] of the bands that are taken in one after another where parts are flexible.
BAND_EDGES = (20.0, 40.0, 80.0, np.inf)
ROUNDS = 2
# Lines that are enough for a start from which a fit goes on at once.
QUICK_START_LINES = 150


@dataclass(frozen=True)
class StartingPoints:
    """Two full parameter vectors: effects where they stand with the rest fitted round them, and everything fitted."""

    effects_fixed: Array
    effects_free: Array


def find_starting_values(
    parameters: ParameterSet, batches: Sequence[Batch], system: Callable[[Array], System], start: Array
) -> StartingPoints:
    """Where to begin, from `start`; priors hold what the data leave open."""
    weakly_constrained = add_weak_priors(parameters, start, EFFECT_PRIOR_SCALES)
    aligned = _fit_regression(
        weakly_constrained, [alignment_residual(batch, line_stride(batches)) for batch in batches], system, start
    )
    known = system(aligned)
    effects_fixed = _fit_regression(
        add_weak_priors(parameters, aligned, FIXED_EFFECT_SCALES), motion_residuals(batches, known), system, aligned
    )
    effects_free = effects_fixed
    for max_frequency in BAND_EDGES if np.any(known.equations.own_stiffness) else (np.inf,):
        effects_free = _fit_regression(
            weakly_constrained, motion_residuals(batches, known, max_frequency), system, effects_free
        )
    return StartingPoints(effects_fixed, effects_free)


def start_from_equations_of_motion(
    parameters: ParameterSet, batches: Sequence[Batch], system: Callable[[Array], System], start: Array
) -> Array:
    """The full parameter vector that leaves least of the equations of motion, with the channels as they are at `start`.

    From nearly anywhere it comes near the truth where nothing that matters is missing. `start` itself where the
    regression leads to no rig at all.
    """
    weakly_constrained = add_weak_priors(parameters, start, REGRESSION_PRIOR_SCALES)
    try:
        with np.errstate(all="ignore"):
            found = _fit_regression(
                weakly_constrained, motion_residuals(batches, system(start), max_lines=QUICK_START_LINES), system, start
            )
    except np.linalg.LinAlgError:
        return start
    return found if np.all(np.isfinite(found)) else start


def add_weak_priors(parameters: ParameterSet, start: Array, scales: float) -> ParameterSet:
    """The same parameters, none without a prior: those that had none are held within so many scales of `start`."""
    unknown = np.isinf(parameters.sigma)
    sigma = np.where(unknown, scales * parameters.scale, parameters.sigma)
    return replace(parameters, value=np.where(unknown, start, parameters.value), sigma=sigma)


def _fit_regression(
    parameters: ParameterSet,
    residuals: Sequence[Callable[[System], RegressionResidual]],
    system: Callable[[Array], System],
    start: Array,
) -> Array:
    """Least squares with the priors; the variance is that of the residual itself, taken anew in each round."""

    def found(theta: Array) -> list[RegressionResidual]:
        at = system(theta)
        return [residual(at) for residual in residuals]

    def squares(theta: Array) -> float:
        return float(sum(np.sum(np.abs(item.error) ** 2) for item in found(theta)))

    p = int(parameters.free.sum())
    initial_residuals = found(start)
    count = sum(item.error.size for item in initial_residuals)
    if not all(np.all(np.isfinite(item.error)) for item in initial_residuals):
        return start  # a part that is as stiff as can be has no equation of motion
    for _ in range(ROUNDS if count else 0):
        variance = max(squares(start) / count, np.finfo(float).tiny)
        start = minimize(
            parameters,
            start,
            lambda theta, v=variance: _curvature(found(theta), v, p),  # type: ignore[misc]
            lambda theta, v=variance: 2.0 * squares(theta) / v,  # type: ignore[misc]
            iterations=20,
            tolerance=1e-4 * count,
        ).theta
    return start


def _curvature(residuals: Sequence[RegressionResidual], variance: float, p: int) -> Curvature:
    total = Curvature(0.0, np.zeros(p), np.zeros((p, p)))
    for item in residuals:
        slope, error = item.jacobian().reshape(-1, p), item.error.reshape(-1)
        information = 2.0 * np.real(slope.conj().T @ slope) / variance
        gradient = 2.0 * np.real(slope.conj().T @ error) / variance
        total = total + Curvature(2.0 * float(np.sum(np.abs(error) ** 2)) / variance, gradient, information)
    return total
