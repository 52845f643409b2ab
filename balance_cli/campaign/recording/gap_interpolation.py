"""Interpolation of missing samples by an autoregressive model of the samples around them, with its error.

The model is fitted to the surroundings by least squares, forward and backward in time. The missing samples are those
that minimize its squared residuals (Janssen, Veldhuis and Vries, IEEE Trans. ASSP 34, 1986, 317), which is their
conditional mean if the signal is Gaussian. On the rotor records of the sample campaign a gap of 32 samples is then
filled with the error of one sample's noise; in a random record, with that error up to five samples, and a tenth of the
signal at 32.

The error is measured, not assumed: the same gaps are cut into the samples beside them, which are known, and filled in
the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

ORDER = 96
"""Order of the model: with 32 the error in rotor records is 20 times larger, with 128 the same as with 64."""
SAMPLES_PER_COEFFICIENT = 8
"""Samples for each coefficient at least, from which an autoregressive model predicts better than it fits noise."""
RIDGE = 1e-10
"""Of the mean power, added to the diagonal of the normal equations: computed records without noise are singular."""
FILL_ITERATIONS = 3
"""Passes of fit and interpolation where gaps are so frequent that too few segments of ORDER samples are whole."""
DISPLACEMENTS = 16
"""Places beside the gaps at which the error is measured: it is then known to 18 %."""
LEAST_DISPLACEMENT, REACH = 40, 235
"""Samples by which the gaps are displaced, at least (farther than a gap is long) and at most, in steps of 13."""


@dataclass(frozen=True)
class Interpolation:
    """Values (m,) of the missing samples, and the errors (DISPLACEMENTS, m) at the same gaps beside them."""

    values: Array
    errors: Array


def interpolate_missing(
    signal: Array, missing: NDArray[np.bool_], first: int, stop: int, ends: bool = False
) -> Interpolation | None:
    """Fill the missing samples first to stop of a signal (n,); None where too few samples are left for a model.

    The displaced gaps lie after the real ones; before them where the signal `ends` with its record.
    """
    if ends:
        n = len(signal)
        backward = interpolate_missing(signal[::-1], missing[::-1], n - stop, n - first)
        return backward and Interpolation(backward.values[::-1], backward.errors[:, ::-1])
    order = min(ORDER, int(np.count_nonzero(~missing)) // SAMPLES_PER_COEFFICIENT)
    if order < 1:
        return None
    level = float(np.mean(signal[~missing]))
    x = np.where(missing, 0.0, signal - level)
    place = np.flatnonzero(missing)
    wanted = (place >= first) & (place < stop)
    if not np.any(x):
        return Interpolation(np.full(wanted.sum(), level), np.zeros((DISPLACEMENTS, wanted.sum())))
    filled, coefficients = _fill(x, missing, order)
    return Interpolation(level + filled[place[wanted]], _errors(filled, place, wanted, coefficients))


def _errors(x: Array, place: Integers, wanted: NDArray[np.bool_], coefficients: Array) -> Array:
    """Return the errors (DISPLACEMENTS, m) of the wanted samples at displaced gaps.

    Where the record has no room for displaced gaps, the error is taken to be as large as the signal itself.
    """
    reach = min(REACH, len(x) - 1 - int(place[wanted][-1]) - len(coefficients))
    if reach < LEAST_DISPLACEMENT + DISPLACEMENTS:
        return np.full((DISPLACEMENTS, int(wanted.sum())), float(np.sqrt(np.mean(x**2))))
    length = len(x) - reach
    within = place < length
    fill = _Filler(place[within], coefficients, length)
    shifts = np.linspace(LEAST_DISPLACEMENT, reach, DISPLACEMENTS).astype(int)
    return np.array([fill.error(x[shift : shift + length])[wanted[within]] for shift in shifts])


def _fill(x: Array, missing: NDArray[np.bool_], order: int) -> tuple[Array, Array]:
    """Return the signal with its gaps filled, and the prediction-error filter (order + 1,)."""
    place = np.flatnonzero(missing)
    is_complete = ~np.any(np.lib.stride_tricks.sliding_window_view(missing, order + 1), axis=1)
    enough = np.count_nonzero(is_complete) >= 2 * order
    filled = x.copy()
    filled[place] = np.interp(place, np.flatnonzero(~missing), x[~missing])
    coefficients = np.ones(1)
    for _ in range(1 if enough else FILL_ITERATIONS):
        coefficients = prediction_error_filter(filled, is_complete if enough else np.ones_like(is_complete), order)
        filled[place] = _Filler(place, coefficients, len(x)).values(filled)
    return filled, coefficients


def prediction_error_filter(x: Array, rows: NDArray[np.bool_], order: int) -> Array:
    """Return the coefficients (order + 1,), the first 1, of the least residual forward and backward in time."""
    windows = np.lib.stride_tricks.sliding_window_view(x, order + 1)[rows]
    power = windows.T @ windows
    power = power + power[::-1, ::-1]
    normal = power[:order, :order]
    normal = normal + RIDGE * np.trace(normal) / order * np.eye(order)
    return np.concatenate([[1.0], -np.linalg.solve(normal, power[:order, order])[::-1]])


class _Filler:
    """The linear map from a signal of `length` samples to its missing ones.

    Least squares of the model's residuals forward and backward in time: each alone says little of the samples at one
    end of a record.
    """

    def __init__(self, missing: Integers, coefficients: Array, length: int) -> None:
        self.length = length
        self._missing, self._coefficients = missing, coefficients
        order = len(coefficients) - 1
        lag = np.arange(order, length)[:, None] - missing[None, :]
        columns = [
            np.where((k >= 0) & (k <= order), coefficients[np.clip(k, 0, order)], 0.0) for k in (lag, order - lag)
        ]
        rows = np.any([np.any(part != 0.0, axis=1) for part in columns], axis=0)
        self._rows = np.flatnonzero(rows)
        q, r = np.linalg.qr(np.concatenate([part[rows] for part in columns]))
        self._inverse = solve_triangular(r, q.T)

    def values(self, x: Array) -> Array:
        """Return the missing samples (m,) of a signal (length,), whose own values there are not used."""
        known = x.copy()
        known[self._missing] = 0.0
        forward = np.convolve(known, self._coefficients, "valid")[self._rows]
        backward = np.convolve(known, self._coefficients[::-1], "valid")[self._rows]
        return np.asarray(-self._inverse @ np.concatenate([forward, backward]))

    def error(self, x: Array) -> Array:
        """Return filled minus actual samples (m,) of a signal whose samples are all known."""
        return np.asarray(self.values(x) - x[self._missing])
