"""Starting values of a fit with effects: alignment of channels, then a regression on the equations of motion.

Far from the truth the likelihood has many minima, because computed and measured resonances must first coincide. Two
estimates have few minima and come first:

1. Channels of one spring read the same force f, whatever the plate does: y_i = g_i f. With f eliminated line by line,
   the residual of the y_i determines delays, gains and filters of one channel relative to the other.
2. The cells measure their own forces f, so the motion x of the balance, ground side included, is nearly known. The
   equations of a line,

       A(w) x = F u,        R x = f,

   with u the loads that act for the recorded ones (gain, delay and lag of the exciters), are more than the unknowns x;
   with x eliminated by least squares, the residual has no resonances of the plate. (If some of the equations were
   solved for x exactly, it would have their poles.) Variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10
   (1973) 413; the derivative is that of Kaufman, BIT 15 (1975) 49.

The motion of a flexible part is not measured, and its resonance remains. At low frequency it is only a deflection that
grows with w^2. The fit therefore begins with the lowest lines, and each wider band starts from the result of the one
before (as Bunks et al., Geophysics 60 (1995) 1457, do with waves).

Both estimates are biased by noise, as every equation error is, and serve only as starting values. The second is poor
for an effect that is hardly above the noise; then it is better to leave that effect as declared and to fit the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.channel_alignment import alignment_residual
from balance_cli.estimation.deadline import Deadline
from balance_cli.estimation.equations_of_motion import motion_residuals
from balance_cli.estimation.inner_products import real_inner_product
from balance_cli.estimation.levenberg_marquardt import minimize
from balance_cli.estimation.likelihood import Curvature
from balance_cli.estimation.regression_residual import RegressionResidual, line_stride
from balance_cli.model.parameters import ParameterSet
from balance_cli.model.system import System

Array = NDArray[np.float64]
SystemAt = Callable[[Array, bool], System]
"""The system at a full parameter vector, with or without derivatives."""

# Weak prior on effects, in their scales. Without it the regression is singular: a filter that two channels share does
# not change their ratio, for instance.
EFFECT_PRIOR_SCALES = 100.0
# The same where a fit follows at once: parameters that the regression hardly determines should stay where they are.
REGRESSION_PRIOR_SCALES = 10.0
# Prior that fixes effects at their declared values, in their scales.
FIXED_EFFECT_SCALES = 1e-3
# Upper limits of the bands that are fitted one after another where parts are flexible, as shares of the highest line.
BAND_EDGES = (0.125, 0.25, 0.5, 1.0)
# Rounds, each with the variance estimated from the residual of the one before.
ROUNDS = 2
# Number of lines for starting values that a fit refines at once.
QUICK_START_LINES = 150


@dataclass(frozen=True)
class StartingPoints:
    """Two full parameter vectors: the effects as declared and the rest fitted, and everything fitted."""

    effects_fixed: Array
    effects_free: Array


def find_starting_values(
    parameters: ParameterSet,
    batches: Sequence[Batch],
    system: SystemAt,
    start: Array,
    deadline: Deadline | None = None,
) -> StartingPoints:
    """Fit starting values from `start`; priors determine what the data do not. `deadline`: as in `minimize`."""
    weakly_constrained = add_weak_priors(parameters, start, EFFECT_PRIOR_SCALES)
    aligned = _fit_regression(
        weakly_constrained,
        [alignment_residual(batch, line_stride(batches)) for batch in batches],
        system,
        start,
        deadline,
    )
    aligned_system = system(aligned, True)
    effects_fixed = _fit_regression(
        add_weak_priors(parameters, aligned, FIXED_EFFECT_SCALES),
        motion_residuals(batches, aligned_system),
        system,
        aligned,
        deadline,
    )
    effects_free = effects_fixed
    highest = max((float(batch.frequency[-1]) for batch in batches), default=0.0)
    for share in BAND_EDGES if np.any(aligned_system.equations.own_stiffness) else BAND_EDGES[-1:]:
        effects_free = _fit_regression(
            weakly_constrained,
            motion_residuals(batches, aligned_system, share * highest),
            system,
            effects_free,
            deadline,
        )
    return StartingPoints(effects_fixed, effects_free)


def start_from_equations_of_motion(
    parameters: ParameterSet,
    batches: Sequence[Batch],
    system: SystemAt,
    start: Array,
    deadline: Deadline | None = None,
) -> Array:
    """The full parameter vector with the least residual of the equations of motion, the channels being as at `start`.

    It comes near the truth from nearly anywhere if the model is complete. Returns `start` where the regression leads to
    parameters that are not physical. `deadline`: as in `minimize`.
    """
    weakly_constrained = add_weak_priors(parameters, start, REGRESSION_PRIOR_SCALES)
    try:
        with np.errstate(all="ignore"):
            fitted = _fit_regression(
                weakly_constrained,
                motion_residuals(batches, system(start, True), max_lines=QUICK_START_LINES),
                system,
                start,
                deadline,
            )
    except np.linalg.LinAlgError:
        return start
    return fitted if np.all(np.isfinite(fitted)) else start


def add_weak_priors(parameters: ParameterSet, start: Array, scales: float) -> ParameterSet:
    """The same parameters with a prior on those without one: `start`, with a sigma of `scales` of their scales."""
    is_unknown = np.isinf(parameters.sigma)
    sigma = np.where(is_unknown, scales * parameters.scale, parameters.sigma)
    return replace(parameters, value=np.where(is_unknown, start, parameters.value), sigma=sigma)


def _fit_regression(
    parameters: ParameterSet,
    residuals: Sequence[Callable[[System], RegressionResidual]],
    system: SystemAt,
    start: Array,
    deadline: Deadline | None = None,
) -> Array:
    """Least squares with the priors; the variance is that of the residual, estimated again in each round."""

    def residuals_at(theta: Array, derivatives: bool = True) -> list[RegressionResidual]:
        at = system(theta, derivatives)
        return [residual(at) for residual in residuals]

    def squares(theta: Array) -> float:
        return float(sum(np.sum(np.abs(item.error) ** 2) for item in residuals_at(theta, False)))

    p = int(parameters.free.sum())
    initial_residuals = residuals_at(start)
    count = sum(item.error.size for item in initial_residuals)
    if not all(np.all(np.isfinite(item.error)) for item in initial_residuals):
        return start  # A rigid part has no equation of motion of its own.
    for _ in range(ROUNDS if count else 0):
        variance = max(squares(start) / count, np.finfo(float).tiny)
        start = minimize(
            parameters,
            start,
            lambda theta, v=variance: _curvature(residuals_at(theta), v, p),  # type: ignore[misc]
            lambda theta, v=variance: 2.0 * squares(theta) / v,  # type: ignore[misc]
            iterations=20,
            tolerance=1e-4 * count,
            deadline=deadline,
        ).theta
    return start


def _curvature(residuals: Sequence[RegressionResidual], variance: float, p: int) -> Curvature:
    total = Curvature(0.0, np.zeros(p), np.zeros((p, p)))
    for item in residuals:
        jacobian = item.jacobian()
        information = 2.0 * real_inner_product(jacobian, jacobian) / variance
        gradient = 2.0 * real_inner_product(jacobian, item.error[:, :, None])[:, 0] / variance
        total = total + Curvature(2.0 * float(np.sum(np.abs(item.error) ** 2)) / variance, gradient, information)
    return total
