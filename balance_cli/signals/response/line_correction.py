"""Correction of a local model that misses the lines between which it stands.

A rational function of few orders fits lines within a mode's width. Where they are farther apart than that it does not
pass through them, and at a line the measured response is the better one: it is known to its noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.distributions import chi2
from balance_cli.signals.response.window_models import WindowModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MISSED_BY_NOISE = 1e-3
"""Probability with which noise alone makes a model miss two lines: a correction by noise costs little."""


MISSED_BY_NOISE = 1e-3
"""Probability with which noise alone makes a model miss two lines: a correction by noise costs little."""


def residual_shares(model: WindowModel, lines: Array, frequency: Array) -> Array:
    """Return the shares (n, M) of the residuals of lines (M,) [Hz] to add to a model of them at frequencies (n,) [Hz].

    They are linear between the two lines around a frequency, and zero where the model passes through both.
    """
    above = np.clip(np.searchsorted(lines, frequency), 1, len(lines) - 1)
    shares = np.zeros((len(frequency), len(lines)))
    for place in np.unique(above):
        if _misses(model, np.array([place - 1, place])):
            members = np.flatnonzero(above == place)
            upper = np.clip((frequency[members] - lines[place - 1]) / (lines[place] - lines[place - 1]), 0.0, 1.0)
            shares[members, place - 1], shares[members, place] = 1.0 - upper, upper
    return shares


def _misses(model: WindowModel, between: Index) -> bool:
    """Whether a model misses two lines by more than noise."""
    weighted = model.fit.residual[between] * model.fit.weight[between, None]
    degrees = 2 * weighted.size
    return bool(2.0 * np.sum(np.abs(weighted) ** 2) > float(chi2.isf(MISSED_BY_NOISE, degrees)))
