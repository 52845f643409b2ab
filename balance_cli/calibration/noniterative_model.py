"""Loads as functions of the readings: the model of the non-iterative method, which `noniterative` fits."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.terms import term_derivatives, term_values
from balance_cli.signals import distributions as stats
from balance_cli.signals.distributions import CONFIDENCE, student_widening

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NonIterativeModel:
    """Linear loads y = W (r - zero) with `inverse` W (k, c) [1/V], and the model of the loads as functions of y.

    The channels of `model` are the load components, in units of `calibrated_range` (k,) [N, N m].
    """

    inverse: Array
    model: CalibrationModel
    calibrated_range: Array = field(metadata={"stored_as": "full_range"})

    @property
    def residual_percent_fs(self) -> Array:
        """Standard deviation (k,) of the loads about the model, percent of the calibrated range."""
        return np.asarray(100.0 * np.sqrt(np.diag(self.model.residual_covariance)))

    def loads(self, change: ArrayLike) -> Array:
        """Compute loads (m, k) [N, N m] from readings (m, c) [V] less the zero."""
        y = np.atleast_2d(np.asarray(change, float)) @ self.inverse.T
        return np.asarray(term_values(self.model.parsed_terms, y) @ self.model.coefficients * self.calibrated_range)

    def truncation(self, change: ArrayLike, model: CalibrationModel) -> Array:
        """Error (m, k) [N, N m] of the loads of readings (m, c) [V] less the zero that is due to the degree of terms.

        The polynomial of the readings is no exact inverse: of strong curvature it leaves terms of higher degree, which
        no row with few loads shows. It is the difference from the iteration with the `model`, less what the errors of
        the own coefficients explain, which intervals contain anyway, in the root mean square. Where the iteration does
        not converge, the linear loads take its place.
        """
        iterated, _ = model.loads(change)
        linear = np.atleast_2d(np.asarray(change, float)) @ model.inverse().T * model.calibrated_range
        other = np.where(np.isfinite(iterated), iterated, linear)
        y = np.atleast_2d(np.asarray(change, float)) @ self.inverse.T
        by_chance = np.diagonal(self.model.model_covariance(y), axis1=1, axis2=2) * self.calibrated_range**2
        difference = self.loads(change) - other
        return np.asarray(np.sign(difference) * np.sqrt(np.maximum(difference**2 - by_chance, 0.0)))

    def load_covariance(self, change: ArrayLike, reading_covariance: Array, row_noise: Array) -> Array:
        """Covariance (k, k) [N2, N2 m, (N m)2] of the loads for a reading (c,) [V] less its zero.

        `reading_covariance` (c, c) [V2] is that of the reading. Of the errors of rows that the others predict, what
        exceeds the noise of a row, `row_noise` (c, c) [V2], comes beside it. Widened for the degrees of freedom of the
        residuals.
        """
        y = np.atleast_2d(np.asarray(change, float)) @ self.inverse.T
        J = np.einsum("mpk,pl->mlk", term_derivatives(self.model.parsed_terms, y), self.model.coefficients)[0]
        transfer = J @ self.inverse
        reading = transfer @ reading_covariance @ transfer.T
        noise = np.diag(self.inverse @ row_noise @ self.inverse.T)
        predicted_errors = self.model.press_ratio**2 * np.diag(self.model.residual_covariance)
        misfit = np.diag(np.maximum(predicted_errors - noise, 0.0))
        widening = student_widening(self.model.dof.min())
        total = reading + widening * (misfit + self.model.model_covariance(y)[0])
        return np.asarray(total * np.outer(self.calibrated_range, self.calibrated_range))

    def prediction_interval(self, change: ArrayLike, zero_covariance: Array) -> Array:
        """Half-width (m, k) [N, N m] of the prediction interval at the level CONFIDENCE.

        `zero_covariance` (c, c) [V2] of the zero that was subtracted. Errors of rows that the others predict contain
        the noise of the readings and of the loads, and what the model lacks.
        """
        y = np.atleast_2d(np.asarray(change, float)) @ self.inverse.T
        predicted_errors = self.model.press_ratio**2 * np.diag(self.model.residual_covariance)
        own = predicted_errors + np.diag(self.inverse @ zero_covariance @ self.inverse.T)
        coefficients = np.diagonal(self.model.model_covariance(y), axis1=1, axis2=2)
        factor = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, float(self.model.dof.min())))
        return np.asarray(factor * np.sqrt(own + coefficients) * self.calibrated_range)
