"""Spectral densities of the hub loads of a record: for loads that no rotor makes periodic, or whose pulses are missing.

At each frequency the cross spectra of the channels, S_y, become those of the loads, G S_y G*, by the inverse G of the
response that weights the channels by their noise. Densities are one-sided: their integral over a band is the mean
square of the load within it. They contain the noise of the channels, whose part is stated beside them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import Run, pick_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.io.errors import UserError
from balance_cli.reduction.flags import MODEL_CONTRADICTED, REDUNDANCY, UNTESTED, join_flags
from balance_cli.reduction.measured_response import highest_frequency
from balance_cli.reduction.response_sources import (
    ResponseSource,
    at_rotor_speed,
    circular_real,
    load_scale,
    stacked_real,
    usable_channels,
)
from balance_cli.reduction.spectra_result import RunSpectra
from balance_cli.reduction.trust import sensor_count
from balance_cli.reduction.untested_loads import row_sensors, untested_harmonics
from balance_cli.reduction.weighted_least_squares import REDUNDANCY_CONFIDENCE, LoadEquations
from balance_cli.signals import distributions
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.channel_noise import BLOCK_SAMPLES, CleanRecord, channel_noise
from balance_cli.signals.cross_spectra import CrossSpectra, cross_spectra
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

WINDOWS = 16
"""Windows end to end in a record; those that overlap make about 40 independent spectra, a random error of 16 %."""
TRANSIENT_TIME_CONSTANTS = 7.0
"""Time constants of the slowest mode that are left out at the start: exp(-7) is a thousandth."""
TRANSIENT_SHARE = 0.25
"""Largest share of the record that is left out at its start."""
TESTED_FREQUENCIES = 32
"""Over a band, at which is examined whether a component rests on one sensor: one does at all of them."""
BELOW_NYQUIST = 0.9
"""Of half the sample rate: the highest frequency of a spectrum."""
BANDWIDTH_BINS = 2.0
"""Noise bandwidth of the Blackman-Harris window in bins (Harris, Proc. IEEE 66, 1978, 51)."""


@dataclass(frozen=True)
class _Inversion:
    """Matrices at k frequencies: rows formed from channels (k, r, c), response (k, r, m), inverse (k, m, r), noise."""

    rows: list[int]
    combination: ComplexArray
    T: ComplexArray
    G: ComplexArray
    noise: ComplexArray


def load_spectra(run: Run, geometry: Geometry, source: ResponseSource, band: tuple[float, float]) -> RunSpectra:
    """Return the spectral densities of the hub loads of a run within a band [Hz].

    Raises UserError where the band holds no frequency of the record or leaves the measured response, no channel is
    usable, or the usable channels do not determine the loads.
    """
    source = at_rotor_speed(source, run.rotor_speed)
    health = usable_channels(run, geometry, source)
    run = source.remove_nonlinear_contribution(run, health.live)
    first = _first_sample(run, source)
    spectra, has_loads = _measured_spectra(run, health, first), run.has_loads and run.kind == "check"
    spectra = _within_band(spectra, run, source, band)
    components = carried_components(geometry)
    clean = CleanRecord(run, health.live, ((first, run.samples),))
    inversion = _invert(run, geometry, source, health, spectra.frequency, channel_noise(clean, geometry.acquisition))
    density = _densities(run, source, health, inversion, spectra, components)
    is_redundant = inversion.T.shape[1] > len(components) and sensor_count(geometry, health.live) > len(components)
    words = ("" if is_redundant else UNTESTED, MODEL_CONTRADICTED if source.is_contradicted else "")
    rejected = density.redundancy > density.limit
    return RunSpectra(
        run=run.name,
        kind=run.kind,
        response=source.description,
        components=components,
        frequency_hz=spectra.frequency,
        density=2.0 * density.power,
        sigma=2.0 * density.sigma,
        noise=2.0 * density.noise,
        redundancy=density.redundancy,
        redundancy_limit=density.limit,
        flags=tuple(join_flags((*words, REDUNDANCY if bad else "")) for bad in rejected),
        resolution_hz=BANDWIDTH_BINS * float(np.min(np.diff(spectra.frequency), initial=np.inf)),
        averages=float(np.median(spectra.averages)),
        interval=(first / sample_rate(run), run.samples / sample_rate(run)),
        left_out=health.left_out,
        load_error=_load_error(spectra, inversion, components, geometry, len(health.live)) if has_loads else None,
        untested=_rest_on_one_sensor(inversion, density, health, geometry, components) if is_redundant else None,
    )


def _rest_on_one_sensor(
    inversion: _Inversion,
    density: _Densities,
    health: ChannelHealth,
    geometry: Geometry,
    components: tuple[str, ...],
) -> tuple[str, ...] | None:
    """Return the components that rest on one sensor at all frequencies; None where none does."""
    at = np.unique(np.linspace(0, len(inversion.T) - 1, TESTED_FREQUENCIES).astype(int))
    T, G, covariance = stacked_real(inversion.T[at]), stacked_real(inversion.G[at]), circular_real(inversion.noise[at])
    equations = LoadEquations(T, np.zeros(T.shape[:2]), covariance, G)
    degrees = np.full(len(at), float(T.shape[1] - T.shape[2]))
    names = row_sensors(health.live, inversion.rows, geometry, inversion.T.shape[1] == len(health.live))
    mask = untested_harmonics(equations, names, degrees, density.limit[at], np.sqrt(density.noise[at]))
    return tuple(name for j, name in enumerate(components) if mask[:, j].all()) or None


@dataclass(frozen=True)
class _Densities:
    """Two-sided densities (k, m) of the loads with sigma and their noise; residual test (k,) and its limit."""

    power: Array
    sigma: Array
    noise: Array
    redundancy: Array
    limit: Array


def _densities(
    run: Run,
    source: ResponseSource,
    health: ChannelHealth,
    inversion: _Inversion,
    spectra: CrossSpectra,
    components: tuple[str, ...],
) -> _Densities:
    """Return the densities of the loads.

    Sigma has three parts: the random error of an average of so many spectra; the error of the response, which is in
    proportion to the load and enters twice; and the noise of the channels. Where the residual test rejects the
    response, the last two are multiplied by its chi-square.
    """
    c = len(health.live)
    y = inversion.combination @ spectra.density[:, :c, :c] @ _adjoint(inversion.combination)
    density = inversion.G @ y @ _adjoint(inversion.G)
    model, known = _response_covariance(run, source, inversion, density, spectra.frequency, components)
    redundancy, limit = _residual_test(inversion, y, model, spectra.averages)
    power, noise = _power(density), _power(inversion.G @ inversion.noise @ _adjoint(inversion.G))
    error = _power(inversion.G @ (model + known) @ _adjoint(inversion.G))
    excess = np.where(redundancy > limit, redundancy, 1.0)[:, None]
    variance = power**2 / spectra.averages[:, None] + 2.0 * power * error * excess + (excess * noise) ** 2
    return _Densities(power, np.sqrt(variance), noise, redundancy, limit)


def _first_sample(run: Run, source: ResponseSource) -> int:
    """Return the first sample after the start transient, of which a record at rest gives no other evidence."""
    transient = TRANSIENT_TIME_CONSTANTS * source.slowest_decay * sample_rate(run)
    return int(min(transient, TRANSIENT_SHARE * run.samples))


def _measured_spectra(run: Run, health: ChannelHealth, first: int) -> CrossSpectra:
    """Return the cross spectra of the live channels, and behind them of the loads where the run has them."""
    length = int(2 ** np.floor(np.log2(max((run.samples - first) / WINDOWS, 2.0))))
    try:
        return cross_spectra(_signals(run, health, first), 1.0 / sample_rate(run), length)
    except ValueError as error:
        raise UserError("is too short for a spectrum", run.file, "channels", "Record for longer") from error


def _signals(run: Run, health: ChannelHealth, first: int) -> Iterator[tuple[int, Array]]:
    """Yield the samples (n, c or c + 6) in blocks; windows do not reach from block to block."""
    for start in range(first, run.samples, BLOCK_SAMPLES):
        block = run.read(start, start + BLOCK_SAMPLES)
        channels = pick_channels(block.channels, run.channel_names, health.live)
        yield start, channels if block.loads is None else np.hstack([channels, block.loads])


def _within_band(spectra: CrossSpectra, run: Run, source: ResponseSource, band: tuple[float, float]) -> CrossSpectra:
    """Return the spectra within the band. UserError where they hold too few frequencies, or the response ends."""
    highest = min(BELOW_NYQUIST * sample_rate(run) / 2.0, highest_frequency(source))
    if band[1] > highest:
        fault = f"{band[1]:g} Hz is beyond what the record and the response hold, {highest:.5g} Hz"
        raise UserError(fault, run.file, "--band", "Give a lower end")
    inside = (spectra.frequency >= band[0]) & (spectra.frequency <= band[1])
    if np.count_nonzero(inside) < 2:
        step = float(np.min(np.diff(spectra.frequency)))
        fault = f"holds fewer than two of its frequencies, which are {step:.3g} Hz apart"
        raise UserError(fault, run.file, f"--band {band[0]:g} {band[1]:g}", "Give a wider band, or record for longer")
    return spectra.at(inside)


def _invert(
    run: Run, geometry: Geometry, source: ResponseSource, health: ChannelHealth, frequency: Array, variance: Array
) -> _Inversion:
    """Return the inverse of the response, weighted by the noise of the channels of variance (c,) [V2] in a sample."""
    components = carried_components(geometry)
    chosen = source.channel_combination(frequency, health.live)
    combination = chosen.combination / anti_alias_response(geometry.acquisition, frequency)[:, None, None]
    columns = [COMPONENTS.index(name) for name in components]
    T = source.at(frequency, run.rotor_speed)[:, chosen.rows][:, :, columns]
    if not has_independent_columns(T, load_scale(geometry.hub)[columns]):
        left_out = "; ".join(f"{name}: {reason}" for name, reason in health.left_out.items()) or "none"
        fault = f"the channels do not determine {', '.join(components)} (left out: {left_out})"
        raise UserError(fault, run.file, "channels", "Repair the channels, or leave the run out with --skip-bad")
    noise = (combination * (variance / sample_rate(run)).astype(complex)) @ _adjoint(combination)
    weighted = np.asarray(np.linalg.solve(noise, T), complex)
    G = np.asarray(np.linalg.solve(_adjoint(T) @ weighted, _adjoint(weighted)), complex)
    return _Inversion(chosen.rows, combination, T, G, np.asarray(noise, complex))


def _response_covariance(
    run: Run,
    source: ResponseSource,
    inversion: _Inversion,
    density: ComplexArray,
    frequency: Array,
    components: tuple[str, ...],
) -> tuple[ComplexArray, ComplexArray]:
    """Return the covariance (k, r, r) of T f from the error of T, and that of what T is known to miss.

    The loads f are random with the cross spectra `density` (k, m, m): both are sums over its eigenvectors.
    """
    size, vectors = np.linalg.eigh(density)
    r = len(inversion.rows)
    total, known = np.zeros((2, len(frequency), r, r), complex)
    columns = [COMPONENTS.index(name) for name in components]
    for j in range(size.shape[1]):
        loads = np.zeros((len(frequency), len(COMPONENTS)), complex)
        loads[:, columns] = vectors[:, :, j] * np.sqrt(np.maximum(size[:, j], 0.0))[:, None]
        total += _complex_covariance(source.covariance(frequency, run.rotor_speed, loads), inversion.rows)
        known += _known_covariance(source, inversion, frequency, loads)
    return total, known


def _complex_covariance(real: Array, rows: list[int]) -> ComplexArray:
    """Return E[e e*] (k, r, r) of chosen rows from the covariance (k, 2a, 2a) of [Re e, Im e]."""
    a = real.shape[1] // 2
    cc, ss, sc = real[:, :a, :a], real[:, a:, a:], real[:, a:, :a]
    covariance = cc + ss + 1j * (sc - sc.swapaxes(1, 2))
    return np.asarray(covariance[:, np.array(rows)[:, None], rows])


def _known_covariance(
    source: ResponseSource, inversion: _Inversion, frequency: Array, loads: ComplexArray
) -> ComplexArray:
    """Return the covariance (k, r, r) of what the response is known to miss of the rows."""
    error, r = source.response_error, len(inversion.rows)
    if error is None:
        return np.zeros((len(frequency), r, r), complex)
    return error.covariance(frequency, loads)[:, np.array(inversion.rows)[:, None], inversion.rows]


def _residual_test(
    inversion: _Inversion, y: ComplexArray, model_covariance: ComplexArray, averages: Array
) -> tuple[Array, Array]:
    """Return chi-square per degree of freedom (k,) of the redundant rows and its 99.9 % point; NaN without any."""
    T, k = inversion.T, len(y)
    degrees = T.shape[1] - T.shape[2]
    if degrees <= 0:
        return np.full(k, np.nan), np.full(k, np.inf)
    W = np.linalg.inv(inversion.noise + model_covariance)
    Q = W - W @ T @ np.linalg.solve(_adjoint(T) @ W @ T, _adjoint(T) @ W)
    chi2 = np.trace(Q @ y, axis1=1, axis2=2).real / degrees
    dof = 2.0 * averages * degrees
    return np.asarray(chi2), np.asarray(distributions.chi2.ppf(REDUNDANCY_CONFIDENCE, dof) / dof)


def _load_error(
    spectra: CrossSpectra, inversion: _Inversion, components: tuple[str, ...], geometry: Geometry, channels: int
) -> dict[str, float]:
    """Return rms(reduced - applied) / rms(applied) over the band for each component that was applied."""
    columns = [channels + COMPONENTS.index(name) for name in components]
    H = anti_alias_response(geometry.acquisition, spectra.frequency)
    applied = np.zeros((len(H), len(components), spectra.density.shape[1]), complex)
    applied[:, np.arange(len(columns)), columns] = 1.0 / H[:, None]
    difference = -applied
    difference[:, :, :channels] += inversion.G @ inversion.combination
    error, size = (_power(matrix @ spectra.density @ _adjoint(matrix)).sum(axis=0) for matrix in (difference, applied))
    return {name: float(np.sqrt(error[i] / size[i])) for i, name in enumerate(components) if size[i] > 0.0}


def _power(density: ComplexArray) -> Array:
    """Return the diagonals (k, m) of Hermitian matrices (k, m, m)."""
    return np.asarray(np.einsum("kmm->km", density).real)


def _adjoint(matrix: ComplexArray) -> ComplexArray:
    """Return the conjugate transpose of matrices (k, a, b)."""
    return np.asarray(matrix.conj().swapaxes(1, 2))
