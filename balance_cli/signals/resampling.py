"""Band-limited resampling of records in blocks: another rate, another start, no phase shift."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PASSBAND = 0.8
"""Share of half the lower of the two rates that passes; the stopband begins at half that rate, so nothing aliases."""
ATTENUATION = 100.0
"""[dB] of ripple and stopband: below the resolution of 16 bit."""
LARGEST_DENOMINATOR = 2000
"""Of a ratio of rates that is resampled by a polyphase filter; other ratios need a filter for every sample."""
LARGEST_SLIP = 1e-4
"""Samples by which a rational ratio may be off at the end of the record."""


def kernel_half_length(rate_in: float, rate_out: float) -> float:
    """Half the length of the kernel [s], by Kaiser's formula for its transition band."""
    lower = min(rate_in, rate_out)
    transition = math.pi * (1.0 - PASSBAND)
    return math.ceil((ATTENUATION - 7.95) / (2.285 * transition) / 2.0) / lower


@dataclass(frozen=True)
class Resampler:
    """Samples (n, k) at `rate_out` from a record at `rate_in` of which `read(start, stop)` gives samples.

    Sample m is at `start` + m / `rate_out` [s], counted from the first sample of the record. The kernel is a sinc with
    a Kaiser window, symmetric about each instant: linear phase without delay. Instants need half a kernel of record on
    either side.
    """

    read_record: Callable[[int, int], Array]
    rate_in: float
    rate_out: float
    start: float
    samples: int

    @property
    def half_length(self) -> float:
        """Half the kernel in samples of the record."""
        return kernel_half_length(self.rate_in, self.rate_out) * self.rate_in

    @cached_property
    def _ratio(self) -> Fraction | None:
        ratio = Fraction(self.rate_in / self.rate_out).limit_denominator(LARGEST_DENOMINATOR)
        slip = abs(float(ratio) - self.rate_in / self.rate_out) * self.samples
        return ratio if slip < LARGEST_SLIP else None

    def read(self, start: int, stop: int) -> Array:
        """Samples start to stop."""
        positions = self._positions(start, stop)
        first = max(math.floor(positions[0] - self.half_length), 0)
        block = self.read_record(first, math.ceil(positions[-1] + self.half_length) + 1)
        if self._ratio is None:
            return _evaluate(block, positions - first, self._kernel, self.half_length)
        return self._polyphase(block, float(positions[0] - first), self._ratio, stop - start)

    def _positions(self, start: int, stop: int) -> Array:
        """Places of the samples in the record, in samples of the record."""
        step = float(self._ratio) if self._ratio is not None else self.rate_in / self.rate_out
        return np.asarray(self.start * self.rate_in + step * np.arange(start, stop), np.float64)

    def _kernel(self, distance: Array) -> Array:
        """Weight of a sample at `distance` [samples of the record]; the weights sum to one."""
        from scipy.signal import kaiser_beta  # its import takes longer than that of a file at one rate

        bandwidth = min(1.0, self.rate_out / self.rate_in) * 0.5 * (1.0 + PASSBAND)
        inside = np.clip(1.0 - (distance / self.half_length) ** 2, 0.0, None)
        beta = float(kaiser_beta(ATTENUATION))
        window = np.i0(beta * np.sqrt(inside)) / np.i0(beta)
        return np.asarray(np.where(inside > 0.0, bandwidth * np.sinc(bandwidth * distance) * window, 0.0), float)

    def _polyphase(self, block: Array, offset: float, ratio: Fraction, count: int) -> Array:
        """Output m is the sum over i of block[i] h[m p - i q], h[j] the kernel at j / q + offset."""
        from scipy.signal import upfirdn  # see `_kernel`

        p, q = ratio.numerator, ratio.denominator
        first = math.ceil((-self.half_length - offset) * q)
        first -= first % p
        last = math.floor((self.half_length - offset) * q)
        taps = self._kernel(np.arange(first, last + 1) / q + offset)
        phases = np.array([taps[(k - first) % q :: q].sum() for k in range(q)])
        taps /= phases[np.arange(first, last + 1) % q]  # each phase passes a constant exactly
        filtered = upfirdn(taps, block, up=q, down=p, axis=0)
        return np.asarray(filtered[-first // p : -first // p + count])


@dataclass(frozen=True)
class LinearInterpolator:
    """Straight lines between the samples of a slow quantity, such as a temperature: nothing is lost at its ends.

    As a `Resampler`, but with the record's number of samples; instants before the first and behind the last sample get
    its value.
    """

    read_record: Callable[[int, int], Array]
    rate_in: float
    rate_out: float
    start: float
    record_samples: int

    def read(self, start: int, stop: int) -> Array:
        """Samples start to stop; those beside a missing sample are missing."""
        positions = (self.start + np.arange(start, stop) / self.rate_out) * self.rate_in
        positions = np.clip(positions, 0.0, self.record_samples - 1.0)
        first, last = math.floor(positions[0]), math.ceil(positions[-1])
        block = self.read_record(first, last + 1)
        columns = [np.interp(positions - first, np.arange(len(block)), column) for column in block.T]
        return np.column_stack(columns)


def _evaluate(block: Array, positions: Array, kernel: Callable[[Array], Array], half_length: float) -> Array:
    """The band-limited signal at any positions, each by its own weights."""
    reach = math.ceil(half_length)
    nearest = np.rint(positions).astype(int)
    index = nearest[:, None] + np.arange(-reach, reach + 1)
    weights = kernel(positions[:, None] - index)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("mt,mtk->mk", weights, block[np.clip(index, 0, len(block) - 1)]))
