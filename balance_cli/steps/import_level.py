"""The level of an excitation, measured in a record whose force cell may drift."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEGREE = 3
"""Of the polynomial over the record that is its drift, which is that of a charge amplifier or a temperature."""
LEAST_DRIFT = 0.1
"""Of the mean square about the mean, from which the polynomial is a drift: of noise it takes 3 over the samples."""


def rms_about_drift(blocks: Iterable[tuple[int, Array]], samples: int) -> Array:
    """Root mean square (k,) of signals about their means, or about their drift where they have one.

    `blocks` are the first sample and values (n, k) of parts of a record of `samples`.
    """
    gram, products, squares = np.zeros((DEGREE + 1, DEGREE + 1)), np.zeros((DEGREE + 1, 1)), np.zeros(1)
    for start, values in blocks:
        places = 2.0 * (np.arange(start, start + len(values)) + 0.5) / samples - 1.0
        basis = legendre.legvander(places, DEGREE)
        gram += basis.T @ basis
        products, squares = products + basis.T @ values, squares + (values**2).sum(axis=0)
    means = products[0] / samples
    about_mean = np.maximum(squares - samples * means**2, 0.0)
    about_drift = squares - np.sum(products * np.linalg.solve(gram, products), axis=0)
    has_drift = about_mean - about_drift > LEAST_DRIFT * about_mean
    return np.asarray(np.sqrt(np.maximum(np.where(has_drift, about_drift, about_mean), 0.0) / samples))
