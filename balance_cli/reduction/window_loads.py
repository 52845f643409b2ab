"""Loads of the windows of a record, for tests of whether they stay the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import TrimCalibration
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.rotor.steadiness import WindowedAmplitudes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_NOISE = 1e-6
"""Of the noise of the noisiest row: with less, as of a coarse converter that repeats itself in each revolution, normal
equations would see no other row."""


def window_mean_loads(windows: WindowedAmplitudes, static: TrimCalibration) -> ComplexArray:
    """Return the mean loads (w, m) of each window through the static matrix, from the channels that are there."""
    rows = [i for i, name in enumerate(static.channel_names) if name in windows.names]
    columns = [windows.names.index(static.channel_names[i]) for i in rows]
    inverse = static.T0
    if len(rows) < len(static.channel_names):
        inverse = np.linalg.pinv(static.C0[rows] * static.calibrated_range) * static.calibrated_range[:, None]
    change = windows.values[:, 0, columns] - static.mean_channels[rows]
    return np.asarray(static.mean_load + change @ inverse.T)


def window_harmonic_loads(
    windows: WindowedAmplitudes,
    record: RotorRecord,
    geometry: Geometry,
    source: ResponseSource,
    constant_response: ComplexArray | None,
) -> ComplexArray:
    """Return the loads (w, n, m) of each window, weighted by noise.

    The response is that at the speed of the window, or the same in all windows.
    """
    count, orders = len(windows.values), np.arange(1, windows.values.shape[1])
    frequency = (windows.speed[:, None] * orders).ravel()
    if constant_response is not None:
        frequency = np.tile(record.spectra.frequency_hz[1:], count)
    combination = source.channel_combination(frequency, record.health.live)
    columns = [COMPONENTS.index(name) for name in record.components]
    if constant_response is None:
        response = source.at(frequency, record.spin)
    else:
        response = np.tile(constant_response, (count, 1, 1))
    T = response[:, combination.rows][:, :, columns]
    filtered = combination.combination / anti_alias_response(geometry.acquisition, frequency)[:, None, None]
    volts = windows.values[:, 1:].reshape(count * len(orders), -1)
    y = np.einsum("krc,kc->kr", filtered, volts)
    live = record.spectra.columns(record.health.live)
    noise = np.einsum("hcc->hc", record.spectra.covariance[1:][:, live][:, :, live]).real
    sigma = np.sqrt(np.einsum("krc,kc->kr", np.abs(filtered) ** 2, np.tile(noise, (count, 1))))
    sigma = np.maximum(sigma, LEAST_NOISE * sigma.max(axis=1, keepdims=True))
    solved = _least_squares(T / sigma[:, :, None], y / sigma)
    return np.asarray(solved.reshape(count, len(orders), -1))


def _least_squares(A: ComplexArray, y: ComplexArray) -> ComplexArray:
    """Return the least-squares solutions (k, m) of A x = y, A (k, r, m) of full rank, by normal equations.

    With columns of length one their condition stays below 1e6 where that of the loads is in the hundreds, and a test of
    changes by percents needs few digits.
    """
    size = np.linalg.norm(A, axis=1)
    scaled = A / size[:, None, :]
    adjoint = np.swapaxes(scaled.conj(), 1, 2)
    return np.asarray(np.linalg.solve(adjoint @ scaled, adjoint @ y[:, :, None])[:, :, 0] / size)
