"""Smoothing of 1/rev pulse times: the rotor turns smoothly, the timing of its pulses scatters.

Source: Eilers, "A Perfect Smoother", Analytical Chemistry 75 (2003), with third differences and generalized
cross-validation (Craven and Wahba, 1979).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]

ORDER = 3
"""Order of the differences that are penalized: a constant acceleration of the rotor is not."""
PENALTIES = 10.0 ** np.arange(-2.0, 9.1, 0.5)
"""Tried penalties. The last one averages over some 60 revolutions, the first over one."""
FEWEST_PULSES = 12
"""Fewer pulses are left as they are: their scatter cannot be told from a change of speed."""
SCATTER_ORDER = 8
"""Order of the differences of pulse times that show their scatter: changes of speed over tens of revolutions vanish."""
STEP_MARGIN = 1.15
"""Of half a step of the pulse times, by which the smooth curve may depart from a time: its own error is on top. With
steps of 0.6 to 20 deg of azimuth and speeds that vary by up to 3 % its error is less than with 1.05, and as stated."""
PROBES = 8
"""Random signs by which the trace of the smoother is estimated (Hutchinson), to some percent of the trace."""


@dataclass(frozen=True)
class SmoothedPulses:
    """Times (n,) [s] of revolutions 0 to n - 1, their standard error and that of a single pulse before [s].

    `window` is the number of revolutions over which the smoother averages.
    """

    times: Array
    sigma: float
    scatter: float
    window: float


def pulse_scatter(times: Array, revolutions: NDArray[np.int64]) -> float:
    """Return the standard deviation [s] of the times (p,) of pulses of these revolutions; 0 where too few tell.

    From differences over consecutive revolutions, of which a few bad pulses change no median.
    """
    single = np.diff(revolutions) == 1
    if len(single) < SCATTER_ORDER:
        return 0.0
    consecutive = np.lib.stride_tricks.sliding_window_view(single, SCATTER_ORDER).all(axis=1)
    differences = np.abs(np.diff(times, SCATTER_ORDER)[consecutive])
    median = float(np.median(differences)) if differences.size else 0.0
    # The ratio of the standard deviation to the median absolute deviation of normal errors, and the root of the sum of
    # the squared coefficients of the difference.
    return 1.4826 * median / math.sqrt(math.comb(2 * SCATTER_ORDER, SCATTER_ORDER))


def smooth_pulses(times: Array, revolutions: NDArray[np.int64], step: float = 0.0) -> SmoothedPulses:
    """Smooth the pulse times (p,) [s] of these revolutions; missing revolutions are interpolated.

    The penalty on the third differences is that of least generalized cross-validation: a change of speed that the
    pulses show beyond their scatter stays. Times that are whole multiples of a `step` [s] scatter in long patterns
    where the revolution is nearly a multiple, too, which cross-validation takes for changes of speed. A larger penalty
    is taken then, as long as no time departs by more than half a step (discrepancy principle, Morozov).
    """
    count = int(revolutions[-1]) + 1
    line = np.polynomial.Polynomial.fit(revolutions, times, 1)
    weights, values = np.zeros(count), np.zeros(count)
    weights[revolutions], values[revolutions] = 1.0, times - line(revolutions)
    if len(times) < FEWEST_PULSES:
        filled = np.interp(np.arange(count), revolutions, times)
        return SmoothedPulses(filled, 0.0, 0.0, 1.0)
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (count, PROBES))
    trials = [_smooth(values, weights, penalty, probes) for penalty in PENALTIES]
    gcv = [len(times) * residual / (len(times) - dof) ** 2 for _, residual, dof in trials]
    largest = [np.abs(weights * (values - curve)).max() for curve, _, _ in trials]
    within_step = np.flatnonzero(np.array(largest) <= 0.5 * STEP_MARGIN * step)
    smooth, residual, dof = trials[max([int(np.argmin(gcv)), *within_step])]
    scatter = float(np.sqrt(residual / max(len(times) - dof, 1.0)))
    sigma = scatter * float(np.sqrt(dof / len(times)))
    return SmoothedPulses(smooth + line(np.arange(count)), sigma, scatter, len(times) / dof)


def _smooth(values: Array, weights: Array, penalty: float, probes: Array) -> tuple[Array, float, float]:
    """The smooth curve, the sum of its squared residuals, and the degrees of freedom (trace of the smoother)."""
    bands = penalty * _difference_bands(len(values))
    bands[-1] += weights
    factor = cholesky_banded(bands)
    right = np.column_stack([weights * values, weights[:, None] * probes])
    solved = cho_solve_banded((factor, False), right)
    smooth = np.asarray(solved[:, 0])
    residual = float(np.sum(weights * (values - smooth) ** 2))
    dof = float(np.mean(np.sum(probes * weights[:, None] * solved[:, 1:], axis=0)))
    return smooth, residual, min(max(dof, float(ORDER)), float(weights.sum()) - 1.0)


def _difference_bands(count: int) -> Array:
    """Upper bands (ORDER + 1, count) of D'D, D the matrix of differences of order ORDER."""
    stencil = np.array([1.0])
    for _ in range(ORDER):
        stencil = np.convolve(stencil, [-1.0, 1.0])
    bands, rows = np.zeros((ORDER + 1, count)), count - ORDER
    for i in range(ORDER + 1):
        for j in range(i, ORDER + 1):
            bands[ORDER - (j - i), j : j + rows] += stencil[i] * stencil[j]
    return bands
