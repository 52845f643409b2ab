"""What a beginning, a gap or a change of channels adds to the variance of an estimate, beyond the steady one.

A filter at its steady gain whose first state has the covariance P + D in place of P errs, k samples later, by L^k d
more, d of covariance D: the filter's variance is larger by (L^k) D (L^k)'. A smoother can tell d from what follows:
given y, d has the covariance D (1 + O D)^-1 with O = sum L^j' H' S^-1 H L^j, and its mean is D (1 + O D)^-1 rho[0]
(de Jong, Ann. Statist. 19, 1991, 1073, lets D go to infinity). Before an end, after which only the information J is to
come in place of O, a smoother knows less by L^j' (O - J) L^j.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STRIDES = (1, 8, 64, 512)
POINTS_PER_STRIDE = 16
"""Samples of each stride at which a decay is evaluated; straight lines between."""
NEGLIGIBLE_SHARE = 1e-4
"""Of the steady variance: a smaller addition is left out."""


class SteadyMatrices(Protocol):
    """A steady filter: P, L and O (N, N)."""

    @property
    def P(self) -> Array: ...  # noqa: D102

    @property
    def L(self) -> Array: ...  # noqa: D102

    @property
    def all_information(self) -> Array: ...  # noqa: D102


@dataclass(frozen=True)
class Decay:
    """A variance (o,) that dies away with the samples from an edge: `value` (p, o) after so many, `at` (p,).

    One that does not fade stays as it is beyond the last.
    """

    at: Array
    value: Array
    fades: bool = True

    def after(self, samples: NDArray[np.intp]) -> Array:
        """At numbers (n,) of samples: (n, o); straight lines between, and nothing beyond the last."""
        last = 0.0 if self.fades else None
        return np.stack([np.interp(samples, self.at, column, right=last) for column in self.value.T], axis=1)


def variance_decay(rows: Array, transition: Array, spread: Array, count: int, floor: Array) -> Decay:
    """diag(rows A^k spread (rows A^k)') for k = 0 .. count - 1, until it is negligible beside `floor` (o,).

    rows (o, N), transition A and spread (N, N).
    """
    at: list[int] = []
    found: list[Array] = []
    k, power = 0, transition
    for i, stride in enumerate(STRIDES):
        if i:
            power = np.linalg.matrix_power(power, STRIDES[i] // STRIDES[i - 1])
        for _ in range(POINTS_PER_STRIDE):
            at.append(k)
            found.append(np.einsum("on,on->o", rows @ spread, rows))
            if k >= count or np.all(np.abs(found[-1]) <= NEGLIGIBLE_SHARE * floor):
                return Decay(np.array(at, float), np.array(found))
            rows, k = rows @ power, k + stride
    return Decay(np.array(at, float), np.array(found))


def smoother_edge_variance(rows: Array, steady: SteadyMatrices, missing: Array, start: Array, count: int) -> Decay:
    """What both edges of a stretch add to the steady variance of a smoother, and each to what the other adds.

    `missing` O - J (N, N) at its end, `start` (N, N) the covariance of what its first state was wrong by, given all:
    with B = rows P L'^j, j samples before the end, and R = rows (1 - P O_k) L^k = rows (1 - P O) L^k + B (O - J) L^n,

        diag(B (O - J) B' + R start R').
    """
    at = _dense_at_both_ends(count)
    powers = _MatrixPowers(steady.L)
    through = missing @ powers.to_power(count)
    first, last = (
        rows - (rows @ steady.P) @ steady.all_information,
        rows @ steady.P @ powers.to_power(count - int(at[-1])).T,
    )
    begun, ended = [first], [last]
    for step in np.diff(at):
        begun.append(powers.after(begun[-1], int(step)))
    for step in np.diff(at)[::-1]:
        ended.append(powers.before(ended[-1], int(step)))
    found = []
    for A, B in zip(begun, reversed(ended), strict=True):
        R = A + B @ through
        found.append(np.sum((B @ missing) * B, axis=1) + np.sum((R @ start) * R, axis=1))
    return Decay(at.astype(float), np.array(found), fades=False)


def _dense_at_both_ends(count: int) -> NDArray[np.intp]:
    """Samples from 0 to `count` - 1, all of them near either end, ever fewer towards the middle."""
    strides = np.repeat(2 ** np.arange(20), [POINTS_PER_STRIDE, *[POINTS_PER_STRIDE // 2] * 19])
    near = np.concatenate([[0], np.cumsum(strides)])
    near = near[near <= (count - 1) / 2]
    return np.unique(np.concatenate([near, count - 1 - near])).astype(np.intp)


class _MatrixPowers:
    """Powers of L, those of two kept."""

    def __init__(self, L: Array) -> None:
        self._doubled = [L]

    def _binary_factors(self, exponent: int) -> list[Array]:
        while 2 ** len(self._doubled) <= exponent:
            self._doubled.append(self._doubled[-1] @ self._doubled[-1])
        return [power for i, power in enumerate(self._doubled) if exponent >> i & 1]

    def after(self, rows: Array, exponent: int) -> Array:
        """Rows L^exponent."""
        for power in self._binary_factors(exponent):
            rows = rows @ power
        return rows

    def before(self, rows: Array, exponent: int) -> Array:
        """Rows L'^exponent."""
        for power in self._binary_factors(exponent):
            rows = rows @ power.T
        return rows

    def to_power(self, exponent: int) -> Array:
        """L^exponent."""
        return self.after(np.eye(len(self._doubled[0])), exponent)


def refer_adjoint_to_steady(excess_covariance: Array, rho: Array, information: Array) -> tuple[Array, Array]:
    """Adjoint (N,) and information (N, N) for a state of covariance P, from those for one of P + D.

    (1 - J D)^-1 of both: what is to come tells the same of the state whatever is known of it before.
    """
    together = np.linalg.solve(
        np.eye(len(excess_covariance)) - information @ excess_covariance, np.column_stack([rho, information])
    )
    return np.ascontiguousarray(together[:, 0]), np.asarray(together[:, 1:])


def posterior_excess(excess_covariance: Array, information: Array) -> Array:
    """D (1 + O D)^-1 (N, N): covariance of what the start was wrong by, given all that follows."""
    return np.asarray(
        np.linalg.solve(np.eye(len(excess_covariance)) + excess_covariance @ information, excess_covariance)
    )


def information_with_excess(excess_covariance: Array, information: Array) -> Array:
    """(1 + O D)^-1 O (N, N): what the samples after an uncertain start tell of the state at it."""
    return np.asarray(np.linalg.solve(np.eye(len(excess_covariance)) + information @ excess_covariance, information))
