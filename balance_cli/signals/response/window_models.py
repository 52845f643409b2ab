"""Local models of a measured response in windows of neighboring lines, each fitted once.

A model holds between the lines in the middle of its window, at whatever frequency; the harmonics of the runs of a
campaign fall into the same windows again and again. The fit of a window does not depend on those that are fitted with
it, not even by rounding: results are the same whatever was reduced before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.distributions import chi2
from balance_cli.signals.local.fit import LocalFit, ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.window import WindowFit, split_windows
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

LOCAL_LINES = 11
"""Lines to which a local model is fitted: enough for a mode and its surroundings, and few enough for low orders."""
INTERPOLATION_ORDERS = tuple(ModelOrders(degree, -1, poles) for degree in (1, 2, 3) for poles in (0, 1, 2, 3))
LEAST_RELATIVE_SIGMA = 1e-9
"""Least standard deviation over amplitude; a computed response has none."""
WINDOWS_AT_ONCE = 128
"""Windows fitted at a time: of more the time of a fit grows with their number, a single one takes that of twenty."""
FALSE_POLE = 0.01
"""Probability with which noise makes a pole: one between two lines had made a response 41 % wrong, and loads by it 8.5
standard deviations."""
MOST_KEPT = 4096
"""Windows of one response that are kept, of 6 kB each with 15 channels."""
LEAST_WEIGHT = 0.01
"""Weight of a model beside the best one from which it counts: one of less changes sigma by less than a hundredth of
what they differ by."""


@dataclass(frozen=True)
class RivalModel:
    """A model of a window that the lines hardly tell from the best one, with its Akaike weight."""

    fit: WindowFit
    weight: float


@dataclass(frozen=True)
class WindowModel:
    """The best local model of the lines `index` (M,), about their `center` [Hz] with the half-width `half` [Hz].

    `sigma` (c u,) are the standard deviations by which the outputs were divided. `rivals` may be right as well.
    """

    index: Index
    fit: WindowFit
    center: float
    half: float
    sigma: Array
    rivals: tuple[RivalModel, ...] = ()

    def position(self, frequency: Array | float) -> Array:
        """The position of a frequency [Hz] in the window, -1 and 1 at its outer lines."""
        return np.asarray((frequency - self.center) / self.half)


def neighboring_lines(
    response: FrequencyResponse, query_frequency: Array, count: int, left_out: Index | None = None
) -> Index:
    """Return the `count` lines (h, count) around each frequency; at the ends of the band the outermost lines.

    `left_out` (h,) is the index of a line that is not used at each frequency.
    """
    K = len(response.frequency) - (left_out is not None)
    count = min(count, K)
    above = np.searchsorted(response.frequency, query_frequency)
    if left_out is None:
        return np.asarray(np.clip(above - count // 2, 0, K - count)[:, None] + np.arange(count))
    above = above - (above > left_out)
    index = np.clip(above - count // 2, 0, K - count)[:, None] + np.arange(count)
    return np.asarray(index + (index >= left_out[:, None]))


def window_models(response: FrequencyResponse, index: Index) -> list[WindowModel]:
    """Return the best local models of windows (h, M) of lines, with orders selected by Akaike's criterion."""
    kept: dict[bytes, WindowModel] = response.window_models
    keys = [row.tobytes() for row in index]
    new = list({key: row for key, row in zip(keys, index, strict=True) if key not in kept}.values())
    for start in range(0, len(new), WINDOWS_AT_ONCE):
        fitted = _fit_windows_of_lines(response, np.array(new[start : start + WINDOWS_AT_ONCE]))
        kept |= {model.index.tobytes(): model for model in fitted}
    models = [kept[key] for key in keys]
    for oldest in list(kept)[: max(len(kept) - MOST_KEPT, 0)]:
        del kept[oldest]
    return models


def _fit_windows_of_lines(response: FrequencyResponse, index: Index) -> list[WindowModel]:
    """The best local model of each window (h, M)."""
    lines = response.frequency[index]
    center, half = 0.5 * (lines[:, -1] + lines[:, 0]), 0.5 * (lines[:, -1] - lines[:, 0])
    windows, sigma = _response_windows(response, index, (lines - center[:, None]) / half[:, None])
    candidates = [
        orders for orders in INTERPOLATION_ORDERS if orders.response + orders.denominator + 2 < index.shape[1]
    ]
    fits = [fit_windows(windows, orders) for orders in candidates]
    criteria = np.array([_criterion(windows, fit) for fit in fits])
    best, weight = np.argmin(criteria, axis=0), np.exp(criteria.min(axis=0) - criteria)
    weight /= weight.sum(axis=0)
    window_fits = [split_windows(fit, windows) for fit in fits]
    return [
        WindowModel(
            row,
            window_fits[best[h]][h],
            float(center[h]),
            float(half[h]),
            sigma[h],
            tuple(
                RivalModel(window_fits[k][h], float(weight[k, h]))
                for k in np.flatnonzero(weight[:, h] >= LEAST_WEIGHT)
                if k != best[h]
            ),
        )
        for h, row in enumerate(index)
    ]


def _response_windows(response: FrequencyResponse, index: Index, r: Array) -> tuple[WindowedData, Array]:
    """Data of the windows: every channel and component as an output (h, M, c u) of a unit input, scaled by sigma."""
    c, u = response.response.shape[1:]
    values = response.response[index].reshape(*index.shape, c * u)
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    variance = (channels[:, :, None] * loads[:, None, :]).reshape(-1, c * u)[index]
    size = np.max(np.abs(values), axis=1)
    sigma = np.maximum(np.sqrt(np.median(variance, axis=1)), LEAST_RELATIVE_SIGMA * np.where(size > 0, size, 1.0))
    level = np.maximum(np.mean(variance / sigma[:, None, :] ** 2, axis=2), 1e-3)
    ones = np.ones((*index.shape, 1), complex)
    return WindowedData(values / sigma[:, None, :], ones, 1.0 / np.sqrt(level), r), sigma


def _criterion(windows: WindowedData, fit: LocalFit) -> Array:
    """Akaike's criterion, in which a pole costs what noise gains by it: the residual of the largest of M lines.

    A pole beside a line fits that line in all outputs, whose noise has as many complex degrees of freedom.
    """
    _, lines, outputs = windows.Y.shape
    largest = float(chi2.isf(FALSE_POLE / lines, 2 * outputs)) / 2.0
    pole = 2.0 + max(largest - outputs, 0.0)
    return np.asarray(fit.cost + 2.0 * outputs * fit.orders.coefficients(1) + pole * fit.orders.denominator, float)
