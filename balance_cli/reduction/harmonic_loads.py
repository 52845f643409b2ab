"""Harmonic loads: harmonics 1 to n of the hub loads, from the response alone, without a static calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import TrimCalibration
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import has_independent_columns, negligible_columns
from balance_cli.io.errors import UserError
from balance_cli.reduction.measured_response import highest_frequency, lowest_frequency
from balance_cli.reduction.response_sources import ResponseSource, circular_real, load_scale, stacked_real
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.speed_modulation import SPEED_MEMORY
from balance_cli.reduction.weighted_least_squares import SolvedLoads, solve_loads, weighted_inverse
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.rotor.harmonic_spectrum import harmonic_lines
from balance_cli.signals.rotor.steadiness import WindowedAmplitudes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_NOISE = 1e-6
"""Of the noise of the noisiest row: with less, as of a coarse converter that repeats itself in each revolution, normal
equations would see no other row."""


@dataclass(frozen=True)
class LoadProblem:
    """The equations of harmonics 1 to n of a record: readings y (h, r) = T (h, r, m) f + noise (h, r, r).

    `dof` (h,) are the degrees of freedom of the noise; weighting (h, r, r) the covariance of channels that are noisy by
    themselves, of one sample; scale (m,) makes loads comparable; `known_error` returns the covariance (h, 2r, 2r) of
    T f for loads (h, 2m), `response_covariance` that (s h, 2r, 2r) for s sets of loads (s h, 2m) one below the other.
    """

    T: ComplexArray
    readings: ComplexArray
    noise: ComplexArray
    dof: Array
    weighting: ComplexArray
    scale: Array
    response_covariance: Callable[[Array], Array]
    known_error: Callable[[Array], Array] | None

    def with_readings(self, matrix: Array) -> LoadProblem:
        """Return the problem of readings that are multiplied by a matrix (r, r), with their noise."""
        noise, weighting = (matrix @ covariance @ matrix.T for covariance in (self.noise, self.weighting))
        return replace(self, readings=self.readings @ matrix.T, noise=noise, weighting=weighting)

    def loads(self) -> Array:
        """Return the loads (h, 2m) alone, as real and imaginary parts: a third of the time of `solve`."""
        estimator, _ = weighted_inverse(stacked_real(self.T), circular_real(self.weighting))
        readings = np.concatenate([self.readings.real, self.readings.imag], axis=1)
        return np.asarray(np.einsum("hba,ha->hb", estimator, readings))

    def solve(self) -> SolvedLoads:
        """Estimate the loads, weighted by noise."""
        return solve_loads(
            stacked_real(self.T),
            np.concatenate([self.readings.real, self.readings.imag], axis=1),
            circular_real(self.noise),
            self.dof,
            self.response_covariance,
            np.tile(self.scale, 2),
            circular_real(self.weighting),
            self.known_error,
        )


def harmonic_loads(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray | None = None
) -> SolvedLoads:
    """Estimate harmonics 1 to n: remove the anti-alias filter, then invert the response, weighted by noise.

    `response` is the `harmonic_response`, where it is known already.
    Raises UserError where the usable channels do not determine the loads.
    """
    return load_problem(record, geometry, source, response).solve()


def load_problem(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray | None = None
) -> LoadProblem:
    """Return the equations that `harmonic_loads` solves. Raises UserError where they do not determine the loads."""
    spectra, health = record.spectra, record.health
    frequency = spectra.frequency_hz[1:]
    channel_combination = source.channel_combination(frequency, health.live)
    columns = [COMPONENTS.index(name) for name in record.components]
    response = harmonic_response(record, geometry, source) if response is None else response
    T = response[:, channel_combination.rows][:, :, columns]
    scale = load_scale(geometry.hub)[columns]
    _check_determined(T, record, scale)
    live = spectra.columns(health.live)
    combination = channel_combination.combination / anti_alias_response(geometry.acquisition, frequency)[:, None, None]
    real_rows = np.array([*channel_combination.rows, *(row + response.shape[1] for row in channel_combination.rows)])

    def propagate(covariance: ComplexArray) -> ComplexArray:
        return np.asarray(combination @ covariance @ combination.conj().swapaxes(1, 2))

    def as_components(loads: Array) -> ComplexArray:
        all_loads = np.zeros((len(loads), 6), complex)
        all_loads[:, columns] = loads[:, : len(columns)] + 1j * loads[:, len(columns) :]
        return all_loads

    def response_covariance(loads: Array) -> Array:
        several = np.tile(frequency, len(loads) // len(frequency))
        return source.covariance(several, record.spin, as_components(loads))[:, real_rows[:, None], real_rows]

    def known_error(loads: Array) -> Array:
        return circular_real(_known_error(record, source, channel_combination.rows, as_components(loads)))

    return LoadProblem(
        T,
        np.einsum("hrc,hc->hr", combination, spectra.amplitude[1:, live]),
        propagate(spectra.covariance[1:][:, live][:, :, live]),
        spectra.dof[1:],
        propagate(np.diag(channel_noise(record, geometry)).astype(complex)),
        scale,
        response_covariance,
        known_error if source.response_error is not None else None,
    )


def _known_error(record: RotorRecord, source: ResponseSource, rows: list[int], loads: ComplexArray) -> ComplexArray:
    """Return the covariance (h, r, r) of what the response is known to miss of the rows, for loads (h, 6)."""
    error = source.response_error
    assert error is not None
    return error.covariance(record.spectra.frequency_hz[1:], loads)[:, np.array(rows)[:, None], rows]


def channel_noise(record: RotorRecord, geometry: Geometry) -> Array:
    """Return the noise variance (c,) [V2] of one sample of each live channel, in the interval of the harmonics."""
    spectrum = record.spectrum_over_time
    noise = spectrum.noise_variance(geometry.acquisition)
    return noise[[spectrum.names.index(name) for name in record.health.live]]


def harmonic_response(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> ComplexArray:
    """Return the response T (n, rows, 6) of each harmonic, averaged over the harmonic's own spectrum.

    The spectrum has a width because the rotor speed varies. The change of the anti-alias filter across it is included.
    """
    azimuth, spectra = record.azimuth, record.spectra
    orders = range(1, len(spectra.frequency_hz))
    band = lowest_frequency(source), highest_frequency(source)
    alone = harmonic_lines(azimuth, spectra, orders, SPEED_MEMORY * source.slowest_decay)
    lines = [item.moved_into(*band) for item in alone]
    frequency = np.concatenate([item.frequency for item in lines])
    ends = np.cumsum([len(item.frequency) for item in lines])[:-1]
    parts = np.split(source.at(frequency, record.spin), ends)
    centers = anti_alias_response(geometry.acquisition, spectra.frequency_hz[1:])
    filters = np.split(anti_alias_response(geometry.acquisition, frequency), ends)
    return np.stack(
        [
            np.tensordot(item.weight * H / center, value, 1)
            for item, value, H, center in zip(lines, parts, filters, centers, strict=True)
        ]
    )


def _check_determined(T: ComplexArray, record: RotorRecord, scale: Array) -> None:
    """Raise UserError unless T (n, rows, m) determines the loads, which `scale` (m,) makes comparable."""
    if has_independent_columns(T, scale):
        return
    without_response = [record.components[i] for i in np.flatnonzero(negligible_columns(T, scale))]
    left_out = "; ".join(f"{name}: {reason}" for name, reason in record.health.left_out.items()) or "none"
    unidentifiable = ", ".join(without_response) or ", ".join(record.components)
    raise UserError(
        f"the remaining channels do not determine {unidentifiable} (left out: {left_out})",
        record.run.file,
        "channels",
        "Repair the channels, or leave the run out with --skip-bad",
    )


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
