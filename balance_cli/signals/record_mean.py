"""The mean of a record that does not repeat, freed of the delay with which channels follow the loads.

A mean with a Hann window w does not depend on the ends of the record. But with channels that follow slow loads late,
y = A u - B u', the mean of y is not A times that of u where the loads have a part that changes slowly, as the half
cycles do with which a stepped sine leaves each frequency:

    <y>_w = A <u>_w - B <u'>_w,        <u'>_w = -<u>_w',        Y = (A - j w B) U        at low frequencies

B is taken from the lowest lines, and B <u'>_w added to the mean of the channels. Without it, offsets of loads of 2e-5
of the excitation were found in sound stepped records.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.run_spectrum import RunSpectrum
from balance_cli.signals.sampled_waveform import hann_mean

Array = NDArray[np.float64]

BAND = 2.0
"""Highest over lowest frequency of the lines that tell B, with terms up to the third power of frequency."""
LARGEST_DYNAMIC_SHARE = 0.3
"""Rms of what A alone leaves of the lines, over theirs: above it they are near a resonance or above it."""
ERROR_SHARE = 0.1
"""Error of the correction over the correction, from higher powers of frequency and from noise."""


def delay_free_mean(samples: Array, rate: float, lines: RunSpectrum) -> tuple[Array, Array]:
    """Return the mean (c+u,) of channels and loads `samples` (n, c+u), and the error (c,) that the delay leaves in it.

    `lines`: those of the record. Where they are too few or too near a resonance, the mean is the plain one, and its
    error is the whole correction; without any line it is zero.
    """
    mean = hann_mean(samples)
    correction, is_slow = _delayed_part(samples[:, len(lines.channel_names) :], rate, lines)
    if not is_slow:
        return mean, np.abs(correction)
    mean[: len(correction)] += correction
    return mean, ERROR_SHARE * np.abs(correction)


def _delayed_part(loads: Array, rate: float, lines: RunSpectrum) -> tuple[Array, bool]:
    """B <u'>_w (c,), and whether the response varies little over the lines that it is taken from."""
    c, u = lines.channels.shape[1], loads.shape[1]
    moving = lines.frequency > 0
    low = moving & (lines.frequency <= BAND * np.min(lines.frequency[moving], initial=np.inf))
    if np.count_nonzero(low) < 4 * u:
        return np.zeros(c), False
    s, U, Y = 2j * np.pi * lines.frequency[low, None], lines.loads[low], lines.channels[low]
    design = np.hstack([U, -s * U, s**2 * U, s**3 * U])
    size = np.linalg.norm(design, axis=0)
    stacked = np.vstack([design.real, design.imag]) / size
    terms = np.linalg.lstsq(stacked, np.vstack([Y.real, Y.imag]), rcond=None)[0] / size[:, None]
    is_slow = bool(np.linalg.norm(Y - U @ terms[:u]) <= LARGEST_DYNAMIC_SHARE * np.linalg.norm(Y))
    return np.asarray(_hann_mean_of_derivative(loads, rate) @ terms[u : 2 * u]), is_slow


def _hann_mean_of_derivative(values: Array, rate: float) -> Array:
    """Mean (...) with a Hann window of the derivatives of values (n, ...): minus that of the values with its slope."""
    n = len(values)
    slope = 2 * np.pi * rate / n * np.sin(2 * np.pi * np.arange(n) / n) / n
    return np.asarray(-np.tensordot(slope, values, axes=1))
