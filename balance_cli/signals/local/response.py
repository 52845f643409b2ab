"""Frequency responses of any record by local polynomial or local rational models, which are free of leakage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.local.misfit import missed_response_power
from balance_cli.signals.local.models import LocalModels, decimate_lines, fit_local_models
from balance_cli.signals.local.scaled_spectrum import local_power, record_spectrum
from balance_cli.signals.local.window import pole_uncertainty, response_rows
from balance_cli.signals.run_samples import LARGEST_LOAD_CONDITION, combination_text
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


LEAST_SEPARATE_POWER = 10.0
"""Least power of each combination of loads over that of their noise. Loads of different phases have a share of 0.1 and
more of their power in each; two loads of one ratio left responses 80 % wrong."""


def local_response(
    run: Run, channel_names: Sequence[str], estimator: str = "lrm", band: tuple[float, float] = (0.0, np.inf)
) -> FrequencyResponse:
    """Estimate the frequency response of one run at its own lines within `band` [Hz], by `lrm` or `lpm`.

    Components that are excited at once are separated where their spectra differ. Raises UserError where the run has no
    loads, or its record is too short.
    """
    models = fit_local_models(record_spectrum(run, channel_names, band), estimator)
    return response_from_models(models, estimator)


def response_from_models(models: LocalModels, estimator: str) -> FrequencyResponse:
    """Return the response of fitted models with separable covariance and coherences, at the excited lines [V/N]."""
    s = models.spectrum
    _require_separable_loads(models)
    lines = decimate_lines(s.excited)
    channel_covariance, load_covariance, pole_excess = _response_covariance(models, lines)
    response = models.response[lines]
    noise = replace(models.noise, channels=models.noise.channels[lines]).equation_error_covariance(response)
    power = local_power(s.loads)[lines]
    ordinary, multiple = coherences(response, noise, power)
    volts, load = s.channel_scale, s.load_scale
    return FrequencyResponse(
        run=s.run.name,
        channel_names=s.channel_names,
        components=s.components,
        estimator=estimator,
        frequency=s.frequency[lines],
        response=response * volts[:, None] / load,
        channel_covariance=channel_covariance * (volts[:, None] * volts),
        load_covariance=load_covariance / (load[:, None] * load),
        coherence=ordinary,
        multiple_coherence=multiple,
        rotor_speed=s.run.rotor_speed,
        level=s.run.level,
        noise_dof=models.noise.dof,
        line_share=_line_share(load_covariance, power, pole_excess, np.count_nonzero(s.excited) / len(lines)),
    )


def _line_share(covariance: ComplexArray, power: ComplexArray, pole_excess: Array, decimation: float) -> Array:
    """Return the share (k,) of each line that is independent of the others.

    It is the variance of the response, `covariance` (k, u, u) times `pole_excess` (k,), over that of a single line of
    u loads with `power` (k, u, u): the leverage of the line, of which the sum is the number of parameters.
    """
    leverage = np.einsum("kuv,kvu->k", covariance, power).real / covariance.shape[1]
    return np.asarray(np.clip(leverage * pole_excess * decimation, np.finfo(float).eps, 1.0))


def _require_separable_loads(models: LocalModels) -> None:
    """Raise UserError where loads have one ratio in most windows, up to their noise: only their sum has a response."""
    s = models.spectrum
    if len(s.components) == 1:
        return
    windows = [fit.U for fit in models.fit]
    powers = np.stack([U.conj().T @ U / len(U) for U in windows])
    values, vectors = np.linalg.eigh(powers)
    least = vectors[:, :, 0]
    floor = np.einsum("wu,uv,wv->w", least.conj(), models.noise.loads, least).real
    floor = np.maximum(LEAST_SEPARATE_POWER * floor, values[:, -1] / LARGEST_LOAD_CONDITION**2)
    if np.median(values[:, 0] > floor) > 0.5:
        return
    weights = np.linalg.eigh(powers.mean(axis=0).real)[1][:, 0] * s.load_scale
    missing = combination_text(weights, s.components)
    fault = f"the loads {', '.join(s.components)} were applied in a fixed ratio: {missing} was never applied"
    remedy = "Excite one component at a time, or record as many runs as components with different phases"
    raise UserError(fault, s.run.file, "loads", f"{remedy}; `identify` needs no response to each")


def _response_covariance(models: LocalModels, lines: NDArray[np.intp]) -> tuple[ComplexArray, ComplexArray, Array]:
    """Factors (k, c, c) of the channels and (k, u, u) of the loads of the covariance at the lines `lines` (k,).

    Also returned is the variance with uncertain poles over that with known ones (k,), the mean over the channels.

    The response at a line is a weighted sum over the outputs of its window. Its covariance is the same sum over their
    noise, plus the contribution of the uncertainty of the poles, plus what the model misses of the response. With
    several inputs the weights differ from input to input; the factor of the channels uses their mean.
    """
    c, u = models.response.shape[1:]
    channels, loads = np.zeros((len(lines), c, c), complex), np.zeros((len(lines), u, u), complex)
    pole_excess = np.ones(len(lines))
    for w, fit in enumerate(models.fit):
        start = models.first[w]
        assigned = slice(*np.searchsorted(lines, models.assigned_lines[w]))
        r = fit.r[lines[assigned] - start]
        noise = models.noise.equation_error_covariance(models.response, slice(start, start + len(fit.r)))
        weights = response_rows(fit, r) @ fit.pseudoinverse
        loads[assigned] = weights @ weights.conj().swapaxes(1, 2)
        precision = _load_precision(models, loads[assigned])
        share = np.einsum("kum,kuv,kvm->km", weights.conj(), precision, weights, optimize=True).real / u
        channels[assigned] = np.tensordot(share, noise, axes=1)
        if fit.orders.denominator:
            shift = pole_uncertainty(fit, r, noise)
            of_poles = np.einsum("kcua,kuv,kdva->kcd", shift, precision, shift.conj(), optimize=True) / u
            pole_excess[assigned] += np.mean(_variances(of_poles) / _variances(channels[assigned]), axis=1)
            channels[assigned] += of_poles
        missed = missed_response_power(fit, slice(*(models.assigned_lines[w] - start)), noise)
        if missed.any():
            variance = np.diagonal(loads[assigned], axis1=1, axis2=2).real
            channels[assigned] += (missed / variance[:, None, :]).mean(axis=2)[:, :, None] * np.eye(c)
    return channels, loads, pole_excess


def _variances(covariance: ComplexArray) -> Array:
    """Return the diagonal (k, c) of covariances (k, c, c), above zero."""
    return np.maximum(np.diagonal(covariance, axis1=1, axis2=2).real, np.finfo(float).tiny)


def _load_precision(models: LocalModels, covariance: ComplexArray) -> ComplexArray:
    """The inverse (k, u, u). Raises UserError where the loads are proportional to each other."""
    try:
        return np.asarray(np.linalg.inv(covariance))
    except np.linalg.LinAlgError as error:
        run = models.spectrum.run
        fault = f"the loads {', '.join(models.spectrum.components)} are proportional to each other"
        remedy = "Leave the run out, or excite one component at a time"
        raise UserError(fault, run.file, "loads", remedy) from error


def coherences(response: ComplexArray, noise: ComplexArray, power: ComplexArray) -> tuple[Array, Array]:
    """Return the ordinary (K, c, u) and multiple (K, c) coherence.

    `response` G is (K, c, u), `noise` (K, c, c) that of `Y - G U`, `power` S (K, u, u) that of the loads. The multiple
    coherence is G S G* over G S G* plus noise, the ordinary one |S_yu|^2 / (S_yy S_uu) with S_yu = G S (Bendat and
    Piersol, Random Data, 4th ed., 2010).
    """
    cross = response @ power
    signal = np.einsum("kcu,kcu->kc", cross, response.conj()).real
    total = signal + np.diagonal(noise, axis1=1, axis2=2).real
    load_power = np.diagonal(power, axis1=1, axis2=2).real
    ordinary = np.abs(cross) ** 2 / np.maximum(total[:, :, None] * load_power[:, None, :], 1e-300)
    return np.clip(ordinary, 0.0, 1.0), np.clip(signal / np.maximum(total, 1e-300), 0.0, 1.0)
