"""Local models over the whole spectrum of a record: windows, orders, and the noise that they leave.

The whole record is transformed without a taper. A window of neighboring lines slides over the band; a local model of
response and transient is fitted in it (`signals.local.fit`) and used for the lines in its middle. The orders are
selected window by window by Akaike's criterion (IEEE Trans. Autom. Control 19, 1974) among RECORD_MODEL_ORDERS.

Each pole adds a degree to both numerators, so that response and transient remain polynomials beside the contribution
of the poles. With numerators of a fixed degree a pole that follows the noise of a single line replaces a linear term
that is needed; the chi-square of these lines was then up to ten times too large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import RELATIVE_NOISE_FLOOR
from balance_cli.signals.local.fit import ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.noise import NoiseCovariances, estimate_noise_covariances
from balance_cli.signals.local.scaled_spectrum import RATIONAL_LINES, ScaledSpectrum
from balance_cli.signals.local.tones import tone_lines
from balance_cli.signals.local.window import (
    WindowFit,
    response_rows,
    split_windows,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

DRAFT_ORDERS = tuple(ModelOrders(2 + poles, 1 + poles, poles) for poles in (0, 1, 2))
"""Orders of the first pass, which serves to find the noise: up to two modes in a window."""
RECORD_MODEL_ORDERS = (
    *DRAFT_ORDERS,
    ModelOrders(5, 4, 3),
    ModelOrders(2, 3, 0),
    ModelOrders(3, 2, 0),
    ModelOrders(4, 4, 0),
)
"""Candidates of the second pass: up to three modes in a window, and polynomials where no mode is near."""
POLYNOMIAL_ORDERS = ModelOrders(2, 2, 0)
"""Orders of the local polynomial method; second degree is customary (Pintelon and Schoukens, 2012, chapter 7)."""
RATIONAL_WIDTH = 0.132
"""Least width of such a window over the geometric middle of the band, or over the width of a narrow band: several
half-power widths of a mode of 1 % in the middle; 3 Hz of the band of 4 to 146 Hz by which these models are tested."""
LEAST_MIDDLE = 0.2
"""Least middle of a band over the frequency below which half of the loads' power lies: a band that begins near zero has
no geometric middle. Noise reaches the highest frequency, whatever was excited; of a constant density over a decade the
geometric middle is 0.58 of that frequency, over two decades 0.2."""
MOST_RESPONSE_LINES = 6000
"""Lines of a response; a longer record is decimated, which keeps files and fits small."""
LEAST_CHANNEL_DOF = 500
"""Degrees of freedom of the noise covariance of the channels; it comes from one record, over many lines."""
POLYNOMIAL_DOF = 8
"""Degrees of freedom that a window of the polynomial method leaves for the noise."""
AVERAGED_SHARE = 4.0 / 9.0
"""Lines of a window over which a response averages, over all: in the middle a parabola has weights of sum of squares
9/4 over the lines; with poles and higher degrees it averages over fewer."""
NOISELESS_RIDGE = 1e-9
"""Of the mean noise of the channels: far above rounding, far below the differences of noise between channels."""
LEAST_LINE_COUNT = 0.05
"""Least share of a degree of freedom that a line keeps after the fit, so that its noise is not divided by zero."""


@dataclass(frozen=True)
class LocalModels:
    """Local models of a spectrum.

    Window w begins at line `first[w]` and is used for the lines `assigned_lines[w]` (from, to). `response` (K, c, u),
    `noise` and `level` (K,), the relative noise power by which the lines were weighted, are in the scaled units of the
    spectrum. `tones` (K, c) are the lines of steady tones, which were subtracted from the channels of the spectrum.
    """

    spectrum: ScaledSpectrum
    first: Index
    assigned_lines: Index
    fit: tuple[WindowFit, ...]
    response: ComplexArray
    noise: NoiseCovariances
    level: Array
    tones: ComplexArray


def fit_local_models(spectrum: ScaledSpectrum, estimator: str = "lrm") -> LocalModels:
    """Fit the sliding windows twice: first to find the noise of channels and loads, then weighted with it."""
    u = spectrum.loads.shape[1]
    candidates, M, hop = _window_layout(estimator, u, spectrum.frequency, _median_frequency(spectrum))
    first, assigned_lines = sliding_windows(len(spectrum.frequency), M, hop)
    index = first[:, None] + np.arange(M)
    r = np.broadcast_to(np.linspace(-1.0, 1.0, M), index.shape)
    spectrum = _scale_to_noise(spectrum, index, r, candidates[-1])
    windows = WindowedData(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
    draft_orders = [orders for orders in candidates if orders in DRAFT_ORDERS] or candidates
    fits = best_fits(windows, draft_orders)
    tones = np.zeros_like(spectrum.channels)
    if spectrum.run.rotor_speed == 0:
        tones = tone_lines(
            windows, fits, lambda window: best_fits(window, draft_orders), first, assigned_lines, len(tones)
        )
    if np.any(tones):
        spectrum = replace(spectrum, channels=spectrum.channels - tones)
        windows = replace(windows, Y=spectrum.channels[index])
        fits = best_fits(windows, draft_orders)
    draft = _assemble_models(spectrum, first, assigned_lines, fits, np.ones(len(spectrum.frequency)), tones)
    level = draft.noise.relative_variance(draft.response)
    windows = replace(windows, weight=1.0 / np.sqrt(level[index]))
    # The noise of the loads is common to all channels. Without whitening it would be fitted by a pole.
    white = whitening_matrices(draft.noise.equation_error_covariance(draft.response))
    fits = best_fits(windows, candidates, [white[start : start + M] for start in first])
    models = _assemble_models(spectrum, first, assigned_lines, fits, level, tones)
    return _with_window_noise(models, M)


def _with_window_noise(models: LocalModels, lines: int) -> LocalModels:
    """Return the models with the noise of loads within a force window.

    A response that is fitted to so many lines does not average an error that is common to them. The noise counts as
    white noise that has the same variance in the mean over them.
    """
    windowed = models.spectrum.window_noise
    if windowed is None:
        return models
    variance = windowed.variance * min(AVERAGED_SHARE * lines, windowed.correlated_lines)
    return replace(models, noise=replace(models.noise, loads=models.noise.loads + np.diag(variance)))


def _median_frequency(spectrum: ScaledSpectrum) -> float:
    """Return the frequency [Hz] below which half of the loads' power lies."""
    power = np.cumsum(np.sum(np.abs(spectrum.loads) ** 2, axis=1))
    return float(spectrum.frequency[np.searchsorted(power, 0.5 * power[-1])])


def _window_layout(
    estimator: str, inputs: int, frequency: Array, median: float
) -> tuple[tuple[ModelOrders, ...], int, int]:
    """Candidate orders, lines in a window, lines for which a window is used; half of the power is below `median`."""
    if estimator == "lpm":
        M = POLYNOMIAL_ORDERS.coefficients(inputs) + POLYNOMIAL_DOF | 1
        return (POLYNOMIAL_ORDERS,), M, 1 + len(frequency) // MOST_RESPONSE_LINES
    least, most = frequency[0], frequency[-1]
    middle = max(sqrt(least * most), LEAST_MIDDLE * median)
    width = int(RATIONAL_WIDTH * min(middle, most - least) / (frequency[1] - least))
    M = max(RATIONAL_LINES, width, 3 * max(o.coefficients(inputs) for o in RECORD_MODEL_ORDERS)) | 1
    return RECORD_MODEL_ORDERS, M, M // 3


def sliding_windows(K: int, M: int, hop: int) -> tuple[Index, Index]:
    """Return the first line (W,) of each window, shifted inward at the edges, and the lines (W, 2) assigned to it."""
    start = np.arange(0, K, hop)
    assigned_lines = np.stack([start, np.minimum(start + hop, K)], axis=1)
    return np.clip(start + hop // 2 - M // 2, 0, K - M), assigned_lines


def _scale_to_noise(spectrum: ScaledSpectrum, index: Index, r: Array, orders: ModelOrders) -> ScaledSpectrum:
    """Scale the channels to equal noise: the median over windows of the residual of the largest model."""
    windows = WindowedData(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)
    fit = fit_windows(windows, orders)
    dof = index.shape[1] - orders.coefficients(fit.inputs)
    sigma = np.sqrt(np.median(np.sum(np.abs(fit.residual) ** 2, axis=1), axis=0) / dof)
    scale = np.maximum(sigma, RELATIVE_NOISE_FLOOR)
    return replace(spectrum, channels=spectrum.channels / scale, channel_scale=spectrum.channel_scale * scale)


def best_fits(
    windows: WindowedData, candidates: Sequence[ModelOrders], whitening: Sequence[ComplexArray] | None = None
) -> tuple[WindowFit, ...]:
    """Fit each window with the orders that Akaike's criterion selects.

    For N complex data and p complex parameters the criterion is V + 2 p, where V are the squared residuals whitened
    with `whitening` (W arrays (M, c, c)), or N ln V + 2 p where the noise is not known. A pole costs 2 ln M more,
    because its position is the best of M.
    """
    fits_by_orders = [split_windows(fit_windows(windows, orders), windows) for orders in candidates]
    _, M, c = windows.Y.shape
    N = M * c
    cost = np.array(
        [
            [_residual_sum_of_squares(fit, None if whitening is None else whitening[w]) for w, fit in enumerate(fits)]
            for fits in fits_by_orders
        ]
    )
    inputs = windows.U.shape[2]
    p = np.array([c * orders.coefficients(inputs) + orders.denominator * (1.0 + log(M)) for orders in candidates])
    fidelity = cost if whitening is not None else N * np.log(np.maximum(cost, 1e-300))
    best = np.argmin(fidelity + 2.0 * p[:, None], axis=0)
    return tuple(fits_by_orders[choice][w] for w, choice in enumerate(best))


def _residual_sum_of_squares(fit: WindowFit, whitening: ComplexArray | None) -> float:
    """Sum of squares of the residual of a window, whitened or weighted."""
    parts = fit.residual * fit.weight[:, None] if whitening is None else np.matmul(whitening, fit.residual[:, :, None])
    return float(np.vdot(parts, parts).real)


def _assemble_models(
    spectrum: ScaledSpectrum,
    first: Index,
    assigned_lines: Index,
    fits: tuple[WindowFit, ...],
    level: Array,
    tones: ComplexArray,
) -> LocalModels:
    """Assemble the response at every line from the window that is used there, and the noise from its residual."""
    response = stitch_response(fits, first, assigned_lines)
    residual = np.zeros_like(spectrum.channels)
    counts, variance = np.ones(len(level)), np.zeros(len(level))
    for w, fit in enumerate(fits):
        lines = np.arange(*assigned_lines[w])
        inside = lines - first[w]
        residual[lines] = fit.residual[inside]
        inverse = fit.pseudoinverse
        leverage = np.einsum("kq,qk->k", fit.regressors[inside], inverse[:, inside]).real
        counts[lines] = np.clip(1.0 - leverage, LEAST_LINE_COUNT, 1.0)
        weights = response_rows(fit, fit.r[inside]) @ inverse
        variance[lines] = np.sum(np.abs(weights) ** 2, axis=1) @ level[first[w] : first[w] + len(fit.r)]
    used = decimate_lines(spectrum.excited)
    noise = estimate_noise_covariances(residual[used], response[used], counts[used], LEAST_CHANNEL_DOF, variance[used])
    nearest = np.clip(np.searchsorted(used, np.arange(len(level))), 0, len(used) - 1)
    noise = replace(noise, channels=noise.channels[nearest])
    return LocalModels(spectrum, first, assigned_lines, fits, response, noise, level, tones)


def decimate_lines(selected: NDArray[np.bool_]) -> Index:
    """Return the selected lines, or every second, third ... of them, at most MOST_RESPONSE_LINES."""
    lines = np.flatnonzero(selected)
    return lines[:: 1 + len(lines) // MOST_RESPONSE_LINES]


def whitening_matrices(covariance: ComplexArray) -> ComplexArray:
    """Return matrices (K, c, c) that make noise of this covariance (K, c, c) white."""
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        # Computed records have no noise in some directions, but rounding, which may be of either sign.
        c = covariance.shape[1]
        size = np.maximum(np.trace(covariance, axis1=1, axis2=2).real / c, np.finfo(float).tiny)
        root = np.linalg.cholesky(covariance + (NOISELESS_RIDGE * size)[:, None, None] * np.eye(c))
    return np.asarray(np.linalg.inv(root), complex)


def stitch_response(fits: Sequence[WindowFit], first: Index, assigned_lines: Index) -> ComplexArray:
    """Return the response (K, c, u) at every line, from the window that is used there."""
    positions = [fit.r[np.arange(*assigned_lines[w]) - first[w]] for w, fit in enumerate(fits)]
    parts = [response_rows(fit, r) @ fit.coefficients for fit, r in zip(fits, positions, strict=True)]
    return np.concatenate(parts).swapaxes(1, 2)
