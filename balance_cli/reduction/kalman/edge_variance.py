"""Variance of an estimate beyond the steady one, near a start, a gap, an end or a change of channels.

Let the initial state of a filter at its steady gain have the covariance P + D in place of P. Its error then contains
L^k d after k samples, where d has the covariance D, and the variance of the filter is larger by (L^k) D (L^k)'. A
smoother estimates d from the samples that follow: given y, d has the covariance D (1 + O D)^-1 with
O = sum L^j' H' S^-1 H L^j, and the mean D (1 + O D)^-1 rho[0] (de Jong, Ann. Statist. 19, 1991, 1073, with D going to
infinity). Before an end, after which only the information J follows in place of O, a smoother lacks the information
L^j' (O - J) L^j.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.riccati import inverse_sum, symmetrize
from balance_cli.reduction.kalman.steady_matrices import SteadyMatrices

Array = NDArray[np.float64]

STRIDES = (1, 8, 64, 512)
"""Steps [samples] at which a decay is evaluated, in turn: dense where it is fast."""
POINTS_PER_STRIDE = 16
"""Points of each stride, with linear interpolation between; they reach 16 (1 + 8 + 64 + 512) = 9360 samples."""
NEGLIGIBLE_SHARE = 1e-4
"""Share of the steady variance below which an addition is dropped: it changes sigma by 5e-5."""


@dataclass(frozen=True)
class Decay:
    """A variance (o,) as a function of the distance from an edge: `value` (p, o) at distances `at` (p,) [samples].

    Beyond the last distance it is zero if it `fades`, otherwise constant.
    """

    at: Array
    value: Array
    fades: bool = True

    def after(self, samples: NDArray[np.intp]) -> Array:
        """Return the variance (n, o) at distances (n,) [samples], by linear interpolation."""
        beyond = 0.0 if self.fades else None
        return np.stack([np.interp(samples, self.at, column, right=beyond) for column in self.value.T], axis=1)


def variance_decay(rows: Array, transition: Array, spread: Array, count: int, floor: Array) -> Decay:
    """Return diag(rows A^k spread (rows A^k)') for k = 0 .. count - 1, until it is negligible beside `floor` (o,).

    rows (o, N), transition A and spread (N, N).
    """
    at: list[int] = []
    values: list[Array] = []
    k, power = 0, transition
    for i, stride in enumerate(STRIDES):
        if i:
            power = np.linalg.matrix_power(power, STRIDES[i] // STRIDES[i - 1])
        for _ in range(POINTS_PER_STRIDE):
            at.append(k)
            values.append(np.einsum("on,on->o", rows @ spread, rows))
            if k >= count or np.all(np.abs(values[-1]) <= NEGLIGIBLE_SHARE * floor):
                return Decay(np.array(at, float), np.array(values))
            rows, k = rows @ power, k + stride
    return Decay(np.array(at, float), np.array(values))


def smoother_edge_variance(rows: Array, steady: SteadyMatrices, missing: Array, start: Array, count: int) -> Decay:
    """Return the variance that both edges of a segment add to the steady one of a smoother, with their interaction.

    `missing` = O - J (N, N) at the end; `start` (N, N): covariance of the error of the initial state, given all
    samples. With B = rows P L'^j, j samples before the end, and R = rows (1 - P O_k) L^k = rows (1 - P O) L^k + B (O -
    J) L^n,

        diag(B (O - J) B' + R start R').
    """
    at = _dense_at_both_ends(count)
    powers = _MatrixPowers(steady.L)
    through = missing @ powers.to_power(count)
    from_start = [rows - (rows @ steady.P) @ steady.all_information]
    from_end = [rows @ steady.P @ powers.to_power(count - int(at[-1])).T]
    for step in np.diff(at):
        from_start.append(powers.after(from_start[-1], int(step)))
    for step in np.diff(at)[::-1]:
        from_end.append(powers.before(from_end[-1], int(step)))
    values = []
    for A, B in zip(from_start, reversed(from_end), strict=True):
        R = A + B @ through
        values.append(np.sum((B @ missing) * B, axis=1) + np.sum((R @ start) * R, axis=1))
    return Decay(at.astype(float), np.array(values), fades=False)


def refine_near_start(decay: Decay, rows: Array, steady: SteadyMatrices, later: Array, excess: Array) -> Decay:
    """Return the decay from a start of covariance P + D with its first values from the information of later samples.

    D = `excess` and I = `later` (N, N). At sample k they are diag(rows ((P + L^k D L'^k)^-1 + I)^-1 rows'), a sum of
    squares, less the steady variance. Where D is larger than P by many orders, as after a gap of loads of which nearly
    nothing is assumed, the difference that they replace is one of rounding errors: by more than the steady variance.
    """
    value, spread = decay.value.copy(), excess
    _, smoothed = steady.output_variances(rows)
    for k in range(int(np.count_nonzero(decay.at < POINTS_PER_STRIDE))):
        R = rows @ inverse_sum(symmetrize(steady.P + spread), later)
        stable = np.sum(R**2, axis=1) - smoothed
        value[k] = np.where(np.abs(value[k] - stable) > smoothed, stable, value[k])
        spread = steady.L @ spread @ steady.L.T
    return replace(decay, value=value)


def _dense_at_both_ends(count: int) -> NDArray[np.intp]:
    """Return samples from 0 to `count` - 1: all of them near either end, fewer toward the middle."""
    strides = np.repeat(2 ** np.arange(20), [POINTS_PER_STRIDE, *[POINTS_PER_STRIDE // 2] * 19])
    near = np.concatenate([[0], np.cumsum(strides)])
    near = near[near <= (count - 1) / 2]
    return np.unique(np.concatenate([near, count - 1 - near])).astype(np.intp)


class _MatrixPowers:
    """Powers of L, from cached powers L^(2^i)."""

    def __init__(self, L: Array) -> None:
        self._doubled = [L]

    def _binary_factors(self, exponent: int) -> list[Array]:
        while 2 ** len(self._doubled) <= exponent:
            self._doubled.append(self._doubled[-1] @ self._doubled[-1])
        return [power for i, power in enumerate(self._doubled) if exponent >> i & 1]

    def after(self, rows: Array, exponent: int) -> Array:
        """Return rows L^exponent."""
        for power in self._binary_factors(exponent):
            rows = rows @ power
        return rows

    def before(self, rows: Array, exponent: int) -> Array:
        """Return rows L'^exponent."""
        for power in self._binary_factors(exponent):
            rows = rows @ power.T
        return rows

    def to_power(self, exponent: int) -> Array:
        """Return the power L^exponent (N, N) of the steady matrix of the recursion."""
        return self.after(np.eye(len(self._doubled[0])), exponent)


def refer_adjoint_to_steady(excess_covariance: Array, rho: Array, information: Array) -> tuple[Array, Array]:
    """Return adjoint (N,) and information (N, N) for a state of covariance P, from those for one of P + D.

    Both are multiplied by (1 - J D)^-1: what the later samples say of the state does not depend on its prior.
    """
    factor = np.eye(len(excess_covariance)) - information @ excess_covariance
    solution = np.linalg.solve(factor, np.column_stack([rho, information]))
    return np.ascontiguousarray(solution[:, 0]), np.asarray(solution[:, 1:])


def posterior_excess(excess_covariance: Array, information: Array) -> Array:
    """Return D (1 + O D)^-1 (N, N), the covariance of the error of an initial state given all samples after it."""
    return np.asarray(
        np.linalg.solve(np.eye(len(excess_covariance)) + excess_covariance @ information, excess_covariance)
    )


def information_with_excess(excess_covariance: Array, information: Array) -> Array:
    """Return (1 + O D)^-1 O (N, N), the information of the samples after an initial state of excess covariance D."""
    return np.asarray(np.linalg.solve(np.eye(len(excess_covariance)) + information @ excess_covariance, information))
