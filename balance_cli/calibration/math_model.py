"""The calibration model: readings of all channels as functions of all loads, and loads by iteration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.convergence import Contraction, contraction, iterate_loads
from balance_cli.calibration.terms import Term, term_derivatives, term_from_name, term_values
from balance_cli.calibration.weight_covariance import weight_covariance, weight_widening
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationModel:
    """Readings r = zero + sum over p terms of coefficients (p, c) times terms of the loads.

    The loads are in units of `calibrated_range` (k,) [N, N m]. The first k terms are the loads themselves.
    `coefficients` (p, c) [V] with the `covariance` (c, p, p) of those of each channel; both are zero for a term that a
    channel does not have. `t`, `p_value` and `variance_inflation` (p, c) are NaN there.
    `residual_covariance` (c, c) [V2] of a row, with `dof` (c,) degrees of freedom; `press` (c,) [V]: rms error of rows
    predicted by all others; `cross_validation_rms` (c,) [V]: rms error of rows predicted by the other load series.
    `load_series`: description of each of the s series; `zeros` (s, c) [V]: reading of the unloaded rig in each, with
    `zero_sigma` (s, c). `largest_load` and `smallest_load` (k,) [N, N m]: the limits of the applied loads.
    `unsupported_terms`: terms that the loads do not support, with the reason.
    """

    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    calibrated_range: Array = field(metadata={"stored_as": "full_range"})
    terms: tuple[str, ...]
    coefficients: Array
    covariance: Array
    t: Array
    p_value: Array
    variance_inflation: Array
    residual_covariance: Array
    dof: Array
    press: Array
    cross_validation_rms: Array = field(metadata={"stored_as": "left_out"})
    load_series: tuple[str, ...] = field(metadata={"stored_as": "sequences"})
    zeros: Array
    zero_sigma: Array
    largest_load: Array = field(metadata={"stored_as": "largest"})
    smallest_load: Array = field(metadata={"stored_as": "smallest"})
    unsupported_terms: dict[str, str] = field(metadata={"stored_as": "refused"})

    @property
    def is_nonlinear(self) -> bool:
        """Whether the model has terms beyond the loads themselves."""
        return len(self.terms) > len(self.components)

    @property
    def parsed_terms(self) -> tuple[Term, ...]:
        """The terms (p,), parsed from their names."""
        return tuple(term_from_name(name, self.components) for name in self.terms)

    @property
    def press_ratio(self) -> Array:
        """Rms error of rows that the others predict over what the residuals let expect (c,), at least 1.

        Terms are selected, and fitted, so that they follow what the model lacks: rows that are not fitted show more of
        it than the residuals do. With the variance S of the residuals, n rows and d degrees of freedom the errors of
        the coefficients make S n/d of it: they are no lack. 1 where the error is not known.
        """
        zeros = len(self.zeros)
        fitted = np.count_nonzero(np.isfinite(self.t), axis=0) + zeros
        by_coefficients = np.where(self.dof > 0.0, (self.dof + fitted) / np.maximum(self.dof, 1.0), 1.0)
        variance = np.maximum(np.diag(self.residual_covariance) * by_coefficients, np.finfo(float).tiny)
        return np.maximum(np.nan_to_num(self.press / np.sqrt(variance), nan=1.0, posinf=1.0), 1.0)

    def inverse(self, rows: NDArray[np.intp] | None = None) -> Array:
        """Weighted inverse W (k, c) of the linear part, loads in units of the calibrated range; rows: some channels."""
        k = len(self.components)
        at = np.arange(len(self.channel_names)) if rows is None else rows
        return weighted_inverse(self.coefficients[:k, at].T, self.weight_covariance(at))

    def weight_covariance(self, rows: NDArray[np.intp]) -> Array:
        """Covariance (r, r) [V2] of a row by which some channels (rows) are weighted."""
        return weight_covariance(self.residual_covariance[np.ix_(rows, rows)], float(self.dof[rows].min()))

    def weight_widening(self, rows: NDArray[np.intp] | None = None) -> float:
        """Factor on the variance of loads from some channels (rows) whose weights are estimated."""
        at = np.arange(len(self.channel_names)) if rows is None else rows
        S = self.residual_covariance[np.ix_(at, at)]
        return weight_widening(S, float(self.dof[at].min()), len(at) - len(self.components))

    def nonlinear_matrix(self, rows: NDArray[np.intp] | None = None) -> Array:
        """Apparent loads W C2 (k, q) of the nonlinear terms, in units of the calibrated range."""
        at = np.arange(len(self.channel_names)) if rows is None else rows
        return np.asarray(self.inverse(rows) @ self.coefficients[len(self.components) :, at].T)

    def contraction(self, rows: NDArray[np.intp] | None = None) -> Contraction:
        """Contraction factor and reach of the load iteration, with some channels (rows)."""
        return contraction(self.nonlinear_matrix(rows), self.parsed_terms[len(self.components) :], len(self.components))

    def readings(self, loads: ArrayLike) -> Array:
        """Readings (m, c) [V] less the zero, for loads (m, k) [N, N m]."""
        return np.asarray(
            term_values(self.parsed_terms, np.asarray(loads, float) / self.calibrated_range) @ self.coefficients
        )

    def jacobian(self, loads: ArrayLike, rows: NDArray[np.intp] | None = None) -> Array:
        """Jacobian (m, c, k) [V] of the readings with respect to loads in units of the calibrated range."""
        at = np.arange(len(self.channel_names)) if rows is None else rows
        x = np.atleast_2d(np.asarray(loads, float)) / self.calibrated_range
        return np.asarray(np.einsum("mpk,pc->mck", term_derivatives(self.parsed_terms, x), self.coefficients[:, at]))

    def model_covariance(self, loads: ArrayLike, rows: NDArray[np.intp] | None = None) -> Array:
        """Covariance (m, c, c) [V2] of the readings due to the errors of the coefficients, at loads (m, k) [N, N m].

        Coefficients of two channels are correlated as their residuals are, because they are fitted to the same rows.
        """
        at = np.arange(len(self.channel_names)) if rows is None else rows
        X = term_values(self.parsed_terms, np.atleast_2d(np.asarray(loads, float)) / self.calibrated_range)
        sigma = np.sqrt(np.maximum(np.einsum("mp,cpq,mq->mc", X, self.covariance[at], X, optimize=True), 0.0))
        S = self.residual_covariance[np.ix_(at, at)]
        residual_sigma = np.sqrt(np.diag(S))
        correlation = S / (residual_sigma[:, None] * residual_sigma)
        return np.asarray(sigma[:, :, None] * correlation * sigma[:, None, :])

    def loads(self, change: ArrayLike, rows: NDArray[np.intp] | None = None) -> tuple[Array, NDArray[np.bool_]]:
        """Compute loads (m, k) [N, N m] from readings (m, c) [V] less the zero.

        Also returns which rows (m,) are valid: those that converged to loads within the reach of the proof.
        """
        proof = self.contraction(rows)
        linear_loads = np.atleast_2d(np.asarray(change, float)) @ self.inverse(rows).T
        x, converged = iterate_loads(
            linear_loads, self.nonlinear_matrix(rows), self.parsed_terms[len(self.components) :]
        )
        inside = np.all(np.abs(x) <= proof.reach, axis=1)
        return x * self.calibrated_range, converged & inside & proof.is_proved

    def load_covariance(
        self, loads: ArrayLike, reading_covariance: ArrayLike | None = None, rows: NDArray[np.intp] | None = None
    ) -> Array:
        """Covariance (m, k, k) of loads (m, k) [N, N m] from readings of covariance (c, c) or (m, c, c) [V2].

        By default the covariance of the readings is that of a row of the calibration. With the Jacobian J = dr/dx at
        the loads and W = (J'U^-1 J)^-1 J'U^-1, U the `weight_covariance`, it is W (S + x' cov(b) x) W'.
        """
        at = np.arange(len(self.channel_names)) if rows is None else rows
        S, weighting = self.residual_covariance[np.ix_(at, at)], self.weight_covariance(at)
        noise = S if reading_covariance is None else np.asarray(reading_covariance, float)
        W = weighted_inverse(self.jacobian(loads, rows), weighting)
        total = noise + self.model_covariance(loads, rows)
        covariance = W @ total @ W.swapaxes(1, 2)
        return np.asarray(covariance * self.calibrated_range[:, None] * self.calibrated_range)

    def interval(self, loads: ArrayLike, reading_covariance: ArrayLike | None = None) -> Array:
        """Half-width (m, k) [N, N m] of the prediction interval at the level CONFIDENCE."""
        variance = np.diagonal(self.load_covariance(loads, reading_covariance), axis1=1, axis2=2)
        return np.asarray(stats.t.ppf(0.5 + 0.5 * stats.CONFIDENCE, float(self.dof.min())) * np.sqrt(variance))

    def extrapolated_components(self, loads: ArrayLike) -> tuple[str, ...]:
        """Components whose load (k,) [N, N m] lies outside the loads applied in the calibration."""
        f = np.asarray(loads, float)
        outside = (f > self.largest_load) | (f < self.smallest_load)
        return tuple(name for name, is_outside in zip(self.components, outside, strict=True) if is_outside)

    def channel_coefficients(self, channel: str) -> Mapping[str, float]:
        """Coefficients [V] of one channel, by term."""
        column = self.coefficients[:, self.channel_names.index(channel)]
        return {name: float(value) for name, value in zip(self.terms, column, strict=True) if value != 0.0}


def zero_scatter(zeros: Array) -> Array:
    """Covariance (c, c) of the zeros (s, c) of load series about their mean: what an unknown zero may differ by.

    Widened for the number of zeros that tell it; zero where there is but one.
    """
    s, c = zeros.shape
    return np.atleast_2d(np.cov(zeros.T)) * float(stats.student_widening(s - 1.0)) if s > 1 else np.zeros((c, c))


def weighted_inverse(C: Array, covariance: Array) -> Array:
    """Compute W (..., k, c) with W C = 1 for C (..., c, k), of least variance where channels outnumber loads."""
    if C.shape[-2] == C.shape[-1]:
        return np.asarray(np.linalg.inv(C))
    weighted = np.linalg.solve(covariance, C)
    return np.asarray(np.linalg.solve(C.swapaxes(-1, -2) @ weighted, weighted.swapaxes(-1, -2)))
