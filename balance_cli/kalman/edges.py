"""What a beginning, a gap or a change of channels adds to the variance of an estimate, beyond the steady one.

A filter at its steady gain whose first state has the covariance P + D in place of P errs, k samples later, by L^k d
more, d of covariance D: the filter's variance is larger by (L^k) D (L^k)'. A smoother can tell d from what follows:
given y, d has the covariance D (1 + O D)^-1 with O = sum L^j' H' S^-1 H L^j, and its mean is D (1 + O D)^-1 rho[0]
(de Jong, Ann. Statist. 19, 1991, 1073, lets D go to infinity). Before an end, after which only the information J is to
come in place of O, a smoother knows less by L^j' (O - J) L^j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STRIDES = (1, 8, 64, 512)
PLACES = 16
"""Samples of each stride at which a decay is evaluated; straight lines between."""
NEGLIGIBLE = 1e-4
"""Of the steady variance: a smaller addition is left out."""


@dataclass(frozen=True)
class Decay:
    """A variance (o,) that dies away with the samples from an edge: `value` (p, o) after so many, `at` (p,)."""

    at: Array
    value: Array

    def after(self, samples: NDArray[np.intp]) -> Array:
        """At numbers (n,) of samples: (n, o); straight lines between, and nothing beyond the last."""
        return np.stack([np.interp(samples, self.at, column, right=0.0) for column in self.value.T], axis=1)


def decay(rows: Array, transition: Array, spread: Array, count: int, floor: Array) -> Decay:
    """diag(rows A^k spread (rows A^k)') for k = 0 .. count - 1, until it is negligible beside `floor` (o,).

    rows (o, N), transition A and spread (N, N).
    """
    at: list[int] = []
    found: list[Array] = []
    k, power = 0, transition
    for i, stride in enumerate(STRIDES):
        if i:
            power = np.linalg.matrix_power(power, STRIDES[i] // STRIDES[i - 1])
        for _ in range(PLACES):
            at.append(k)
            found.append(np.einsum("on,on->o", rows @ spread, rows))
            if k >= count or np.all(np.abs(found[-1]) <= NEGLIGIBLE * floor):
                return Decay(np.array(at, float), np.array(found))
            rows, k = rows @ power, k + stride
    return Decay(np.array(at, float), np.array(found))


def told_apart(excess: Array, information: Array) -> Array:
    """D (1 + O D)^-1 (N, N): covariance of what the start was wrong by, given all that follows."""
    return np.asarray(np.linalg.solve(np.eye(len(excess)) + excess @ information, excess))


def seen_through(excess: Array, information: Array) -> Array:
    """(1 + O D)^-1 O (N, N): what the samples after an uncertain start tell of the state at it."""
    return np.asarray(np.linalg.solve(np.eye(len(excess)) + information @ excess, information))
