"""Loads as functions of time: the results of filters, the contents of history files and of the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class LoadHistory:
    """Hub loads over time: time (n,) [s from the first sample], loads and sigma (n, 6); NaN where not determined."""

    run: str
    time: Array
    loads: Array
    sigma: Array


@dataclass(frozen=True)
class LoadTrack:
    """Harmonics of the loads from revolution to revolution.

    time (r,) [s]: the middle of each revolution; amplitude (r, n+1, m) = cosine - j sine, where harmonic 0 is the mean
    and NaN in the first and the last revolution; sigma (r, n+1, m) of a cosine or sine. Components are in the order of
    the balance.
    """

    time: Array
    amplitude: ComplexArray
    sigma: Array
