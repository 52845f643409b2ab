"""The precision of measured lines: inverse of a covariance that was itself estimated from the record."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import MIN_DOF_PER_SIGNAL, inverse_bias_factor
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def live_precision(lines: RunSpectrum, has_exact_loads: bool) -> ComplexArray:
    """Inverse covariance (K, n, n) of a run's own channels, and of its loads unless these are exact.

    Zero where a variance is infinite. It contains the factor `weight_efficiency`.
    """
    count = len(lines.channel_names)
    used = slice(0, count) if has_exact_loads else slice(0, count + len(lines.components))
    noise = lines.window or lines
    covariance = _replace_infinite_variances(noise.covariance[:, used, used])
    # Noise of several parts has few parameters, however many channels there are (see `row_noise`).
    if lines.noise_parts and not _is_well_known(noise.dof, count):
        inverse = np.linalg.inv(covariance) * _variance_bias_factor(noise.dof)
    else:
        inverse = _invert_covariance(covariance, noise.dof, count) * weight_efficiency(lines)
    return np.asarray(np.where(has_finite_variance(noise.covariance)[:, used, None], inverse, 0.0))


def weight_efficiency(lines: RunSpectrum) -> float:
    """The share of the information that is left when a sample covariance takes the place of the true one.

    With P = (dof - n) W^-1, W complex Wishart, E[P] = C^-1 and E[P C P] = dof / (dof - n) C^-1 (Maiwald and Kraus,
    IEE Proc. Radar 147, 2000): an estimate weighted by P scatters more by that factor than its information says.
    """
    size = len(lines.channel_names)
    dof = (lines.window or lines).dof
    return inverse_bias_factor(dof, size) if _is_well_known(dof, size) else 1.0


def has_finite_variance(covariance: ComplexArray) -> NDArray[np.bool_]:
    """Which signals (K, n) carry information at a line: those with a finite variance."""
    return np.isfinite(np.diagonal(covariance, axis1=1, axis2=2))


def _replace_infinite_variances(covariance: ComplexArray) -> ComplexArray:
    """Covariances (K, n, n) with one in place of an infinite variance."""
    is_finite = has_finite_variance(covariance)
    if is_finite.all():
        return covariance
    finite = covariance.copy()
    diagonal = np.arange(covariance.shape[1])
    finite[:, diagonal, diagonal] = np.where(is_finite, finite[:, diagonal, diagonal], 1.0)
    return finite


def _invert_covariance(covariance: ComplexArray, dof: float, size: int) -> ComplexArray:
    """Unbiased inverse of covariances (K, n, n) that were estimated with `dof` degrees of freedom.

    With too few of them only the variances are known well enough to be inverted.
    """
    if _is_well_known(dof, size):
        return np.asarray(np.linalg.inv(covariance) * inverse_bias_factor(dof, size), complex)
    variances = np.real(np.diagonal(covariance, axis1=1, axis2=2))
    return np.asarray(_variance_bias_factor(dof) / variances[:, :, None] * np.eye(variances.shape[1]), complex)


def _is_well_known(dof: float, size: int) -> bool:
    """Whether a covariance of this number of signals is known well enough to be inverted."""
    return dof > MIN_DOF_PER_SIGNAL * size


def _variance_bias_factor(dof: float) -> float:
    """The factor that removes the bias of the inverse of a single variance."""
    return inverse_bias_factor(dof, 1) if dof > 1 else 1.0
