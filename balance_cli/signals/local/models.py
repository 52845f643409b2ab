"""Local models over the whole spectrum of a record: windows, orders, and the noise that they leave.

The whole record is transformed without a taper. A window of neighboring lines slides over the band; a local model of
response and transient is fitted in it (`signals.local.fit`) and used for the lines in its middle. The orders are
selected window by window by Akaike's criterion (IEEE Trans. Autom. Control 19, 1974) among RECORD_MODEL_ORDERS, the
width of a window by a test (`signals.local.widths`).

Each pole adds a degree to both numerators, so that response and transient remain polynomials beside the contribution
of the poles. With numerators of a fixed degree a pole that follows the noise of a single line replaces a linear term
that is needed; the chi-square of these lines was then up to ten times too large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, log, log2, sqrt

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import RELATIVE_NOISE_FLOOR
from balance_cli.signals.local.fit import ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.noise import NoiseCovariances, estimate_noise_covariances, whitening_matrices
from balance_cli.signals.local.scaled_spectrum import RATIONAL_LINES, ScaledSpectrum
from balance_cli.signals.local.selection import Descriptions, akaike_choice, take_each
from balance_cli.signals.local.tones import tone_lines
from balance_cli.signals.local.widths import FittedWindows, WindowLayout, fit_best_widths, sliding_windows
from balance_cli.signals.local.window import WindowFit, response_rows, split_windows

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

DRAFT_ORDERS = tuple(ModelOrders(2 + poles, 1 + poles, poles) for poles in (0, 1, 2))
"""Orders of the first pass, which serves to find the noise: up to two modes in a window."""
RECORD_MODEL_ORDERS = (
    *DRAFT_ORDERS,
    ModelOrders(2, 1, 1),
    ModelOrders(4, 2, 1),
    ModelOrders(5, 4, 3),
    ModelOrders(3, 2, 0),
    ModelOrders(4, 4, 0),
)
"""Candidates of the second pass: up to three modes in a window, and polynomials where no mode is near. In none
has the transient a higher degree than the response: near the ends of a sweep residuals do not tell one from the other,
and with degrees (2, 3) errors there were 2.3 sigma. Beside its pole a mode needs less in a narrow window, (2, 1, 1),
and more of the response alone in a wide one, (4, 2, 1): polynomials in their place described stepped records as
well, with a transient that held part of the response, and errors of 3 to 12 sigma."""
POLYNOMIAL_ORDERS = ModelOrders(2, 2, 0)
"""Orders of the local polynomial method; second degree is customary (Pintelon and Schoukens, 2012, chapter 7)."""
RATIONAL_WIDTH = 0.132
"""Least width of such a window over the geometric middle of the band, or over the width of a narrow band: several
half-power widths of a mode of 1 % in the middle; 3 Hz of the band of 4 to 146 Hz by which these models are tested."""
LEAST_MIDDLE = 0.2
"""Least middle of a band over the frequency below which half of the loads' power lies: a band that begins near zero has
no geometric middle. Noise reaches the highest frequency, whatever was excited; of a constant density over a decade the
geometric middle is 0.58 of that frequency, over two decades 0.2."""
LINES_PER_PARAMETER = 3
"""Least lines of a window over the parameters of a channel in its largest model, which has its share of the poles. With
4 a record of 3 s with five modes had eight times its noise, with 3 it is 1.2 times."""
MOST_RESPONSE_LINES = 6000
"""Lines of a response; a longer record is decimated, which keeps files and fits small."""
LEAST_CHANNEL_DOF = 500
"""Degrees of freedom of the noise covariance of the channels; it comes from one record, over many lines."""
POLYNOMIAL_DOF = 8
"""Degrees of freedom that a window of the polynomial method leaves for the noise."""
AVERAGED_SHARE = 4.0 / 9.0
"""Lines of a window over which a response averages, over all: in the middle a parabola has weights of sum of squares
9/4 over the lines; with poles and higher degrees it averages over fewer."""
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
    """Fit sliding windows twice: narrow ones to find the noise of channels and loads, then weighted with it.

    Those of a rational model are as wide as the noise allows.
    """
    K = len(spectrum.frequency)
    candidates, narrow, widest = _window_layouts(estimator, spectrum)
    spectrum = _scale_to_noise(spectrum, _spectrum_windows(spectrum, narrow), candidates[-1])
    draft_orders = [orders for orders in candidates if orders in DRAFT_ORDERS] or candidates
    spectrum, tones, fits = _without_tones(spectrum, narrow, widest, draft_orders)
    draft = _assemble_models(spectrum, FittedWindows(narrow.first, narrow.assigned_lines, fits), np.ones(K), tones)
    level = draft.noise.relative_variance(draft.response)
    # The noise of the loads is common to all channels. Without whitening it would be fitted by a pole.
    white = whitening_matrices(draft.noise.equation_error_covariance(draft.response))

    def fit(layout: WindowLayout) -> tuple[tuple[WindowFit, ...], Descriptions]:
        windows = replace(_spectrum_windows(spectrum, layout), weight=1.0 / np.sqrt(level[layout.index]))
        return whitened_fits(windows, candidates, [white[start : start + layout.lines] for start in layout.first])

    models = _assemble_models(spectrum, fit_best_widths(widest, fit, narrow.lines, K), level, tones)
    return _with_window_noise(models)


def _spectrum_windows(spectrum: ScaledSpectrum, layout: WindowLayout) -> WindowedData:
    index = layout.index
    r = np.broadcast_to(np.linspace(-1.0, 1.0, layout.lines), index.shape)
    return WindowedData(spectrum.channels[index], spectrum.loads[index], np.ones(index.shape), r)


def _without_tones(
    spectrum: ScaledSpectrum, narrow: WindowLayout, widest: WindowLayout, orders: Sequence[ModelOrders]
) -> tuple[ScaledSpectrum, ComplexArray, tuple[WindowFit, ...]]:
    """Return the spectrum without steady tones, these tones (K, c), and the fits of the narrow windows.

    Few lines show a tone that more lines do not: one that narrow windows find counts where the widest find it, too.
    """
    fits = best_fits(_spectrum_windows(spectrum, narrow), orders)
    tones = np.zeros_like(spectrum.channels)
    if spectrum.run.rotor_speed == 0:
        tones = _tones(spectrum, narrow, fits, orders)
        if np.any(tones) and widest.lines > narrow.lines:
            wide = best_fits(_spectrum_windows(spectrum, widest), orders)
            tones = _tones(spectrum, widest, wide, orders)
    if np.any(tones):
        spectrum = replace(spectrum, channels=spectrum.channels - tones)
        fits = best_fits(_spectrum_windows(spectrum, narrow), orders)
    return spectrum, tones, fits


def _tones(
    spectrum: ScaledSpectrum, layout: WindowLayout, fits: Sequence[WindowFit], orders: Sequence[ModelOrders]
) -> ComplexArray:
    windows = _spectrum_windows(spectrum, layout)
    first, assigned_lines = layout.first, layout.assigned_lines
    return tone_lines(windows, fits, lambda one: best_fits(one, orders), first, assigned_lines, len(spectrum.channels))


def _with_window_noise(models: LocalModels) -> LocalModels:
    """Return the models with the noise of loads within a force window.

    A response that is fitted to so many lines does not average an error that is common to them. The noise counts as
    white noise that has the same variance in the mean over them.
    """
    windowed = models.spectrum.window_noise
    if windowed is None:
        return models
    lines = max(len(fit.r) for fit in models.fit)
    variance = windowed.variance * min(AVERAGED_SHARE * lines, windowed.correlated_lines)
    return replace(models, noise=replace(models.noise, loads=models.noise.loads + np.diag(variance)))


def _median_frequency(spectrum: ScaledSpectrum) -> float:
    """Return the frequency [Hz] below which half of the loads' power lies."""
    power = np.cumsum(np.sum(np.abs(spectrum.loads) ** 2, axis=1))
    return float(spectrum.frequency[np.searchsorted(power, 0.5 * power[-1])])


def _window_layouts(
    estimator: str, spectrum: ScaledSpectrum
) -> tuple[tuple[ModelOrders, ...], WindowLayout, WindowLayout]:
    """Candidate orders, the narrowest and the widest windows of a spectrum."""
    frequency, (K, u) = spectrum.frequency, spectrum.loads.shape
    if estimator == "lpm":
        M = POLYNOMIAL_ORDERS.coefficients(u) + POLYNOMIAL_DOF | 1
        layout = sliding_windows(K, M, 1 + K // MOST_RESPONSE_LINES)
        return (POLYNOMIAL_ORDERS,), layout, layout
    largest = max(RECORD_MODEL_ORDERS, key=lambda orders: orders.coefficients(u))
    M = max(_usual_lines(frequency, _median_frequency(spectrum)), 3 * largest.coefficients(u)) | 1
    narrow = _narrowest(largest, u, spectrum.channels.shape[1])
    doublings = max(round(log2(M / narrow)), 0)
    if doublings == 0 or narrow << doublings > K:
        usual = sliding_windows(K, M, M // 3)
        return RECORD_MODEL_ORDERS, usual, usual
    narrowest, widest = (sliding_windows(K, lines, lines // 3) for lines in (narrow, narrow << doublings))
    return RECORD_MODEL_ORDERS, narrowest, widest


def _usual_lines(frequency: Array, median: float) -> int:
    """Lines of a window by its band (K,) [Hz], where half of the power of the loads is below `median` [Hz]."""
    least, most = frequency[0], frequency[-1]
    middle = max(sqrt(least * most), LEAST_MIDDLE * median)
    return max(RATIONAL_LINES, int(RATIONAL_WIDTH * min(middle, most - least) / (frequency[1] - least)))


def _narrowest(orders: ModelOrders, inputs: int, channels: int) -> int:
    """Lines that determine the parameters of these orders: several for each, a pole being shared by the channels.

    A multiple of six: windows are used for a third of their lines, in two parts by the halves of the next ones.
    """
    coefficients = orders.coefficients(inputs)
    poles = orders.denominator * (1.0 + log(LINES_PER_PARAMETER * coefficients)) / channels
    return 6 * ceil(LINES_PER_PARAMETER * (coefficients + poles) / 6)


def _scale_to_noise(spectrum: ScaledSpectrum, windows: WindowedData, orders: ModelOrders) -> ScaledSpectrum:
    """Scale the channels to equal noise: the median over windows of the residual of the largest model."""
    fit = fit_windows(windows, orders)
    dof = windows.r.shape[1] - orders.coefficients(fit.inputs)
    sigma = np.sqrt(np.median(np.sum(np.abs(fit.residual) ** 2, axis=1), axis=0) / dof)
    scale = np.maximum(sigma, RELATIVE_NOISE_FLOOR)
    return replace(spectrum, channels=spectrum.channels / scale, channel_scale=spectrum.channel_scale * scale)


def best_fits(windows: WindowedData, candidates: Sequence[ModelOrders]) -> tuple[WindowFit, ...]:
    """Fit each window with the orders that Akaike's criterion selects, where the noise is not known.

    For N complex data, p complex parameters and the squared residuals V it is N ln V + 2 p. A pole costs 2 ln M more,
    because its position is the best of M.
    """
    fits, described = _fit_orders(windows, candidates)
    criterion = [
        windows.Y[0].size * np.log(np.maximum(one.cost, 1e-300)) + 2.0 * (one.parameters + one.places)
        for one in described
    ]
    return tuple(fits[choice][w] for w, choice in enumerate(np.argmin(criterion, axis=0)))


def whitened_fits(
    windows: WindowedData, candidates: Sequence[ModelOrders], whitening: Sequence[ComplexArray]
) -> tuple[tuple[WindowFit, ...], Descriptions]:
    """Fit each window with the orders that Akaike's criterion selects, and return what they leave of the data, too.

    `whitening` (W arrays (M, c, c)) makes the noise white.
    """
    fits, described = _fit_orders(windows, candidates, whitening)
    best = akaike_choice(described)
    return tuple(fits[choice][w] for w, choice in enumerate(best)), take_each(described, best)


def _fit_orders(
    windows: WindowedData, candidates: Sequence[ModelOrders], whitening: Sequence[ComplexArray] | None = None
) -> tuple[list[tuple[WindowFit, ...]], list[Descriptions]]:
    """Fits of all windows with each of the orders, and what they leave of the data."""
    W, M, c = windows.Y.shape
    fits = [split_windows(fit_windows(windows, orders), windows) for orders in candidates]
    described = []
    for orders, of_windows in zip(candidates, fits, strict=True):
        white = [None] * W if whitening is None else whitening
        cost = [_residual_sum_of_squares(fit, one) for fit, one in zip(of_windows, white, strict=True)]
        parameters = float(c * orders.coefficients(windows.U.shape[2]) + orders.denominator)
        places = orders.denominator * log(M)
        described.append(Descriptions(np.array(cost), np.full(W, parameters), np.full(W, places)))
    return fits, described


def _residual_sum_of_squares(fit: WindowFit, whitening: ComplexArray | None) -> float:
    """Sum of squares of the residual of a window, whitened or weighted."""
    parts = fit.residual * fit.weight[:, None] if whitening is None else np.matmul(whitening, fit.residual[:, :, None])
    return float(np.vdot(parts, parts).real)


def _assemble_models(
    spectrum: ScaledSpectrum, windows: FittedWindows, level: Array, tones: ComplexArray
) -> LocalModels:
    """Assemble the response at every line from the window that is used there, and the noise from its residual."""
    first, assigned_lines, fits = windows.first, windows.assigned_lines, windows.fit
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


def stitch_response(fits: Sequence[WindowFit], first: Index, assigned_lines: Index) -> ComplexArray:
    """Return the response (K, c, u) at every line, from the window that is used there."""
    positions = [fit.r[np.arange(*assigned_lines[w]) - first[w]] for w, fit in enumerate(fits)]
    parts = [response_rows(fit, r) @ fit.coefficients for fit, r in zip(fits, positions, strict=True)]
    return np.concatenate(parts).swapaxes(1, 2)
