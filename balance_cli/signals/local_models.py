"""Frequency responses from any record, without leakage: local polynomial and local rational models of its spectrum.

The record is transformed whole and without window. A window of neighbouring lines slides over the band; in it a local
model of response and transient is fitted (`local_fit`), and used for the lines in its middle. The orders are chosen
window by window by Hannan and Quinn's criterion (J. R. Stat. Soc. B 41, 1979), among ORDERS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from numpy.typing import NDArray

from balance_cli.runs import Run
from balance_cli.signals.lines import Response
from balance_cli.signals.local_fit import LocalFit, Orders, Windows, fit_windows, response_rows, transient_rows
from balance_cli.signals.local_noise import NoiseComponents, noise_components
from balance_cli.signals.noise import window_sums
from balance_cli.signals.records import fault, load_places, measured_components, sample_rate, samples_of

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

ORDERS = tuple(Orders(degree, degree - 1, poles) for degree in (2, 3) for poles in (0, 1, 2, 3))
POLYNOMIAL = Orders(2, 2, 0)
RATIONAL_LINES = 81
POLYNOMIAL_FREEDOM = 8
LEAST_POWER = 1e-4


@dataclass(frozen=True)
class Spectrum:
    """Whole record at K neighbouring lines: channels (K, c), loads (K, u), frequency (K,) [Hz]; amplitudes scaled by

    `channel_scale` (c,) and `load_scale` (u,) to like size; `excited` (K,), where some load has power.
    """

    run: Run
    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    frequency: Array
    channels: ComplexArray
    loads: ComplexArray
    channel_scale: Array
    load_scale: Array
    excited: NDArray[np.bool_]


@dataclass(frozen=True)
class LocalModels:
    """Local models of a spectrum: window w covers lines `first[w]` onwards and speaks for lines `owned[w]` (from, to).

    `fit[w]` is (fit, window in that fit); `response` (K, c, u), `noise` and `level` (K,), the relative noise power that
    weighed the lines, in the spectrum's scaled units.
    """

    spectrum: Spectrum
    windows: Windows
    first: Index
    owned: Index
    fit: tuple[tuple[LocalFit, int], ...]
    response: ComplexArray
    noise: NoiseComponents
    level: Array


def local_response(
    run: Run, channel_names: Sequence[str], estimator: str = "lrm", band: tuple[float, float] = (0.0, np.inf)
) -> Response:
    """Frequency response of one run at its own lines within `band` [Hz], by `lrm` or `lpm`.

    Several components excited at once are told apart where their spectra differ. UserError: no loads, record too short.
    """
    models = local_models(record_spectrum(run, channel_names, band), estimator)
    return _response(models, estimator)


def record_spectrum(run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)) -> Spectrum:
    """Amplitudes of the whole record at the lines of the excited part of `band` [Hz], zero frequency left out."""
    channels, loads = samples_of(run, channel_names)
    components = measured_components(run, loads)
    z = np.hstack([channels, loads[:, load_places(components)]])
    Z = np.fft.rfft(z, axis=0)[1 : (run.samples + 1) // 2] * (2.0 / run.samples)
    frequency = np.arange(1, len(Z) + 1) * sample_rate(run) / run.samples
    c = len(channel_names)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    excited = _has_power(Z[:, c:]) & inside
    if np.count_nonzero(excited) < RATIONAL_LINES:
        raise fault(run, "the record is too short (or its loads too narrow in frequency)", "Record more")
    reach = RATIONAL_LINES // 2
    kept = slice(max(int(np.argmax(excited)) - reach, 0), len(Z) - int(np.argmax(excited[::-1])) + reach)
    channel_scale = _rms(Z[kept, :c])
    load_scale = _rms(Z[kept, c:])
    return Spectrum(
        run=run,
        channel_names=tuple(channel_names),
        components=components,
        frequency=frequency[kept],
        channels=Z[kept, :c] / channel_scale,
        loads=Z[kept, c:] / load_scale,
        channel_scale=channel_scale,
        load_scale=load_scale,
        excited=excited[kept],
    )


def local_models(spectrum: Spectrum, estimator: str = "lrm") -> LocalModels:
    """Fit the sliding windows twice: for the noise of channels and loads, then weighted with it."""
    u = spectrum.loads.shape[1]
    candidates, M, hop = _layout(estimator, u)
    first, owned = _windows(len(spectrum.frequency), M, hop)
    index = first[:, None] + np.arange(M)
    r = np.broadcast_to(np.linspace(-1.0, 1.0, M), index.shape)
    spectrum = _like_noise(spectrum, index, r, candidates[-1])
    windows = Windows(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
    chosen = _best(windows, candidates)
    draft = _assembled(spectrum, windows, first, owned, chosen, np.ones(len(spectrum.frequency)))
    level = draft.noise.excess(draft.response)
    windows = replace(windows, weight=1.0 / np.sqrt(level[index]))
    return _assembled(spectrum, windows, first, owned, _again(windows, chosen), level, draft.noise)


def _layout(estimator: str, inputs: int) -> tuple[tuple[Orders, ...], int, int]:
    """Candidate orders, lines in a window, lines for which a window speaks."""
    if estimator == "lpm":
        return (POLYNOMIAL,), POLYNOMIAL.coefficients(inputs) + POLYNOMIAL_FREEDOM | 1, 1
    M = max(RATIONAL_LINES, 3 * max(o.coefficients(inputs) for o in ORDERS)) | 1
    return ORDERS, M, M // 3


def _windows(K: int, M: int, hop: int) -> tuple[Index, Index]:
    """First line (W,) of each window, shifted inwards at the edges, and the lines (W, 2) for which it speaks."""
    start = np.arange(0, K, hop)
    owned = np.stack([start, np.minimum(start + hop, K)], axis=1)
    return np.clip(start + hop // 2 - M // 2, 0, K - M), owned


def _has_power(loads: ComplexArray) -> NDArray[np.bool_]:
    """Lines (K,) around which some load has a share of LEAST_POWER of the power that it has where it is strong."""
    width = min(RATIONAL_LINES // 2, len(loads))
    power = window_sums(np.abs(loads) ** 2, width)
    strong = np.quantile(power, 0.95, axis=0)
    return np.asarray(np.any(power > LEAST_POWER * np.maximum(strong, 1e-300), axis=1))


def _rms(values: ComplexArray) -> Array:
    rms = np.sqrt(np.mean(np.abs(values) ** 2, axis=0))
    return np.asarray(np.where(rms > 0, rms, 1.0))


def _like_noise(spectrum: Spectrum, index: Index, r: Array, orders: Orders) -> Spectrum:
    """The spectrum with channels scaled to like noise: the median over windows of a rich model's residual."""
    windows = Windows(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
    fit = fit_windows(windows, orders)
    freedom = index.shape[1] - orders.coefficients(fit.inputs)
    sigma = np.sqrt(np.median(np.sum(np.abs(fit.residual) ** 2, axis=1), axis=0) / freedom)
    scale = np.where(sigma > 0, sigma, 1.0)
    return replace(spectrum, channels=spectrum.channels / scale, channel_scale=spectrum.channel_scale * scale)


def _best(windows: Windows, candidates: Sequence[Orders]) -> tuple[tuple[LocalFit, int], ...]:
    """The fit of each window with the best orders."""
    fits = [fit_windows(windows, orders) for orders in candidates]
    best = np.argmin([_criterion(windows, fit) for fit in fits], axis=0)
    return tuple((fits[choice], w) for w, choice in enumerate(best))


def _criterion(windows: Windows, fit: LocalFit) -> Array:
    """Hannan-Quinn criterion (W,) for N complex data and p complex parameters: N ln V + 2 p ln ln 2N."""
    _, M, c = windows.Y.shape
    N = M * c
    p = c * fit.orders.coefficients(fit.inputs) + fit.orders.denominator
    return np.asarray(N * np.log(np.maximum(fit.cost, 1e-300)) + 2.0 * p * log(log(2.0 * N)))


def _again(windows: Windows, chosen: Sequence[tuple[LocalFit, int]]) -> tuple[tuple[LocalFit, int], ...]:
    """Fit once more with the orders chosen before and the windows' present weights."""
    again: list[tuple[LocalFit, int]] = list(chosen)
    for orders in {fit.orders for fit, _ in chosen}:
        members = np.array([w for w, (fit, _) in enumerate(chosen) if fit.orders == orders])
        refit = fit_windows(windows.subset(members), orders)
        for place, w in enumerate(members):
            again[w] = (refit, place)
    return tuple(again)


def _assembled(
    spectrum: Spectrum,
    windows: Windows,
    first: Index,
    owned: Index,
    fit: tuple[tuple[LocalFit, int], ...],
    level: Array,
    draft: NoiseComponents | None = None,
) -> LocalModels:
    """Response at every line from the window that speaks for it, and the noise from what it leaves."""
    response = np.zeros((*spectrum.channels.shape, spectrum.loads.shape[1]), complex)
    residual = np.zeros_like(spectrum.channels)
    counts = np.ones(len(level))
    for w, (one, place) in enumerate(fit):
        lines = np.arange(*owned[w])
        inside = lines - first[w]
        rows = response_rows(one, place, windows.r[w, inside])
        response[lines] = (rows @ one.coefficients[place]).swapaxes(1, 2)
        weight = windows.weight[w, inside]
        residual[lines] = one.residual[place, inside] / weight[:, None]
        taken = np.einsum("kq,qk->k", _design(windows, one, place, w, inside), _influence(windows, one, place, w)[:, inside])
        counts[lines] = np.clip(1.0 - taken.real, 0.05, 1.0)
    used = spectrum.excited
    start = None if draft is None else replace(draft, channels=draft.channels[used])
    noise = _everywhere(noise_components(residual[used], response[used], counts[used], start), used)
    return LocalModels(spectrum, windows, first, owned, fit, response, noise, level)


def influence(models: LocalModels, window: int) -> ComplexArray:
    """Matrix (q, M) that takes the window's outputs to its linear coefficients."""
    return _influence(models.windows, *models.fit[window], window)


def design(models: LocalModels, window: int, inside: Index) -> ComplexArray:
    """Regressors (lines, q) of one window at lines given by place in the window."""
    return _design(models.windows, *models.fit[window], window, inside)


def _influence(windows: Windows, fit: LocalFit, place: int, window: int) -> ComplexArray:
    weight = windows.weight[window]
    X = _design(windows, fit, place, window, np.arange(len(weight)))
    half = np.linalg.solve(fit.triangle[place].conj().T, (X * weight[:, None] ** 2).conj().T)
    return np.asarray(np.linalg.solve(fit.triangle[place], half))


def _design(windows: Windows, fit: LocalFit, place: int, window: int, inside: Index) -> ComplexArray:
    r = windows.r[window, inside]
    driven = np.sum(windows.U[window, inside][:, :, None] * response_rows(fit, place, r), axis=1)
    return np.asarray(driven + transient_rows(fit, place, r))


def _everywhere(noise: NoiseComponents, used: NDArray[np.bool_]) -> NoiseComponents:
    """Noise at all lines: at those that were not used, that of the nearest that was."""
    place = np.flatnonzero(used)
    nearest = np.clip(np.searchsorted(place, np.arange(len(used))), 0, len(place) - 1)
    return replace(noise, channels=noise.channels[nearest])


def _response(models: LocalModels, estimator: str) -> Response:
    """Response with separable covariance and coherences, at the excited lines, in volts per newton."""
    s = models.spectrum
    kept = np.flatnonzero(s.excited)
    channel_covariance, load_covariance = _covariances(models)
    response = models.response[kept]
    noise = NoiseComponents(models.noise.channels[kept], models.noise.loads, models.noise.dof).equation(response)
    ordinary, multiple = coherences(response, noise, _local_power(s.loads)[kept])
    volts, load = s.channel_scale, s.load_scale
    return Response(
        run=s.run.name,
        channel_names=s.channel_names,
        components=s.components,
        estimator=estimator,
        frequency=s.frequency[kept],
        response=response * volts[:, None] / load,
        channel_covariance=channel_covariance[kept] * (volts[:, None] * volts),
        load_covariance=load_covariance[kept] / (load[:, None] * load),
        coherence=ordinary,
        multiple_coherence=multiple,
        rotor_speed=s.run.rotor_speed,
        level=s.run.level,
    )


def _covariances(models: LocalModels) -> tuple[ComplexArray, ComplexArray]:
    """Channels' (K, c, c) and loads' (K, u, u) factor of the response's covariance.

    The response at a line is a weighted sum over its window's outputs; so is its covariance, over their noise. The
    weights of several inputs differ from line to line: the channels' factor takes their mean, as if they did not.
    """
    noise = models.noise.equation(models.response)
    K, c, u = models.response.shape
    channels, loads = np.zeros((K, c, c), complex), np.zeros((K, u, u), complex)
    for w, (fit, place) in enumerate(models.fit):
        lines = np.arange(*models.owned[w])
        inside = lines - models.first[w]
        weights = response_rows(fit, place, models.windows.r[w, inside]) @ influence(models, w)
        loads[lines] = weights @ weights.conj().swapaxes(1, 2)
        share = np.einsum("kum,kum->km", weights.conj(), np.linalg.solve(loads[lines], weights)).real / u
        window = slice(models.first[w], models.first[w] + weights.shape[2])
        channels[lines] = np.tensordot(share, noise[window], axes=1)
    return channels, loads


def _local_power(loads: ComplexArray) -> ComplexArray:
    """Spectral matrix (K, u, u) of the loads, averaged over a window's lines."""
    outer = loads[:, :, None] * loads[:, None, :].conj()
    width = min(RATIONAL_LINES, len(loads))
    return np.asarray(window_sums(outer, width) / width)


def coherences(response: ComplexArray, noise: ComplexArray, power: ComplexArray) -> tuple[Array, Array]:
    """Ordinary (K, c, u) and multiple (K, c) coherence for a response G, loads' power S and noise of `Y - G U`.

    Multiple: G S G* over G S G* plus noise. Ordinary: |S_yu|^2 / (S_yy S_uu), S_yu = G S (Bendat and Piersol).
    """
    cross = response @ power
    signal = np.einsum("kcu,kcu->kc", cross, response.conj()).real
    total = signal + np.diagonal(noise, axis1=1, axis2=2).real
    own = np.diagonal(power, axis1=1, axis2=2).real
    ordinary = np.abs(cross) ** 2 / np.maximum(total[:, :, None] * own[:, None, :], 1e-300)
    return np.clip(ordinary, 0.0, 1.0), np.clip(signal / np.maximum(total, 1e-300), 0.0, 1.0)
