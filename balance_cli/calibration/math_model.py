"""Outputs of all channels as functions of all loads, through every trim: one model, and loads from it by iteration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from balance_cli.calibration.convergence import Contraction, contraction, iterate_loads
from balance_cli.calibration.terms import Term, columns, linear_terms, term_derivatives, term_from_name

Array = NDArray[np.float64]
CONFIDENCE = 0.95


@dataclass(frozen=True)
class CalibrationModel:
    """Readings r - zero = sum over p terms of coefficients (p, c) times terms of the loads over `full_range` (k,).

    The first k terms are the loads themselves. Coefficients [V], with `covariance` (c, p, p) of each channel's own;
    those that a channel does not have are zero, with zero variance. `t`, `p_value` and `variance_inflation` (p, c), NaN
    where a channel has no such term. `residual_covariance` (c, c) of a row, with `dof` (c,); `left_out` (c,): rms of
    rows predicted by the sequences that they are not of [V]; `press` (c,): rms of rows predicted by all others [V].
    `zeros` (s, c): reading of the unloaded rig in each of s loading sequences, `zero_sigma` (s, c).
    `largest` (k,) and `smallest` (k,) [N, N m]: the loads between which it was calibrated.
    `refused`: terms that the loads do not support, with the reason.
    """

    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    full_range: Array
    terms: tuple[str, ...]
    coefficients: Array
    covariance: Array
    t: Array
    p_value: Array
    variance_inflation: Array
    residual_covariance: Array
    dof: Array
    press: Array
    left_out: Array
    sequences: tuple[str, ...]
    zeros: Array
    zero_sigma: Array
    largest: Array
    smallest: Array
    refused: dict[str, str]

    @property
    def curved(self) -> bool:
        """Whether there is more than the loads themselves."""
        return len(self.terms) > len(self.components)

    @property
    def parsed_terms(self) -> tuple[Term, ...]:
        """The terms as such."""
        return tuple(term_from_name(name, self.components) for name in self.terms)

    def inverse(self, rows: NDArray[np.intp] | None = None) -> Array:
        """W (k, c): the weighted inverse of the straight part, loads over full range; of some channels (rows)."""
        k = len(self.components)
        at = np.arange(len(self.channel_names)) if rows is None else rows
        return weighted_inverse(self.coefficients[:k, at].T, self.residual_covariance[np.ix_(at, at)])

    def nonlinear_matrix(self, rows: NDArray[np.intp] | None = None) -> Array:
        """W C2 (k, q): the loads, over full range, that each curved term feigns."""
        at = np.arange(len(self.channel_names)) if rows is None else rows
        return np.asarray(self.inverse(rows) @ self.coefficients[len(self.components) :, at].T)

    def contraction(self, rows: NDArray[np.intp] | None = None) -> Contraction:
        """The proof that the iteration converges."""
        return contraction(self.nonlinear_matrix(rows), self.parsed_terms[len(self.components) :], len(self.components))

    def readings(self, loads: ArrayLike) -> Array:
        """Readings (m, c) [V] beyond the zero, of loads (m, k) [N, N m]."""
        return np.asarray(columns(self.parsed_terms, np.asarray(loads, float) / self.full_range) @ self.coefficients)

    def jacobian(self, loads: ArrayLike, rows: NDArray[np.intp] | None = None) -> Array:
        """Derivative (m, c, k) [V] of the readings by the loads over full range, at loads (m, k) [N, N m]."""
        at = np.arange(len(self.channel_names)) if rows is None else rows
        x = np.atleast_2d(np.asarray(loads, float)) / self.full_range
        return np.asarray(np.einsum("mpk,pc->mck", term_derivatives(self.parsed_terms, x), self.coefficients[:, at]))

    def model_covariance(self, loads: ArrayLike, rows: NDArray[np.intp] | None = None) -> Array:
        """Covariance (m, c, c) [V2] that the errors of the coefficients leave in the readings of loads (m, k) [N, N m].

        Coefficients of two channels are as alike as their residuals: their terms come from the same rows.
        """
        at = np.arange(len(self.channel_names)) if rows is None else rows
        X = columns(self.parsed_terms, np.atleast_2d(np.asarray(loads, float)) / self.full_range)
        spread = np.sqrt(np.maximum(np.einsum("mp,cpq,mq->mc", X, self.covariance[at], X, optimize=True), 0.0))
        S = self.residual_covariance[np.ix_(at, at)]
        size = np.sqrt(np.diag(S))
        return np.asarray(spread[:, :, None] * (S / (size[:, None] * size)) * spread[:, None, :])

    def loads(self, change: ArrayLike, rows: NDArray[np.intp] | None = None) -> tuple[Array, NDArray[np.bool_]]:
        """Loads (m, k) [N, N m] of readings (m, c) [V] beyond the zero, and for which rows (m,) the iteration holds.

        It holds where it converged to loads within the reach of the proof.
        """
        proof = self.contraction(rows)
        linear_loads = np.atleast_2d(np.asarray(change, float)) @ self.inverse(rows).T
        x, done = iterate_loads(linear_loads, self.nonlinear_matrix(rows), self.parsed_terms[len(self.components) :])
        inside = np.all(np.abs(x) <= proof.reach, axis=1)
        return x * self.full_range, done & inside & proof.proved

    def load_covariance(
        self, loads: ArrayLike, reading_covariance: ArrayLike | None = None, rows: NDArray[np.intp] | None = None
    ) -> Array:
        """Covariance (m, k, k) of loads (m, k) found from readings of covariance (c, c), by default that of a row.

        With the tangent J = dr/dx at the loads and W = (J'S^-1 J)^-1 J'S^-1: W (S + x' cov(b) x) W'.
        """
        at = np.arange(len(self.channel_names)) if rows is None else rows
        S = self.residual_covariance[np.ix_(at, at)]
        noise = S if reading_covariance is None else np.asarray(reading_covariance, float)
        W = np.stack([weighted_inverse(one, S) for one in self.jacobian(loads, rows)])
        whole = noise + self.model_covariance(loads, rows)
        covariance = W @ whole @ W.swapaxes(1, 2)
        return np.asarray(covariance * self.full_range[:, None] * self.full_range)

    def interval(self, loads: ArrayLike, reading_covariance: ArrayLike | None = None) -> Array:
        """Half the width (m, k) of the interval that holds a load with probability CONFIDENCE."""
        variance = np.diagonal(self.load_covariance(loads, reading_covariance), axis1=1, axis2=2)
        return np.asarray(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, float(self.dof.min())) * np.sqrt(variance))

    def extrapolated_components(self, loads: ArrayLike) -> tuple[str, ...]:
        """Components whose load (k,) lies outside what the calibration applied."""
        f = np.asarray(loads, float)
        outside = (f > self.largest) | (f < self.smallest)
        return tuple(name for name, is_outside in zip(self.components, outside, strict=True) if is_outside)

    def channel_coefficients(self, channel: str) -> Mapping[str, float]:
        """Coefficients [V] of one channel, by term."""
        column = self.coefficients[:, self.channel_names.index(channel)]
        return {name: float(value) for name, value in zip(self.terms, column, strict=True) if value != 0.0}


def weighted_inverse(C: Array, covariance: Array) -> Array:
    """W (k, c) with W C = 1 for C (c, k), of least variance where there are more channels than loads."""
    if C.shape[0] == C.shape[1]:
        return np.asarray(np.linalg.inv(C))
    weighted = np.linalg.solve(covariance, C)
    return np.asarray(np.linalg.solve(C.T @ weighted, weighted.T))


def linear_term_names(components: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the terms that are the loads themselves."""
    return tuple(term.name(components) for term in linear_terms(len(components)))
