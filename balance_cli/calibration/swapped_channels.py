"""Channels that read each other's loads in all runs: their cables are swapped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.term_choice import LINEAR_TERMS

Array = NDArray[np.float64]

MIN_SWAPPED_COSINE = 0.95
"""Cosine of a channel's sensitivities with those declared for the other channel, in both of a swapped pair at least."""
MAX_OWN_COSINE = 0.8
"""Cosine with its own declared sensitivities, in either channel of a swapped pair at most."""


def find_swapped_channels(points: CalibrationPoints, expected: Array) -> tuple[str, ...]:
    """Find pairs of channels that read each other's loads.

    `expected` (c, k) [V]: declared response to loads of the calibrated range. In a swapped pair both channels of the
    linear fit resemble the declared sensitivities of the other channel far more than their own.
    """
    C = fit_calibration_model(points, LINEAR_TERMS).model.coefficients[: len(points.components)].T
    cosine = _unit_rows(C) @ _unit_rows(expected).T
    pairs = []
    for i in range(len(C)):
        for j in range(i + 1, len(C)):
            own, crossed = min(cosine[i, i], cosine[j, j]), min(cosine[i, j], cosine[j, i])
            if crossed > MIN_SWAPPED_COSINE and own < MAX_OWN_COSINE:
                pairs.append(f"{points.channel_names[i]} and {points.channel_names[j]}")
    return tuple(pairs)


def _unit_rows(rows: Array) -> Array:
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(size > 0, size, 1.0))
