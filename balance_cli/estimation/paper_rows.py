"""The rows of the paper's form as a response to six loads: its sensors, and the torque by the computed shaft."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.paper.fit import response as plate_response
from balance_cli.estimation.paper.result import PaperFit
from balance_cli.estimation.paper.spectra import sensor_combination
from balance_cli.estimation.response_error import ResponseError
from balance_cli.estimation.response_error_estimate import Residuals, response_error_of_residuals
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def torque_channel(geometry: Geometry) -> str | None:
    """Return the name of the channel of the torque meter; None where the rig has none."""
    return next((channel.name for channel in geometry.channels if channel.torque_meter), None)


def row_names(fit: PaperFit, geometry: Geometry) -> tuple[str, ...]:
    """Return the names of the rows: the sensors, and the torque channel where there is one."""
    torque = torque_channel(geometry)
    return fit.rule.names if torque is None else (*fit.rule.names, torque)


def row_response(fit: PaperFit, geometry: Geometry, frequency: Array, spin: float) -> ComplexArray:
    """Return G(w) B_F of the sensors and k / (k + jwd - w^2 J) of the torque, (k, rows, 6)."""
    n, torque = len(fit.rule.names), torque_channel(geometry)
    value = np.zeros((len(frequency), len(row_names(fit, geometry)), 6), complex)
    value[:, :n, [COMPONENTS.index(name) for name in fit.inputs]] = plate_response(fit, frequency)
    if torque is not None:
        system = balance_model(geometry).system()
        row = system.channel_names.index(torque)
        value[:, n, 5] = response(system, solve(system, frequency, spin))[:, row, 5]
    return value


def estimate_row_error(fit: PaperFit, geometry: Geometry, runs: tuple[RunSpectrum, ...]) -> ResponseError | None:
    """Return what the form misses of all lines of the runs, inside and outside the band of the fit; None if nothing.

    Runs that lack the channels of a cell are left out; the row of the torque counts where a run has its channel.
    """
    parts = [part for run in runs for part in _residuals_by_component(fit, geometry, run)]
    return response_error_of_residuals(parts, row_names(fit, geometry))


def _residuals_by_component(fit: PaperFit, geometry: Geometry, run: RunSpectrum) -> list[tuple[int, Residuals]]:
    """Return component and residual rows for each load of a run, each divided by its load.

    Where several loads act at once, the residual is divided among them in proportion to what each contributes.
    """
    run = run.select(run.frequency > 0)
    L = sensor_combination(geometry, fit.rule, run)
    if L is None or not len(run.frequency):
        return []
    columns = [COMPONENTS.index(name) for name in run.components]
    T = row_response(fit, geometry, run.frequency, run.rotor_speed)[:, :, columns]
    transform = np.zeros((len(T), T.shape[1], len(run.channel_names) + len(columns)), complex)
    transform[:, : L.shape[1], : L.shape[2]] = L
    torque = torque_channel(geometry)
    if torque in run.channel_names:
        transform[:, -1, run.channel_names.index(str(torque))] = 1.0
    measured = np.any(transform != 0.0, axis=(0, 2))
    transform[:, :, len(run.channel_names) :] = -T * measured[:, None]
    # Unused channels are removed, not multiplied by zero: 0 times a non-finite value is not zero.
    read = np.any(transform != 0.0, axis=(0, 1))
    transform = transform[:, :, read]
    z = np.concatenate([run.channels, run.loads], axis=1)[:, read]
    residual = (transform @ z[:, :, None])[:, :, 0]
    noise = run.covariance[:, read][:, :, read]
    variance = np.einsum("kri,kij,krj->kr", transform, noise, transform.conj()).real
    return _divided_by_load(run, columns, _contribution(T, run.loads, variance), residual, variance)


def _contribution(T: ComplexArray, loads: ComplexArray, variance: Array) -> Array:
    """Return the power (k, u) of each load's share of the rows, in units of their noise."""
    scale = np.where(variance > 0, variance, np.inf)
    return np.asarray(np.sum(np.abs(T) ** 2 / scale[:, :, None], axis=1) * np.abs(loads) ** 2)


def _divided_by_load(
    run: RunSpectrum, columns: list[int], power: Array, residual: ComplexArray, variance: Array
) -> list[tuple[int, Residuals]]:
    share = np.sqrt(power / np.maximum(power.sum(axis=1, keepdims=True), np.finfo(float).tiny))
    parts = []
    for i, component in enumerate(columns):
        acts = np.abs(run.loads[:, i]) > 0
        if acts.any():
            scale = (share[acts, i] / np.abs(run.loads[acts, i]))[:, None]
            parts.append((component, Residuals(run.frequency[acts], residual[acts] * scale, variance[acts] * scale**2)))
    return parts
