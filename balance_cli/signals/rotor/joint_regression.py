"""Normal equations of a weighted regression on rotor harmonics, with other columns beside them where there are any.

With the products A of the harmonics with themselves, C of the other columns with these, and B of the others with
themselves, the inverse of the whole matrix has the part A^-1 + A^-1 C' S^-1 C A^-1 for the harmonics, with the Schur
complement S = B - C A^-1 C': what is left of the other columns once the harmonics are taken out of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_OWN_SHARE = 1e-6
"""Share of a column (or of a combination of columns) that no other column explains, below which it is left out.

Two modes of equal frequency decay alike: one of them suffices. A share of 1e-6 multiplies a standard deviation by up
to 1000; below, the regression loses the digits of its sums.
"""


@dataclass(frozen=True)
class JointRegression:
    """Solution of the normal equations of harmonics 0 to `fitted_count` and e other columns.

    `own` (2 F + 1, 2 F + 1) are the products of the cosines and sines, `border` (e, 2 F + 1 + e) those of the other
    columns with these and among themselves.
    """

    own: Array
    border: Array

    def solve(self, moment: Array) -> Array:
        """Return the coefficients (2 F + 1, c) of cosines and sines for products (2 F + 1 + e, c) with c signals."""
        count = len(self.own)
        alone = np.linalg.solve(self.own, moment[:count])
        if not len(self.border):
            return np.asarray(alone)
        return np.asarray(alone - self._others[0] @ self.solve_others(moment))

    def solve_others(self, moment: Array) -> Array:
        """Return the coefficients (e, c) of the other columns for the same products."""
        if not len(self.border):
            return np.zeros((0, moment.shape[1]))
        explained, directions = self._others
        left = moment[len(self.own) :] - explained.T @ moment[: len(self.own)]
        return np.asarray(directions @ (directions.T @ left))

    def variance_inflation(self) -> Array:
        """Return the factor (2 F + 1,) by which the other columns increase the variance of each coefficient.

        It is the variance inflation factor of regression (Belsley, Kuh and Welsch, Regression Diagnostics, 1980, 93).
        """
        if not len(self.border):
            return np.ones(len(self.own))
        explained, directions = self._others
        variance = np.diag(np.linalg.inv(self.own))
        return np.asarray(1.0 + np.sum((explained @ directions) ** 2, axis=1) / variance)

    @cached_property
    def _others(self) -> tuple[Array, Array]:
        """A^-1 C' (2 F + 1, e) and V (e, k) with V V' = S^-1 over the k directions that can be distinguished."""
        beside, among = np.split(self.border, [len(self.own)], axis=1)
        explained = np.linalg.solve(self.own, beside.T)
        size = 1.0 / np.sqrt(np.maximum(np.diag(among), np.finfo(float).tiny))
        share, vectors = np.linalg.eigh((among - beside @ explained) * np.outer(size, size))
        is_significant = share > LEAST_OWN_SHARE
        return np.asarray(explained), np.asarray(
            size[:, None] * vectors[:, is_significant] / np.sqrt(share[is_significant])
        )


def harmonic_products(turning: ComplexArray, fitted_count: int) -> Array:
    """Return the products (2 F + 1, 2 F + 1) of cosines 0 to F and sines 1 to F, F = `fitted_count`.

    `turning` (2 F + 1,) are the weighted sums of exp(j k psi); cos a cos b = (cos(a - b) + cos(a + b)) / 2.
    """
    k = np.arange(fitted_count + 1)
    both, between = k[:, None] + k, k - k[:, None]
    cosine, sine = turning.real, turning.imag
    cosines = 0.5 * (cosine[np.abs(between)] + cosine[both])
    sines = 0.5 * (cosine[np.abs(between)] - cosine[both])[1:, 1:]
    mixed = 0.5 * (sine[both] + np.sign(between) * sine[np.abs(between)])[:, 1:]
    return np.block([[cosines, mixed], [mixed.T, sines]])


def complex_amplitudes(coefficients: Array, n: int, fitted_count: int) -> ComplexArray:
    """Return X_k = cosine_k - j sine_k (n+1, c) of the coefficients (2 F + 1, c)."""
    amplitude = coefficients[: n + 1].astype(complex)
    amplitude[1:] -= 1j * coefficients[fitted_count + 1 : fitted_count + 1 + n]
    return amplitude
