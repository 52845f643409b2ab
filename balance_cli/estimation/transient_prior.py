"""How large a transient may be in each channel of a record, before its lines are looked at for one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch

Array = NDArray[np.float64]

MAX_AMPLITUDE_RATIO = 10.0
"""Of the rms of a channel: a transient from rest begins as minus the forced motion; single modes, which partly cancel,
may be larger."""
MIN_SIGNAL_RATIO = 1e-9
"""Least rms of a channel relative to the largest, so that a computed signal of zero has a finite prior."""
NOISE_SIGMAS = 4.0
"""Standard deviations of the mean power of noise, within which a channel holds nothing else in a record."""
SILENT_AMPLITUDE = 0.1
"""Transient in such a channel at most, in units of the noise of a line: less than its lines can show."""


def prior_weight(batch: Batch, lines: slice) -> Array:
    """Return one over the largest transient (c,) [1/V] that is expected in each live channel, of the lines of a run.

    In channels that hold noise alone it is next to nothing: a mode that nothing excites, and that no other channel
    shows, would take its frequency and damping from the largest line of the noise.
    """
    channels, precision = batch.lines.channels[lines], batch.lines.channel_precision[lines]
    rms = np.sqrt(0.5 * np.sum(np.abs(channels) ** 2, axis=0))
    is_live = precision[0] > 0
    largest = MAX_AMPLITUDE_RATIO * np.maximum(rms, MIN_SIGNAL_RATIO * rms.max())
    power = np.mean(np.abs(channels) ** 2 * precision, axis=0)
    is_noise = is_live & (power < 1.0 + NOISE_SIGMAS / np.sqrt(len(precision)))
    noise = SILENT_AMPLITUDE / np.sqrt(np.where(is_noise, precision.mean(axis=0), 1.0))
    return np.where(is_live, 1.0 / np.where(is_noise, np.minimum(noise, largest), largest), 0.0)
