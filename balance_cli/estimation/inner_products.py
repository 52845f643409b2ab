"""Real inner products of complex arrays, which chi-square and its derivatives are made of."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

MANY_PARAMETERS = 100
"""Parameters from which those that show in one channel alone are worth operations of their own: no fit has as many."""
LINES_AT_ONCE = 32
"""Lines of one step of `information_product`: with 25 channels and 200 parameters 3 MB, which stay in the cache."""
ROWS_AT_ONCE = 512
"""Rows of one step of `real_inner_product`: with 30 columns on either side 0.5 MB, which stay in the cache."""


def real_inner_product(left: ComplexArray, right: ComplexArray) -> Array:
    """Re sum over lines and channels of left* right, (K, c, a) and (K, c, b): (a, b).

    Some rows at a time are taken apart into real and imaginary parts: one real product of half the size of the complex
    one, and no conjugate copy.
    """
    rows = [values.reshape(math.prod(values.shape[:-1]), values.shape[-1]) for values in (left, right)]
    if right.shape[-1] == 1:
        return np.real(rows[1].conj().T @ rows[0]).T
    product = np.zeros((left.shape[-1], right.shape[-1]))
    for start in range(0, len(rows[0]), ROWS_AT_ONCE):
        a, b = (_stack_rows(values[start : start + ROWS_AT_ONCE]) for values in rows)
        product += a.T @ b
    return product


def weighted_information(derivatives: ComplexArray, precision: ComplexArray) -> Array:
    """Re sum dY* P dY (p, p) of derivatives dY (K, c, p) with the Hermitian precision P (K, c, c).

    Some lines at a time: the weighted derivatives stay in the cache.
    """
    product = np.zeros((derivatives.shape[2],) * 2)
    lines_at_once = max(ROWS_AT_ONCE // derivatives.shape[1], 1)
    for start in range(0, len(derivatives), lines_at_once):
        part = derivatives[start : start + lines_at_once]
        weighted = precision[start : start + lines_at_once] @ part
        a, b = (_stack_rows(values.reshape(-1, values.shape[2])) for values in (part, weighted))
        product += a.T @ b
    return product


def _stack_rows(values: ComplexArray) -> Array:
    """Rows (n, q) as (2n, q): the real parts of all, then the imaginary ones."""
    return np.concatenate([values.real, values.imag])


@dataclass(frozen=True)
class ParameterChannels:
    """Which parameters show where: `wide` (w,) in several channels, `single` (o,) in one, which is `channel` (o,).

    The single ones are in the order of their channels; `first` (c + 1,) are their places where a channel begins.
    """

    wide: Index
    single: Index
    channel: Index
    first: Index

    def by_channel(self) -> Iterator[tuple[int, Index]]:
        """Each channel with the parameters that show in it alone, where there are any."""
        for channel, (start, stop) in enumerate(zip(self.first[:-1], self.first[1:], strict=True)):
            if start < stop:
                yield channel, self.single[start:stop]


def parameter_channels(derivatives: ComplexArray) -> ParameterChannels:
    """Return where the parameters of derivatives (K, c, p) show; those that show nowhere are left out."""
    shown = np.asarray(derivatives.any(axis=0))
    count = np.count_nonzero(shown, axis=0)
    single = np.flatnonzero(count == 1)
    channel = shown[:, single].argmax(axis=0)
    order = np.argsort(channel, kind="stable")
    first = np.searchsorted(channel[order], np.arange(len(shown) + 1))
    return ParameterChannels(np.flatnonzero(count > 1), single[order], channel[order], first)


def product_with_derivatives(left: ComplexArray, derivatives: ComplexArray, shown: ParameterChannels) -> Array:
    """Re sum over lines and channels of left* dY, (K, c, a) and (K, c, p): (a, p)."""
    product = np.zeros((left.shape[2], derivatives.shape[2]))
    product[:, shown.wide] = real_inner_product(left, derivatives[:, :, shown.wide])
    for channel, own in shown.by_channel():
        product[:, own] = real_inner_product(left[:, channel], derivatives[:, channel, own])
    return product


def weighted_squares(derivatives: ComplexArray, precision: ComplexArray, shown: ParameterChannels) -> Array:
    """The diagonal (p,) of `information_product`."""
    squares = np.zeros(derivatives.shape[2])
    of_wide = derivatives[:, :, shown.wide]
    weighted = precision @ of_wide
    squares[shown.wide] = np.sum(of_wide.real * weighted.real + of_wide.imag * weighted.imag, axis=(0, 1))
    for channel, own in shown.by_channel():
        part = derivatives[:, channel, own]
        squares[own] = precision[:, channel, channel].real @ (part.real**2 + part.imag**2)
    return squares


def information_product(derivatives: ComplexArray, precision: ComplexArray) -> Array:
    """Re sum dY* P dY (p, p) of derivatives dY (K, c, p) with the Hermitian precision P (K, c, c).

    A parameter that shows in one channel alone (each crosstalk of a score test does) takes the lines of this channel:
    a rig with 24 channels has a thousand parameters, of which three quarters are such.
    """
    shown = parameter_channels(derivatives)
    wide = len(shown.wide)
    parts = np.zeros((wide + len(shown.single),) * 2)
    for start in range(0, len(derivatives), LINES_AT_ONCE):
        lines = slice(start, start + LINES_AT_ONCE)
        _add_products(parts, derivatives[lines], precision[lines], shown)
    parts[:wide, wide:] = parts[wide:, :wide].T
    single = parts[wide:, wide:]
    single[:] = np.triu(single) + np.triu(single, 1).T
    order = np.concatenate([shown.wide, shown.single])
    product = np.zeros((derivatives.shape[2],) * 2)
    product[np.ix_(order, order)] = parts
    return product


def _add_products(parts: Array, derivatives: ComplexArray, precision: ComplexArray, shown: ParameterChannels) -> None:
    """Add the products of some lines in place, of two single parameters in one order only."""
    k, c, _ = derivatives.shape
    wide = len(shown.wide)
    of_wide = _stack_parts(derivatives[:, :, shown.wide])
    weighted = _real_matrices(precision) @ of_wide
    parts[:wide, :wide] += of_wide.reshape(2 * k * c, wide).T @ weighted.reshape(2 * k * c, wide)
    by_part = weighted.reshape(k, 2, c, wide)
    of_single = derivatives[:, shown.channel, shown.single]
    left = _stack_parts(of_single[:, None])
    for channel, (start, stop) in enumerate(zip(shown.first[:-1], shown.first[1:], strict=True)):
        if start == stop:
            continue
        own, rows = left[:, :, start:stop].reshape(2 * k, -1), slice(wide + start, wide + stop)
        parts[rows, :wide] += own.T @ by_part[:, :, channel].reshape(2 * k, wide)
        later = precision[:, channel, shown.channel[start:]] * of_single[:, start:]
        parts[rows, wide + start :] += own.T @ _stack_parts(later[:, None]).reshape(2 * k, -1)


def _stack_parts(values: ComplexArray) -> Array:
    """Columns (k, c, q) as (k, 2c, q): the real parts of each line, then its imaginary ones."""
    return np.concatenate([values.real, values.imag], axis=1)


def _real_matrices(values: ComplexArray) -> Array:
    """Complex matrices (k, c, c) as real ones (k, 2c, 2c), which act on stacked parts."""
    return np.block([[values.real, -values.imag], [values.imag, values.real]])
