"""Misfit of an identified model: against the noise of the runs, and relative to the signal."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.paper.equations import Coefficients, model_response
from balance_cli.estimation.paper.spectra import SensorSpectra

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Misfit:
    """`chi2` of the lines fitted against the noise measured in the runs, its `dof`, and relative errors.

    `frf_errors` {run: rms(model - measurement) / rms(measurement)} of the responses s/u over sensors and lines within
    the `frf_band` [Hz], whatever the band of the fit; `frf_error` is their root mean square. NaN where a run has no
    such line.
    """

    chi2: float
    dof: int
    frf_error: float
    frf_errors: dict[str, float]
    frf_band: tuple[float, float] | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def chi2_per_dof(self) -> float:
        """Chi-square per degree of freedom; about 1 where the residual is the measured noise."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")


def compare_with_measurement(
    all_spectra: SensorSpectra,
    fitted_spectra: SensorSpectra,
    model: Coefficients,
    parameters: int,
    frf_band: tuple[float, float],
) -> Misfit:
    """Misfit of `model`: chi2 over the `fitted_spectra`, relative errors over `all_spectra` in the `frf_band` [Hz]."""
    errors = frf_errors(all_spectra.in_band(frf_band), model)
    present = [error for error in errors.values() if np.isfinite(error)]
    frf_error = float(np.sqrt(np.mean(np.square(present)))) if present else float("nan")
    dof = 2 * fitted_spectra.s.size - parameters
    return Misfit(chi2_against_measured_noise(fitted_spectra, model), dof, frf_error, errors, frf_band)


def chi2_against_measured_noise(spectra: SensorSpectra, model: Coefficients) -> float:
    """2 sum eps* C^-1 eps with C the covariance of eps = s - G u from the measured noise of both s and u.

    C = [I, -G] cov[s, u] [I, -G]*. An inverse estimated with dof degrees of freedom is too large by dof / (dof - n)
    (complex Wishart); this factor is removed.
    """
    G = model_response(model, spectra.frequency)
    n = G.shape[1]
    T = np.concatenate([np.broadcast_to(np.eye(n), (len(G), n, n)), -G], axis=2)
    error = _output_error(spectra, G)
    C = T @ spectra.covariance @ np.conj(np.swapaxes(T, 1, 2))
    weighted = np.linalg.solve(C, error[:, :, None])[:, :, 0]
    is_exact = np.isinf(spectra.dof)
    unbiased = np.where(is_exact, 1.0, 1.0 - n / np.maximum(spectra.dof, n + 1))
    return float(2.0 * np.sum(unbiased * np.sum(np.conj(error) * weighted, axis=1).real))


def frf_errors(spectra: SensorSpectra, model: Coefficients) -> dict[str, float]:
    """rms(G u - s) / rms(s) of every run, each line divided by its |u| (its response, where one load is excited)."""
    error = _output_error(spectra, model_response(model, spectra.frequency))
    size = np.sum(np.abs(spectra.u) ** 2, axis=1)
    difference, signal = (np.sum(np.abs(x) ** 2, axis=1) / size for x in (error, spectra.s))
    errors = {}
    for i, run in enumerate(spectra.runs):
        own = spectra.run == i
        errors[run] = float(np.sqrt(difference[own].sum() / signal[own].sum())) if own.any() else float("nan")
    return errors


def _output_error(spectra: SensorSpectra, G: ComplexArray) -> ComplexArray:
    return np.asarray(spectra.s - (G @ spectra.u[:, :, None])[:, :, 0])
