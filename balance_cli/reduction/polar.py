"""Standard deviations of amplitude and phase from those of cosine and sine."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LARGEST_PHASE_SIGMA = 180.0 / np.sqrt(3.0)
"""Standard deviation [deg] of a phase of which nothing is known, uniform over a turn."""


def polar_sigma(amplitude: ArrayLike, sigma_cosine: ArrayLike, sigma_sine: ArrayLike) -> tuple[Array, Array]:
    """Return sigma of |amplitude| and of its phase [deg] for amplitude = cosine - j sine, to first order.

    Where the amplitude does not exceed its noise the first order does not hold: sigma of the amplitude is then at least
    that of the smaller part, and sigma of the phase at most that of an unknown phase. A mean (sigma of the sine zero)
    has no phase: NaN.
    """
    value, c, s = np.asarray(amplitude, complex), np.asarray(sigma_cosine, float), np.asarray(sigma_sine, float)
    size = np.maximum(np.abs(value), np.finfo(float).tiny)
    cosine, sine = np.abs(value.real) / size, np.abs(value.imag) / size
    radial = np.where(np.abs(value) > 0, np.hypot(cosine * c, sine * s), np.maximum(c, s))
    with np.errstate(over="ignore"):
        angle = np.degrees(np.hypot(sine * c, cosine * s) / size)
    angle = np.where(np.abs(value) > 0, np.minimum(angle, LARGEST_PHASE_SIGMA), LARGEST_PHASE_SIGMA)
    has_phase = np.isfinite(value) & (s > 0.0)
    return np.asarray(radial), np.asarray(np.where(has_phase, angle, np.nan))
