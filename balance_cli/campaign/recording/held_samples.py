"""Samples that a channel did not measure: those that repeat the one before, and exact zeros of a link that dropped out.

Both need no model and no other channel. What must not be mistaken for them is a coarse converter, which repeats values
by chance, and a slow signal, which dwells at a peak.

- A segment of identical samples is held if chance does not make it: with the share p of segments of two samples or
  more around it, one of n samples begins one of length L with probability p^(L - 1). It must also end, or begin, with a
  step of several times the converter's: a slow signal leaves the value at which it dwells by a single one. Signals
  repeat values at a crest more often than beside it: the samples around the segment, by an autoregressive model, must
  predict that the channel goes on moving there.
- All samples of a channel are held if its segments have one length, or multiples of it: it was read at a lower rate.
- Exact zeros are dropped out if they are far more frequent than each of the values next to zero. They may be single
  samples: each is an error of the opposite sign of the signal, so that amplitudes are too small by their share. The
  same holds of differences of neighboring samples: single samples that repeat the one before.

Clipped samples, at the extreme of a channel, have a test of their own (`channel_health`), and so has a channel that is
constant for long.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import erfc

from balance_cli.campaign.recording.gap_interpolation import ORDER, SAMPLES_PER_COEFFICIENT, prediction_error_filter
from balance_cli.campaign.recording.run import Array, Run

Integers = NDArray[np.signedinteger]

LEAST_HELD = 5
"""Samples of the shortest segment that the values around it can prove, with NEIGHBORHOOD and CHANCE as they are."""
NEIGHBORHOOD = 512
"""Samples on either side of a segment that tell how often values repeat there."""
CHANCE = 1e-6
"""Probability that a record without held samples has a segment that is taken for held."""
MODELED = 1024
"""Samples on either side of a segment that the model of the signal is fitted to: ten for each of its coefficients."""
CHANCE_OF_DWELL = 1e-4
"""Of a record: probability of a segment, by the model, above which the channel dwelt there.

A sound record had one of 0.7 %; of 7650 held segments in records of three rigs one passes, 1 % of the signal off.
"""
MOST_DWELLS = 10
"""Segments of a record beyond which none is there by chance, and the time to ask the model would have no bound."""
STEPS_OF_CONVERTER = 4.0
"""Steps of the converter beyond which a segment is not a peak: a parabola that dwells for five samples or more moves by
less than one step in the next sample, and noise that dwells is smaller than a step."""
ROUNDING = 16.0 * float(np.finfo(np.float32).eps)
"""Of the largest magnitude: samples stored in single precision repeat at peaks, too."""
FEWEST_SEGMENTS, REGULAR_SHARE = 50, 0.98
"""Segments, and share of them with one length or multiples of it, that tell a lower rate: of a slow signal in coarse
steps no two thirds have."""
LEAST_ZEROS = 12
"""Exact zeros, of samples or of differences, below which their number says nothing."""
ZEROS_TO_NEIGHBORS = 8.0
"""Frequency of zero over that of a value next to it from which zeros are no samples."""
FEWEST_NEIGHBORS = 256
"""Samples next to zero whose distinct values are counted."""
SAMPLED = 1024
"""Sizes that tell where the smallest ones end."""
FINE_STEPS = 16.0
"""Steps of the converter within the scatter of a channel from which its values are too many for zero to be usual."""
AT_ONCE = 2**16
"""Samples whose steps are formed at once, half a megabyte: ten minutes of a channel at 50 kHz take 250."""
ROTOR_KINDS = ("check", "wind", "zero")
"""Kinds of run throughout which a channel moves; sweeps may begin, pause and end at rest."""


def held_samples(run: Run) -> dict[int, Integers]:
    """Return the indices of the samples of each column of the channels that are held or dropped out.

    A sampled run; one of hammer blows has none, because its channels may rest between them.
    """
    if run.excitation == "impact" or run.samples < LEAST_HELD:
        return {}
    held = {}
    for column in np.flatnonzero(_screen(run)).tolist():
        x = np.concatenate([block.channels[:, column].copy() for block in run.blocks()])  # views would keep the blocks
        parts = [_held(x)]
        if run.kind in ROTOR_KINDS:
            peak = _peak(x)
            parts += [_excess_zeros(x, peak), _excess_zeros(_differences(x), peak) + 1]
        index = np.unique(np.concatenate(parts))
        if len(index):
            held[column] = index
    return held


def _screen(run: Run) -> NDArray[np.bool_]:
    """Return which columns have LEAST_HELD identical samples in a row, or LEAST_ZEROS zeros or repeats."""
    columns = len(run.channel_names)
    segments, repeats, zeros = np.zeros(columns, bool), np.zeros(columns, int), np.zeros(columns, int)
    last = np.empty((0, columns))
    for block in run.blocks():
        x = np.concatenate([last, block.channels]) if len(last) else block.channels
        equal = x[1:] == x[:-1]
        if equal.any():
            several = equal[LEAST_HELD - 2 :].copy()
            for k in range(LEAST_HELD - 2):
                several &= equal[k : len(equal) - (LEAST_HELD - 2 - k)]
            segments |= several.any(axis=0)
            repeats += np.count_nonzero(equal, axis=0)
        zeros += np.count_nonzero(block.channels == 0.0, axis=0)
        last = block.channels[-(LEAST_HELD - 1) :]
    return np.asarray(segments | (np.maximum(zeros, repeats) >= LEAST_ZEROS))


def _held(x: Array) -> Integers:
    """Return the samples of a channel (n,) after the first of each segment that is held, or all of one of zeros."""
    starts, lengths = _segments(x)
    if _has_lower_rate(lengths):
        repeats = np.ones(len(x), bool)
        repeats[starts] = False
        return np.flatnonzero(repeats[: starts[-1]])[lengths[0] - 1 :]
    candidates = np.flatnonzero(lengths >= LEAST_HELD)
    candidates = candidates[(candidates > 0) & _is_inside(x, starts[candidates])]
    if not candidates.size:
        return np.empty(0, np.int64)
    share = _share_of_repeats(starts, lengths, candidates)
    by_chance = len(x) * share ** (lengths[candidates] - 1.0)
    held = candidates[(by_chance < CHANCE) & (_edge_steps(x, starts, lengths, candidates) > _least_step(x))]
    if len(held) <= MOST_DWELLS:
        held = held[~_dwells(x, starts[held], lengths[held], _converter_step(x))]
    return _held_part(x, starts[held], lengths[held])


def _segments(x: Array) -> tuple[Integers, Integers]:
    """Return first samples and lengths of the segments of identical samples; most of a long record have one sample."""
    ends = np.flatnonzero(x[1:] != x[:-1])
    starts: Integers = np.zeros(len(ends) + 1, np.int32 if len(x) < 2**30 else np.int64)
    starts[1:] = ends
    del ends
    starts[1:] += 1
    lengths = np.empty_like(starts)
    np.subtract(starts[1:], starts[:-1], out=lengths[:-1])
    lengths[-1] = len(x) - starts[-1]
    return starts, lengths


def _held_part(x: Array, starts: Integers, lengths: Integers) -> Integers:
    """Return the samples of some segments; the first of each was measured unless it is zero."""
    return _samples(
        (int(start) + (x[start] != 0.0), int(start + length)) for start, length in zip(starts, lengths, strict=True)
    )


def _has_lower_rate(lengths: Integers) -> bool:
    """Whether segments of a channel have one length, or multiples of it, but for the first and the last."""
    inside = lengths[1:-1]
    if len(inside) < FEWEST_SEGMENTS or np.count_nonzero(inside >= 2) < REGULAR_SHARE * len(inside):
        return False
    usual = int(np.median(inside))
    return bool(np.mean(inside % usual == 0) > REGULAR_SHARE)


def _is_inside(x: Array, index: Integers) -> NDArray[np.bool_]:
    """Whether the values at these samples are zero or no extremes of the channel: those may be clipped."""
    value = x[index]
    return np.asarray((value == 0.0) | ((value > np.nanmin(x)) & (value < np.nanmax(x))))


def _share_of_repeats(starts: Integers, lengths: Integers, at: Integers) -> Array:
    """Return the share of segments of two samples or more around some of them, which do not count themselves."""
    counted = np.zeros(len(lengths) + 1, lengths.dtype)
    np.cumsum(lengths >= 2, out=counted[1:])
    low = np.searchsorted(starts, starts[at] - NEIGHBORHOOD)
    high = np.searchsorted(starts, starts[at] + lengths[at] + NEIGHBORHOOD)
    # One is added to both: a share of none among some hundred is not known to be less than one of them.
    return np.asarray((counted[high] - counted[low]) / (high - low))


def _edge_steps(x: Array, starts: Integers, lengths: Integers, at: Integers) -> Array:
    """Return the larger of the steps into and out of some segments, of those that are finite."""
    first, stop = starts[at], np.minimum(starts[at] + lengths[at], len(x) - 1)
    return np.asarray(np.fmax(np.abs(x[first] - x[first - 1]), np.abs(x[first] - x[stop])))


def _dwells(x: Array, starts: Integers, lengths: Integers, step: float) -> NDArray[np.bool_]:
    """Whether the samples around each of some segments let a channel (n,) dwell there by itself."""
    known = np.isfinite(x)
    known[_held_part(x, starts, lengths)] = False
    return np.array(
        [
            len(x) * _dwell_probability(x, known, int(start), int(length), step) > CHANCE_OF_DWELL
            for start, length in zip(starts, lengths, strict=True)
        ],
        bool,
    )


def _dwell_probability(x: Array, known: NDArray[np.bool_], start: int, length: int, step: float) -> float:
    """Return the probability that a channel (n,) repeats x[start] for a segment, and goes on as it does, by itself.

    It is the product over the samples of the segment of their probability given the samples before (after, where the
    segment begins the channel), by an autoregressive model of those around it.
    """
    if start <= ORDER < len(x) - start - length:
        return _dwell_probability(x[::-1], known[::-1], len(x) - start - length, length, step)
    low = max(0, start - MODELED)
    signal, known = x[low : start + length + MODELED], known[low : start + length + MODELED]
    order = min(ORDER, start - low, int(np.count_nonzero(known)) // SAMPLES_PER_COEFFICIENT)
    complete = np.asarray(sliding_window_view(known, order + 1).all(axis=1), bool)
    if order < 1 or np.count_nonzero(complete) < 2 * order:
        return 0.0
    signal = np.where(np.isfinite(signal), signal - np.mean(signal[known]), 0.0)
    scale = float(np.abs(signal).max()) or 1.0
    signal = signal / scale
    errors = scale * np.convolve(signal, prediction_error_filter(signal, complete, order), "valid")
    first = start + 1 - low - order
    sigma = max(float(np.sqrt(np.mean(errors[complete] ** 2))), np.finfo(float).tiny)
    z = errors[first : first + length] / sigma
    repeats = min(1.0, step / (np.sqrt(2 * np.pi) * sigma)) * np.exp(-(z[: length - 1] ** 2) / 2)
    return float(np.prod(repeats) * np.prod(erfc(np.abs(z[length - 1 :]) / np.sqrt(2))))


def _least_step(x: Array) -> float:
    """Return the step from which the edge of a segment is not that of a slow signal."""
    return max(STEPS_OF_CONVERTER * _converter_step(x), ROUNDING * _peak(x))


def _converter_step(x: Array) -> float:
    """Return the smallest difference of neighboring samples that differ."""
    steps = (np.abs(np.diff(x[low : low + AT_ONCE + 1])) for low in range(0, len(x) - 1, AT_ONCE))
    return min((float(step.min(where=step > 0.0, initial=np.inf)) for step in steps), default=np.inf)


def _peak(x: Array) -> float:
    """Return the largest magnitude of the samples that are finite."""
    known = np.isfinite(x)
    return float(max(x.max(where=known, initial=0.0), -x.min(where=known, initial=0.0)))


def _differences(x: Array) -> Array:
    """Return the differences (n - 1,) of neighboring samples, NaN at the extremes of the channel."""
    differences, value = np.diff(x), x[1:]
    differences[(value != 0.0) & ~((value > np.nanmin(x)) & (value < np.nanmax(x)))] = np.nan
    return np.asarray(differences)


def _excess_zeros(values: Array, peak: float) -> Integers:
    """Return the values (n,) that are exactly zero, if there are more than chance makes; else none.

    Neighboring values of single precision, of a signal that reaches `peak`, count as one.
    """
    none = np.empty(0, np.int64)
    is_zero = values == 0.0
    zeros = np.flatnonzero(is_zero)
    if len(zeros) < LEAST_ZEROS:
        return none
    # What stands before the first and after the last other value is a channel that is not on yet, or no more.
    zeros = zeros[(zeros > np.argmin(is_zero)) & (zeros < len(values) - 1 - np.argmin(is_zero[::-1]))]
    sizes = values[np.isfinite(values) & ~is_zero]
    np.abs(sizes, out=sizes)
    if len(sizes) < FEWEST_NEIGHBORS:
        return none
    unit = 4.0 * float(np.finfo(np.float32).eps) * peak
    steps = np.round(_smallest(sizes, max(FEWEST_NEIGHBORS, 4 * len(zeros))) / unit)
    near = np.unique(steps[steps > 0.0])
    if not len(near) or len(zeros) <= LEAST_ZEROS + ZEROS_TO_NEIGHBORS * len(steps) / len(near):
        return none
    step = float(np.diff(near, prepend=0.0).min()) * unit
    return zeros if np.median(np.abs(sizes - np.median(sizes))) >= FINE_STEPS * step else none


def _smallest(sizes: Array, count: int) -> Array:
    """Return about `count` of the smallest sizes. A subsample shows where they end, because a sort takes long."""
    few = np.sort(sizes[:: max(1, len(sizes) // SAMPLED)])
    return np.asarray(sizes[sizes <= few[min(int(count / len(sizes) * len(few)) + 1, len(few) - 1)]])


def _samples(segments: Iterable[tuple[int, int]]) -> Integers:
    """Return the indices of some segments (first, stop)."""
    parts = [np.arange(first, stop, dtype=np.int64) for first, stop in segments]
    return np.concatenate([np.empty(0, np.int64), *parts])
