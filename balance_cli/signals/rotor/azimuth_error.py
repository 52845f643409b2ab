"""What the scatter of the 1/rev pulses adds to the error of harmonics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.azimuth import Azimuth

ComplexArray = NDArray[np.complex128]


def azimuth_error_covariance(amplitude: ComplexArray, azimuth: Azimuth, revolutions: float) -> ComplexArray:
    """Return the covariance (n+1, c, c) of harmonics (n+1, c) over so many revolutions by the scatter of the pulses.

    The mean error of the azimuth, that of all pulses alike included, turns harmonic k by k times as much; the error
    that varies within the interval reduces its amplitude by half the square. The variance is doubled because it is that
    of a circular error, of which a cosine has half, and a turn may lie in the cosine alone.
    """
    k = np.arange(len(amplitude))
    mean_error = azimuth.pulse_scatter**2 / revolutions + azimuth.common_error**2
    share = k**2 * mean_error + 0.25 * (k * azimuth.local_error) ** 4
    return np.asarray(2.0 * share[:, None, None] * amplitude[:, :, None] * amplitude[:, None, :].conj())
