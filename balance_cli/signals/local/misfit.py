"""What local models miss of a response: the part of their residual that follows the loads.

Noise has no relation to the loads. A residual that, over a few neighboring lines, is a multiple b of them is what the
orders of the model cannot describe, two modes in one window for instance. Of noise with variance s, |b|^2 has the mean
s / sum |U|^2; what the mean over the groups of lines of a window exceeds that by is the square of the error that the
response has there. Averages over the lines of a window, as the noise has, do not reduce it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.local.window import WindowFit

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

GROUP_LINES = 5
"""Lines of a group with one input, over which a response hardly changes; several inputs need two lines for each."""
CLEAR_EXCESS_SIGMA = 4.0
"""Standard deviations of the mean over the groups from which it is no noise."""


def missed_response_power(fit: WindowFit, lines: slice, noise: ComplexArray) -> Array:
    """Return the square of what the response (c, u) misses on average at some lines of a window; zero if nothing.

    `noise` (M, c, c) is the covariance of the residual at the lines of the window.
    """
    u = fit.U.shape[1]
    size = max(GROUP_LINES, 2 * u)
    count = len(fit.r[lines]) // size
    if count == 0:
        return np.zeros((fit.residual.shape[1], u))
    grouped = slice(lines.start, lines.start + count * size)
    U, residual = (part[grouped].reshape(count, size, -1) for part in (fit.U, fit.residual))
    adjoint = U.conj().swapaxes(1, 2)
    gram = adjoint @ U
    # A load without power in a group has no response to be missed.
    inverse = np.linalg.pinv(gram, rcond=1e-9, hermitian=True)
    power = np.abs(inverse @ (adjoint @ residual)) ** 2
    variance = np.diagonal(noise[grouped], axis1=1, axis2=2).real.reshape(count, size, -1).mean(axis=1)
    of_noise = np.diagonal(inverse, axis1=1, axis2=2).real[:, :, None] * variance[:, None, :]
    missed, expected = (values.mean(axis=0).T for values in (power, of_noise))
    is_clear = missed > (1.0 + CLEAR_EXCESS_SIGMA / np.sqrt(count)) * expected
    return np.where(is_clear, missed - expected, 0.0)
