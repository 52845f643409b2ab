"""Measured frequency responses in the form in which a fit takes runs: lines of channels and loads, with their noise.

The error of a response T (c, u) at a line has the covariance L kron C (see `FrequencyResponse`). With the loads
W = (K*)^-1, where L = K K*, the columns of T W have independent errors of covariance C each: they are u experiments, as
u runs at this frequency would have made them, and the loads are exact. What noise of the recorded loads did to the
response is in C.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.covariance_pooling import inverse_bias_factor
from balance_cli.signals.run_spectrum import FrequencyResponse, RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]

LEAST_VARIANCE_DOF = 2.0
"""Degrees of freedom of a variance from which the mean of its inverse is finite, and known."""


def spectrum_of_response(response: FrequencyResponse) -> RunSpectrum:
    """Return the lines of a response that are independent of each other, u experiments at each.

    Raises UserError where it is not known how well the noise of the response is known.
    """
    if response.noise_dof is None:
        fault = "does not say how well its noise is known: it was written by an earlier version"
        raise UserError(fault, place=f"response {response.run}", remedy="Make it again by `sweep-tf` or `import-frf`")
    lines = response.select(independent_lines(response))
    k, c, u = lines.response.shape
    loads = _independent_loads(lines.load_covariance)
    noise, dof = _known_noise(lines.channel_covariance, response.noise_dof)
    covariance = np.zeros((k * u, c + u, c + u), complex)
    covariance[:, :c, :c] = np.repeat(noise, u, axis=0)
    return RunSpectrum(
        run=response.run,
        channel_names=response.channel_names,
        components=response.components,
        frequency=np.repeat(lines.frequency, u),
        channels=np.asarray((lines.response @ loads).swapaxes(1, 2).reshape(k * u, c), complex),
        loads=np.asarray(loads.swapaxes(1, 2).reshape(k * u, u), complex),
        covariance=covariance,
        dof=dof,
        rotor_speed=response.rotor_speed,
        level=response.level if np.all(np.isfinite(response.level)) else (),
    )


def _independent_loads(covariance: ComplexArray) -> ComplexArray:
    """Return loads (k, u, u), an experiment in each column, for which errors of this load covariance are independent.

    They are determined up to a unitary factor: that of a Fourier transform gives each experiment a share of all loads,
    as starting values need that are found from a part of the lines.
    """
    whitening = np.linalg.inv(np.linalg.cholesky(covariance)).conj().swapaxes(1, 2)
    return np.asarray(whitening @ np.fft.fft(np.eye(covariance.shape[1]), norm="ortho"))


def independent_lines(response: FrequencyResponse) -> Mask:
    """Return the lines (k,) to be used as if each were independent of the others: as many as the shares add up to."""
    if response.line_share is None:
        return np.ones(len(response.frequency), bool)
    # The first line counts, and then the one at which the sum of the shares has grown by one.
    number = np.floor(np.cumsum(response.line_share) - response.line_share[0] + 1.0 + np.finfo(float).eps)
    return np.asarray(np.diff(number, prepend=0.0) > 0.0)


def _known_noise(covariance: ComplexArray, dof: float) -> tuple[ComplexArray, float]:
    """Return covariances (k, c, c) and their degrees of freedom, as an inverse needs them.

    Of independent channels only variances were estimated: they are raised so that their inverse is right in the mean,
    and then count as known.
    """
    diagonal = np.eye(covariance.shape[1], dtype=bool)
    if np.any(covariance[:, ~diagonal]):
        return covariance, dof
    return covariance / inverse_bias_factor(max(dof, LEAST_VARIANCE_DOF), 1), float("inf")
