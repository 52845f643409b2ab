"""Zeros of the load series of a held-out run: what the unloaded balance read before or after each of its rows.

A run that returns to the load with which it begins tells its zero again each time. Where these zeros differ by more
than the noise, every load series has its own, as in the calibration. Whether a return opens the next series, closes the
last one or both, the errors of the known loads decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

SHIFT_P_VALUE = 1e-3
"""P-value below which returns to the first load tell zeros that shift: one of a thousand sound runs is taken apart."""


@dataclass(frozen=True)
class CheckZero:
    """Readings (m, c) [V] of the unloaded rig in each row, or (1, c) in all, and their variance (c,) [V2].

    `note`: how zeros that differ between load series were assigned; None for one zero.
    """

    readings: Array
    variance: Array
    note: str | None = None


def zeros_of_run(unloaded: Array, tare: Mask, noise: Array, dof: float) -> CheckZero:
    """The zeros of a run whose rows read `unloaded` (m, c) [V], less what the model gives for their known loads.

    `tare` (m,): rows at the load that tells the zero; `noise` (c,) [V2]: variance of a reading, of `dof` degrees of
    freedom.
    """
    opens = np.cumsum(tare & ~np.r_[False, tare[:-1]])
    zeros, count = _series_zeros(unloaded, tare, opens)
    mean = unloaded[tare].mean(axis=0)
    if len(count) == 1 or np.min(_p_values(zeros - mean, count, noise, dof)) * len(noise) > SHIFT_P_VALUE:
        return CheckZero(mean[None], noise / np.count_nonzero(tare))
    last = tare & ~np.r_[tare[1:], False]
    within = last & np.r_[False, tare[:-1]]  # a return of several rows closes one series and opens another
    possible = {"before": opens, "after": np.cumsum(np.r_[False, last[:-1]]), "before and after": np.cumsum(within)}
    zeros_by_side = {side: _assigned(unloaded, tare, series, noise, side) for side, series in possible.items()}
    return min(zeros_by_side.values(), key=lambda zero: float(np.sum((unloaded - zero.readings)[~tare] ** 2 / noise)))


def _assigned(unloaded: Array, tare: Mask, series: Index, noise: Array, side: str) -> CheckZero:
    """Zeros of the load `series` (m,) from their rows at the `tare`; without one, a series has that of the next."""
    zeros, count = _series_zeros(unloaded, tare, series)
    place = np.minimum(np.searchsorted(np.unique(series[tare]), series), len(count) - 1)
    loaded = len(np.unique(place[~tare]))
    note = f"zeros of its {loaded} load series differ; each is counted from the tare point {side} its loads"
    return CheckZero(zeros[place], noise * np.mean(1.0 / count[place]), note)


def _series_zeros(unloaded: Array, tare: Mask, series: Index) -> tuple[Array, Index]:
    """Mean reading (g, c) of the rows at the tare in each load series that has any, and their number (g,)."""
    place, count = np.unique(series[tare], return_inverse=True, return_counts=True)[1:]
    sums = np.zeros((len(count), unloaded.shape[1]))
    np.add.at(sums, place, unloaded[tare])
    return sums / count[:, None], count


def _p_values(deviation: Array, count: Index, noise: Array, dof: float) -> Array:
    """P-values (c,) that zeros deviate (g, c) from their mean by the noise alone."""
    freedom = len(count) - 1
    ratio = np.sum(count[:, None] * deviation**2, axis=0) / noise / freedom
    return np.asarray([stats.f.sf(value, freedom, dof) for value in ratio])
