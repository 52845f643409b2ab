"""What changes within a record leave in its harmonics, where they are too small or too short to make these unsteady.

A mean load that steps leaves a part of itself in each harmonic, and the modes that it excites leave more where the
record ends before they have decayed: a few windows have other harmonics than the rest. A gain of all channels that
drifts changes all harmonics by one factor, which is known much better than any of them changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.channel_change import FEWEST_HARMONICS, relative_changes
from balance_cli.signals.rotor.common_turn import median_amplitude
from balance_cli.signals.rotor.steadiness import FEWEST_WINDOWS, critical_sum, largest_change, window_scatter

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BEYOND_CHANCE = 3.0
"""Standard deviations of the mean of windows from which it differs from their median by more than chance: the
difference has a standard deviation of 0.75 of them."""
ENDS = 8
"""Part of a record whose mean is that at its begin or end: a drift goes from one to the other, a step is half of it."""


def harmonic_drift(values: ComplexArray, reported: ComplexArray, sigma: Array, mean_changes: bool = False) -> Array:
    """Return by how much changes within a record make its harmonic loads `reported` (n, m) uncertain, (n, m).

    `values` (w, n, m) are the loads of windows, `sigma` (n, m) the standard deviations, below which an effect is left
    out. `mean_changes`: whether a mean load is known to step or drift, so that less has to be shown.
    """
    if len(values) < FEWEST_WINDOWS or not values.size:
        return np.zeros(sigma.shape)
    remainder = step_remainder(values, reported, 1.0 if mean_changes else BEYOND_CHANCE)
    error = np.hypot(common_drift(values) * np.abs(reported), remainder)
    return np.where(error > sigma, error, 0.0)


def step_remainder(values: ComplexArray, reported: ComplexArray, limit: float) -> Array:
    """Return by how much the loads (n, m) reported, or the mean of windows (w, n, m), miss most windows, (n, m).

    It is zero up to `limit` standard deviations of the mean.
    """
    scatter = np.hypot(window_scatter(values.real), window_scatter(values.imag)) / np.sqrt(len(values))
    most = median_amplitude(values)
    remainder = np.maximum(np.abs(reported - most), np.abs(values.mean(axis=0) - most))
    return np.where(remainder > limit * scatter, remainder, 0.0)


def common_drift(values: ComplexArray) -> float:
    """Return half of the relative change that all loads of windows (w, n, m) have in common; 0 where it may be chance.

    As of a mean load, nobody knows whether what is sought is the load before or after. Fewer than six loads tell none.
    """
    if values[0].size < FEWEST_HARMONICS:
        return 0.0
    changes = relative_changes(values.reshape(len(values), -1, 1))
    gain = changes.series[:, 0, 0]
    # Modes that outlast a window correlate the noise of one harmonic; of several at once, none does.
    scatter = max(float(changes.scatter[0, 0]), float(window_scatter(gain)))
    wander = float(np.abs(np.cumsum(gain - gain.mean())).max())
    if wander <= critical_sum(len(gain), 2 * FEWEST_HARMONICS) * scatter * np.sqrt(len(gain)):
        return 0.0
    part = max(len(gain) // ENDS, 2)
    return 0.5 * max(float(largest_change(gain)), abs(float(gain[-part:].mean() - gain[:part].mean())))
