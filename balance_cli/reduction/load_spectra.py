"""Spectral densities of the hub loads of a record: for loads that no rotor makes periodic, or whose pulses are missing.

At each frequency the cross spectra of the channels, S_y, become those of the loads, G S_y G*, by the inverse G of the
response that weights the channels by their noise. Densities are one-sided: their integral over a band is the mean
square of the load within it. They contain the noise of the channels, whose part is stated beside them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.io.errors import UserError
from balance_cli.reduction.band_steadiness import band_steadiness, statistical_width
from balance_cli.reduction.resolved_spectra import ResolvedSpectra, require_band, resolved_spectra
from balance_cli.reduction.response_sources import (
    ResponseSource,
    at_rotor_speed,
    beyond_sweeps,
    circular_real,
    load_scale,
    stacked_real,
    usable_channels,
)
from balance_cli.reduction.spectra_result import RunSpectra, frequency_flags, shared_flags
from balance_cli.reduction.trust import sensor_count
from balance_cli.reduction.untested_loads import row_sensors, untested_harmonics
from balance_cli.reduction.weighted_least_squares import REDUNDANCY_CONFIDENCE, LoadEquations
from balance_cli.signals import distributions
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.channel_noise import CleanRecord, channel_noise
from balance_cli.signals.cross_spectra import CrossSpectra
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Bools = NDArray[np.bool_]

TRANSIENT_TIME_CONSTANTS = 7.0
"""Time constants of the slowest mode that are left out at the start: exp(-7) is a thousandth."""
TRANSIENT_SHARE = 0.25
"""Largest share of the record that is left out at its start."""
TESTED_FREQUENCIES = 32
"""Over a band, at which is examined whether a component rests on one sensor: one does at all of them."""


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
    require_band(run, source, band)
    resolved = resolved_spectra(run, source, health, first, band)
    components = carried_components(geometry)
    noise = channel_noise(CleanRecord(run, health.live, ((first, run.samples),)), geometry.acquisition)
    inversion = _invert(run, geometry, source, health, resolved.spectra.frequency, noise)
    density = _densities(run, source, health, inversion, resolved, components)
    is_redundant = inversion.T.shape[1] > len(components) and sensor_count(geometry, health.live) > len(components)
    frequency = resolved.average(resolved.spectra.frequency)
    width = statistical_width(density.power, frequency)
    inverse = partial(_load_matrix, run, geometry, source, health, noise)
    level = band_steadiness(run, health.live, components, first, band, width, resolved.decay, inverse)
    words = shared_flags(is_redundant, source.is_contradicted, resolved.is_resolved)
    sensors = inversion, density, resolved.bins, health, geometry, components
    return RunSpectra(
        run=run.name,
        kind=run.kind,
        response=source.description,
        components=components,
        frequency_hz=frequency,
        density=2.0 * density.power,
        sigma=2.0 * density.sigma,
        random_sigma=2.0 * density.random,
        noise=2.0 * density.noise,
        redundancy=density.redundancy,
        redundancy_limit=density.limit,
        flags=frequency_flags(words, density.redundancy > density.limit, beyond_sweeps(source, frequency)),
        resolution_hz=resolved.bandwidth,
        averages=float(np.median(resolved.averages)),
        interval=(first / sample_rate(run), run.samples / sample_rate(run)),
        left_out=health.left_out,
        load_error=_load_error(run, resolved.spectra, inversion, components, geometry, len(health.live)),
        untested=_rest_on_one_sensor(*sensors) if is_redundant else None,
        not_steady=level.unsteady or None,
        steadiness_note=level.note or None,
    )


def _rest_on_one_sensor(
    inversion: _Inversion,
    density: _Densities,
    bins: int,
    health: ChannelHealth,
    geometry: Geometry,
    components: tuple[str, ...],
) -> tuple[str, ...] | None:
    """Return the components that rest on one sensor at all frequencies, averages of `bins`; None where none does."""
    at = np.unique(np.linspace(0, len(density.limit) - 1, TESTED_FREQUENCIES).astype(int))
    middle = at * bins + bins // 2
    T, G = stacked_real(inversion.T[middle]), stacked_real(inversion.G[middle])
    covariance = circular_real(inversion.noise[middle])
    equations = LoadEquations(T, np.zeros(T.shape[:2]), covariance, G)
    degrees = np.full(len(at), float(T.shape[1] - T.shape[2]))
    names = row_sensors(health.live, inversion.rows, geometry, inversion.T.shape[1] == len(health.live))
    mask = untested_harmonics(equations, names, degrees, density.limit[at], np.sqrt(density.noise[at]))
    return tuple(name for j, name in enumerate(components) if mask[:, j].all()) or None


@dataclass(frozen=True)
class _Densities:
    """Two-sided densities (k, m) of the loads with sigma, its random part, and noise; residual test (k,), its limit."""

    power: Array
    sigma: Array
    random: Array
    noise: Array
    redundancy: Array
    limit: Array


def _densities(
    run: Run,
    source: ResponseSource,
    health: ChannelHealth,
    inversion: _Inversion,
    resolved: ResolvedSpectra,
    components: tuple[str, ...],
) -> _Densities:
    """Return the densities of the loads, averaged over neighboring frequencies.

    Sigma has four parts: the random error of an average of so many spectra; what the response changes by within the
    bandwidth, which is added to the load, and varies as that does; the error of the response, which is in proportion to
    the load and enters twice; and the noise of the channels. Where the residual test rejects the response, the last two
    are multiplied by its chi-square.
    """
    c, spectra = len(health.live), resolved.spectra
    y = inversion.combination @ spectra.density[:, :c, :c] @ _adjoint(inversion.combination)
    density = inversion.G @ y @ _adjoint(inversion.G)
    model, known = _response_covariance(run, source, inversion, density, spectra.frequency, components)
    spread = resolved.spread(inversion.T, density)
    redundancy, limit = _residual_test(inversion, y, model + spread, resolved)
    error, added, noise = (
        _power(inversion.G @ part @ _adjoint(inversion.G)) for part in (model + known, spread, inversion.noise)
    )
    each = _power(density)
    parts = (each, noise, added, 2.0 * each * error, 2.0 * each * added)
    power, noise, added, of_response, of_spread = (resolved.average(part) for part in parts)
    excess = np.where(redundancy > limit, redundancy, 1.0)[:, None]
    random = (power**2 + of_spread) / resolved.averages[:, None]
    variance = random + added**2 + of_response * excess + (excess * noise) ** 2
    return _Densities(power, np.sqrt(variance), np.sqrt(random), noise, redundancy, limit)


def _first_sample(run: Run, source: ResponseSource) -> int:
    """Return the first sample after the start transient, of which a record at rest gives no other evidence."""
    transient = TRANSIENT_TIME_CONSTANTS * source.slowest_decay * sample_rate(run)
    return int(min(transient, TRANSIENT_SHARE * run.samples))


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


def _load_matrix(
    run: Run, geometry: Geometry, source: ResponseSource, health: ChannelHealth, noise: Array, frequency: Array
) -> ComplexArray:
    """Return the matrices (k, m, c) from channels to loads at frequencies (k,)."""
    inversion = _invert(run, geometry, source, health, frequency, noise)
    return np.asarray(inversion.G @ inversion.combination)


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
    inversion: _Inversion, y: ComplexArray, model_covariance: ComplexArray, resolved: ResolvedSpectra
) -> tuple[Array, Array]:
    """Return the averages of chi-square per degree of freedom of the redundant rows, and its 99.9 % points."""
    T, k = inversion.T, len(resolved.averages)
    degrees = T.shape[1] - T.shape[2]
    if degrees <= 0:
        return np.full(k, np.nan), np.full(k, np.inf)
    W = np.linalg.inv(inversion.noise + model_covariance)
    Q = W - W @ T @ np.linalg.solve(_adjoint(T) @ W @ T, _adjoint(T) @ W)
    chi2 = resolved.average(np.trace(Q @ y, axis1=1, axis2=2).real / degrees)
    dof = 2.0 * resolved.averages * degrees
    return np.asarray(chi2), np.asarray(distributions.chi2.ppf(REDUNDANCY_CONFIDENCE, dof) / dof)


def _load_error(
    run: Run,
    spectra: CrossSpectra,
    inversion: _Inversion,
    components: tuple[str, ...],
    geometry: Geometry,
    channels: int,
) -> dict[str, float] | None:
    """Return rms(reduced - applied) / rms(applied) over the band for each component that was applied to a check run."""
    if not run.has_loads or run.kind != "check":
        return None
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
