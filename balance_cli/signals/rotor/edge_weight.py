"""The weight of a regression over whole revolutions, which rises smoothly at either end of its interval."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EDGE_REVOLUTIONS = 12
"""Revolutions over which the weight rises at either end: leakage then falls off within a twelfth of an order."""
# w(u) = u^3 (a + b u + c u^2 + d u^3 + e u^4) rises from 0 to 1, with zero first and second derivatives at either end.
# It has the moments of a step: the integrals of (w - 1) and of (w - 1) u vanish.
EDGE_POWERS = np.arange(3.0, 8.0)
EDGE_POLYNOMIAL = np.linalg.solve(
    np.array(
        [
            np.ones(5),
            EDGE_POWERS,
            EDGE_POWERS * (EDGE_POWERS - 1),
            1 / (EDGE_POWERS + 1),
            1 / (EDGE_POWERS + 2),
        ]
    ),
    np.array([1.0, 0.0, 0.0, 1.0, 0.5]),
)


def edge_weight(revolution: Array, first: int, last: int) -> Array:
    """Return the weight of the regression at a revolution count from `first` to `last`; it is 1 except at the ends."""
    edge = min(float(EDGE_REVOLUTIONS), (last - first) / 4)
    u = np.clip(np.minimum(revolution - first, last - revolution) / edge, 0.0, 1.0)
    weight = np.ones_like(u)
    rising = u < 1.0
    weight[rising] = u[rising] ** 3 * np.polyval(EDGE_POLYNOMIAL[::-1], u[rising])
    return weight
