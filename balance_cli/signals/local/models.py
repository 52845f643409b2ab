"""Local models over the whole spectrum of a record: windows, orders, and the noise they leave.

The record is transformed whole and without window. A window of neighbouring lines slides over the band; in it a local
model of response and transient is fitted (`local_fit`), and used for the lines in its middle. The orders are chosen
window by window by Akaike's criterion (IEEE Trans. Autom. Control 19, 1974) among ORDERS.

Each pole adds a degree to both numerators, so that response and transient remain polynomials beside what the poles
add. With numerators of a fixed degree a pole among the lines, which follows the noise of one of them, takes the place
of a slope that is needed: what was left made the chi-square of these lines up to ten times too large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.covariance_pooling import RELATIVE_NOISE_FLOOR, window_sums
from balance_cli.signals.local.fit import ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.noise import NoiseCovariances, estimate_noise_covariances
from balance_cli.signals.local.tones import tone_lines
from balance_cli.signals.local.window import (
    WindowFit,
    design_matrix,
    design_pseudoinverse,
    response_rows,
    split_windows,
)
from balance_cli.signals.run_samples import load_columns, measured_components, read_samples, run_error, sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

DRAFT_ORDERS = tuple(ModelOrders(2 + poles, 1 + poles, poles) for poles in (0, 1, 2))
RECORD_MODEL_ORDERS = (
    *DRAFT_ORDERS,
    ModelOrders(5, 4, 3),
    ModelOrders(2, 3, 0),
    ModelOrders(3, 2, 0),
    ModelOrders(4, 4, 0),
)
POLYNOMIAL_ORDERS = ModelOrders(2, 2, 0)
RATIONAL_LINES = 81
RATIONAL_WIDTH_HZ = 3.0
MOST_RESPONSE_LINES = 6000
LEAST_CHANNEL_DOF = 500
POLYNOMIAL_DOF = 8
LEAST_POWER_SHARE = 1e-4
LEAST_INDEPENDENCE = 1e-6


@dataclass(frozen=True)
class ScaledSpectrum:
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

    `response` (K, c, u), `noise` and `level` (K,), the relative noise power that weighed the lines, in the spectrum's
    scaled units. `tones` (K, c) are what steady tones add to the channels of the spectrum, which is without them.
    """

    spectrum: ScaledSpectrum
    first: Index
    assigned_lines: Index
    fit: tuple[WindowFit, ...]
    response: ComplexArray
    noise: NoiseCovariances
    level: Array
    tones: ComplexArray


def record_spectrum(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> ScaledSpectrum:
    """Amplitudes of the whole record at the lines of the excited part of `band` [Hz], zero frequency left out."""
    channels, loads = read_samples(run, channel_names)
    components = measured_components(run, loads)
    z = np.hstack([channels, loads[:, load_columns(components)]])
    Z = np.fft.rfft(z, axis=0)[1 : (run.samples + 1) // 2] * (2.0 / run.samples)
    frequency = np.arange(1, len(Z) + 1) * sample_rate(run) / run.samples
    c = len(channel_names)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    excited = has_power(Z[:, c:]) & inside
    if np.count_nonzero(excited) < RATIONAL_LINES:
        raise run_error(run, "the record is too short (or its loads too narrow in frequency)", "Record more")
    if np.median(load_independence(local_power(Z[excited, c:]))) < LEAST_INDEPENDENCE:
        raise run_error(
            run, "the loads excited at once are proportional to each other", "Excite with different phases", "loads"
        )
    reach = RATIONAL_LINES // 2
    kept = slice(max(int(np.argmax(excited)) - reach, 0), len(Z) - int(np.argmax(excited[::-1])) + reach)
    channel_scale = _nonzero_rms(Z[kept, :c])
    load_scale = _nonzero_rms(Z[kept, c:])
    return ScaledSpectrum(
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


def fit_local_models(spectrum: ScaledSpectrum, estimator: str = "lrm") -> LocalModels:
    """Fit the sliding windows twice: for the noise of channels and loads, then weighted with it."""
    u = spectrum.loads.shape[1]
    candidates, M, hop = _window_layout(estimator, u, spectrum.frequency)
    first, assigned_lines = sliding_windows(len(spectrum.frequency), M, hop)
    index = first[:, None] + np.arange(M)
    r = np.broadcast_to(np.linspace(-1.0, 1.0, M), index.shape)
    spectrum = _scale_to_noise(spectrum, index, r, candidates[-1])
    windows = WindowedData(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
    few = [orders for orders in candidates if orders in DRAFT_ORDERS] or candidates
    fits = best_fits(windows, few)
    tones = np.zeros_like(spectrum.channels)
    if spectrum.run.rotor_speed == 0:
        tones = tone_lines(windows, fits, lambda some: best_fits(some, few), first, assigned_lines, len(tones))
    if np.any(tones):
        spectrum = replace(spectrum, channels=spectrum.channels - tones)
        windows = replace(windows, Y=spectrum.channels[index])
        fits = best_fits(windows, few)
    draft = _assemble_models(spectrum, first, assigned_lines, fits, np.ones(len(spectrum.frequency)), tones)
    level = draft.noise.relative_variance(draft.response)
    windows = replace(windows, weight=1.0 / np.sqrt(level[index]))
    # The noise of the loads is in all channels alike, and would pass for a pole if that were not known.
    whitening = [
        whitening_matrices(draft.noise.equation_error_covariance(draft.response, slice(start, start + M)))
        for start in first
    ]
    chosen = best_fits(windows, candidates, whitening)
    return _assemble_models(spectrum, first, assigned_lines, chosen, level, tones)


def _window_layout(estimator: str, inputs: int, frequency: Array) -> tuple[tuple[ModelOrders, ...], int, int]:
    """Candidate orders, lines in a window, lines for which a window speaks."""
    if estimator == "lpm":
        M = POLYNOMIAL_ORDERS.coefficients(inputs) + POLYNOMIAL_DOF | 1
        return (POLYNOMIAL_ORDERS,), M, 1 + len(frequency) // MOST_RESPONSE_LINES
    wide = int(RATIONAL_WIDTH_HZ / (frequency[1] - frequency[0]))
    M = max(RATIONAL_LINES, wide, 3 * max(o.coefficients(inputs) for o in RECORD_MODEL_ORDERS)) | 1
    return RECORD_MODEL_ORDERS, M, M // 3


def sliding_windows(K: int, M: int, hop: int) -> tuple[Index, Index]:
    """First line (W,) of each window, shifted inwards at the edges, and the lines (W, 2) for which it speaks."""
    start = np.arange(0, K, hop)
    assigned_lines = np.stack([start, np.minimum(start + hop, K)], axis=1)
    return np.clip(start + hop // 2 - M // 2, 0, K - M), assigned_lines


def has_power(loads: ComplexArray) -> NDArray[np.bool_]:
    """Lines (K,) around which some load has a share of LEAST_POWER of the power that it has where it is strong."""
    width = min(RATIONAL_LINES // 2, len(loads))
    power = window_sums(np.abs(loads) ** 2, width)
    strong = np.quantile(power, 0.95, axis=0)
    return np.asarray(np.any(power > LEAST_POWER_SHARE * np.maximum(strong, 1e-300), axis=1))


def local_power(loads: ComplexArray) -> ComplexArray:
    """Spectral matrix (K, u, u) of the loads (K, u), averaged over a window's lines."""
    outer = loads[:, :, None] * loads[:, None, :].conj()
    width = min(RATIONAL_LINES, len(loads))
    return np.asarray(window_sums(outer, width) / width)


def load_independence(power: ComplexArray) -> Array:
    """Smallest eigenvalue (K,) of the loads' spectral matrix scaled to unit diagonal: 0 where they are proportional."""
    size = np.sqrt(np.maximum(np.diagonal(power, axis1=1, axis2=2).real, 1e-300))
    return np.asarray(np.linalg.eigvalsh(power / (size[:, :, None] * size[:, None, :]))[:, 0])


def _nonzero_rms(values: ComplexArray) -> Array:
    rms = np.sqrt(np.mean(np.abs(values) ** 2, axis=0))
    return np.asarray(np.where(rms > 0, rms, 1.0))


def _scale_to_noise(spectrum: ScaledSpectrum, index: Index, r: Array, orders: ModelOrders) -> ScaledSpectrum:
    """The spectrum with channels scaled to like noise: the median over windows of a rich model's residual."""
    windows = WindowedData(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
    fit = fit_windows(windows, orders)
    freedom = index.shape[1] - orders.coefficients(fit.inputs)
    sigma = np.sqrt(np.median(np.sum(np.abs(fit.residual) ** 2, axis=1), axis=0) / freedom)
    scale = np.maximum(sigma, RELATIVE_NOISE_FLOOR)
    return replace(spectrum, channels=spectrum.channels / scale, channel_scale=spectrum.channel_scale * scale)


def best_fits(
    windows: WindowedData, candidates: Sequence[ModelOrders], whitening: Sequence[ComplexArray] | None = None
) -> tuple[WindowFit, ...]:
    """The fit of each window with the best orders, by Akaike's criterion.

    For N complex data and p complex parameters it is V + 2 p, V the squared residuals whitened with `white` (W arrays
    (M, c, c)), or N ln V + 2 p where the noise is not known. A pole costs 2 ln M more: it is the best of M places.
    """
    each = [split_windows(fit_windows(windows, orders), windows) for orders in candidates]
    _, M, c = windows.Y.shape
    N = M * c
    cost = np.array(
        [
            [_residual_sum_of_squares(fit, None if whitening is None else whitening[w]) for w, fit in enumerate(fits)]
            for fits in each
        ]
    )
    inputs = windows.U.shape[2]
    p = np.array([c * orders.coefficients(inputs) + orders.denominator * (1.0 + log(M)) for orders in candidates])
    fidelity = cost if whitening is not None else N * np.log(np.maximum(cost, 1e-300))
    best = np.argmin(fidelity + 2.0 * p[:, None], axis=0)
    return tuple(each[choice][w] for w, choice in enumerate(best))


def _residual_sum_of_squares(fit: WindowFit, whitening: ComplexArray | None) -> float:
    """Sum of squares of a window's residual, whitened or weighted."""
    if whitening is None:
        return float(np.sum(np.abs(fit.residual * fit.weight[:, None]) ** 2))
    return float(np.sum(np.abs(np.matmul(whitening, fit.residual[:, :, None])) ** 2))


def _assemble_models(
    spectrum: ScaledSpectrum,
    first: Index,
    assigned_lines: Index,
    fits: tuple[WindowFit, ...],
    level: Array,
    tones: ComplexArray,
) -> LocalModels:
    """Response at every line from the window that speaks for it, and the noise from what it leaves."""
    response = stitch_response(fits, first, assigned_lines)
    residual = np.zeros_like(spectrum.channels)
    counts = np.ones(len(level))
    for w, fit in enumerate(fits):
        lines = np.arange(*assigned_lines[w])
        inside = lines - first[w]
        residual[lines] = fit.residual[inside]
        taken = np.einsum("kq,qk->k", design_matrix(fit)[inside], design_pseudoinverse(fit)[:, inside]).real
        counts[lines] = np.clip(1.0 - taken, 0.05, 1.0)
    used = decimate_lines(spectrum.excited)
    noise = estimate_noise_covariances(residual[used], response[used], counts[used], LEAST_CHANNEL_DOF)
    nearest = np.clip(np.searchsorted(used, np.arange(len(level))), 0, len(used) - 1)
    noise = replace(noise, channels=noise.channels[nearest])
    return LocalModels(spectrum, first, assigned_lines, fits, response, noise, level, tones)


def decimate_lines(chosen: NDArray[np.bool_]) -> Index:
    """The lines chosen, or every second, third ... of them, so that a long record does not give too many."""
    lines = np.flatnonzero(chosen)
    return lines[:: 1 + len(lines) // MOST_RESPONSE_LINES]


def whitening_matrices(covariance: ComplexArray) -> ComplexArray:
    """Matrices (K, c, c) that make noise of this covariance (K, c, c) white."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), complex)


def stitch_response(fits: Sequence[WindowFit], first: Index, assigned_lines: Index) -> ComplexArray:
    """Response (K, c, u) at every line from the window that speaks for it."""
    places = [fit.r[np.arange(*assigned_lines[w]) - first[w]] for w, fit in enumerate(fits)]
    parts = [response_rows(fit, r) @ fit.coefficients for fit, r in zip(fits, places, strict=True)]
    return np.concatenate(parts).swapaxes(1, 2)
