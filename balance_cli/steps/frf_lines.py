"""Lines of the responses to one reference: one frequency axis for all channels, without lines that are none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]

SAME_LINE = 0.01
"""Of the distance of two lines, within which lines of two functions are one: steps of single precision and six digits
differ by 1e-3 of it in thousands of lines."""
LEAST_COMMON = 0.5
"""Share of the lines of the shortest axis that all channels must have."""
LEAST_USABLE = 0.5
"""Share of the lines of a channel that are numbers, below which the channel is left out instead of its lines."""
MIRRORED = 1e-3
"""Relative difference from the conjugate, up to which lines mirror others: beyond the rounding of six digits."""
FEWEST_LINES = 5

ZERO = "it is zero at all lines"
"""Why a channel counts as not measured: one that reads nothing has noise, and what a file lacks is written as zeros."""


@dataclass(frozen=True)
class Curve:
    """A response (k,) of one channel at `frequency` (k,) [Hz], with its coherence; None where the file has none."""

    frequency: Array
    value: ComplexArray
    coherence: Array | None
    resolution: float


@dataclass(frozen=True)
class CommonLines:
    """The responses (k, c) of channels to one reference at `frequency` (k,) [Hz].

    `coherence` (k, c) is None where a channel has none; `resolution` is the largest relative rounding. `left_out`
    {channel: reason}; `notes` say which lines are not used.
    """

    channels: tuple[str, ...]
    frequency: Array
    response: ComplexArray
    coherence: Array | None
    resolution: float
    left_out: dict[str, str]
    notes: tuple[str, ...]


def common_lines(curves: Mapping[str, Curve], reference: str) -> CommonLines:
    """Return the lines that the curves {channel: curve} over a reference have in common.

    Raises UserError where their axes differ, or hardly a line is left.
    """
    notes: dict[str, None] = {}
    left_out = {name: reason for name, curve in curves.items() if (reason := _useless(curve))}
    silent = ", ".join(f"`{name}`" for name, reason in left_out.items() if reason == ZERO)
    if silent:
        notes[f"responses to `{reference}`: {silent} zero at all lines: not measured, not a reading of nothing"] = None
    prepared = {
        name: _one_sided(curve, name, reference, notes) for name, curve in curves.items() if name not in left_out
    }
    if not prepared:
        fault = f"no channel has a response to `{reference}` ({next(iter(left_out.values()))})"
        raise UserError(fault, place=f"reference {reference}", remedy="Export the functions again")
    frequency, values, coherences = _on_one_axis(prepared, reference)
    keep, why = _usable_lines(frequency, values)
    notes |= dict.fromkeys(f"responses to `{reference}`: {text}" for text in why)
    if np.sum(keep) < FEWEST_LINES:
        fault = f"responses to `{reference}` have {plural(int(np.sum(keep)), 'usable line')}"
        raise UserError(fault, place=f"reference {reference}", remedy=f"Export at least {FEWEST_LINES} lines")
    return CommonLines(
        channels=tuple(prepared),
        frequency=frequency[keep],
        response=values[keep],
        coherence=None if coherences is None else coherences[keep],
        resolution=max(curve.resolution for curve in prepared.values()),
        left_out=left_out,
        notes=tuple(notes),
    )


def _useless(curve: Curve) -> str:
    """Return why a curve has no information; empty where it has."""
    finite = np.isfinite(curve.value)
    if np.mean(finite) < LEAST_USABLE:
        return f"{np.sum(~finite)} of {len(finite)} lines are not finite"
    return "" if np.any(curve.value[finite]) else ZERO


def _one_sided(curve: Curve, channel: str, reference: str, notes: dict[str, None]) -> Curve:
    """Return a curve with rising frequencies, the negative or mirrored half of a two-sided one left out.

    Raises UserError where that half is not the conjugate of the other, and where frequencies are not distinct.
    """
    finite = np.isfinite(curve.frequency)
    order = np.flatnonzero(finite)[np.argsort(curve.frequency[finite], kind="stable")]
    curve = _select(curve, order)
    place = f"`{channel}` over `{reference}`"
    if np.any(np.diff(curve.frequency) <= 0.0):
        raise UserError(f"{place} has a frequency twice", place="frequency", remedy="Export each line once")
    half = curve.frequency >= 0.0 if np.any(curve.frequency < 0.0) else ~_is_mirror(curve)
    if half.all():
        return curve
    if np.any(curve.frequency < 0.0) and not _halves_agree(curve):
        fault = f"{place} has negative frequencies, at which it is not the conjugate of that at the positive ones"
        raise UserError(fault, place="frequency", remedy="Export the one-sided response")
    notes[f"responses to `{reference}` are two-sided: the conjugate half is left out"] = None
    return _select(curve, np.flatnonzero(half))


def _halves_agree(curve: Curve) -> bool:
    """Whether the values at negative frequencies are the conjugates of those at positive ones, where both are there."""
    f = curve.frequency
    step = float(np.median(np.diff(f)))
    negative = np.flatnonzero(f < -SAME_LINE * step)
    beside = np.clip(np.searchsorted(f, -f[negative] - SAME_LINE * step), 0, len(f) - 1)
    paired = np.abs(f[beside] + f[negative]) < SAME_LINE * step
    return _is_conjugate(curve.value[beside[paired]], curve.value[negative[paired]])


def _is_mirror(curve: Curve) -> Mask:
    """Return which lines mirror others at the upper end of an axis from 0 Hz to nearly the sample rate."""
    count = len(curve.value)
    mirror = np.zeros(count, bool)
    half = (count - 1) // 2
    if half < FEWEST_LINES or abs(curve.frequency[0]) > SAME_LINE * (curve.frequency[1] - curve.frequency[0]):
        return mirror
    mirror[count - half :] = _is_conjugate(curve.value[1 : half + 1], curve.value[: -half - 1 : -1])
    return mirror


def _is_conjugate(first: ComplexArray, second: ComplexArray) -> bool:
    both = np.isfinite(first) & np.isfinite(second)
    size = np.linalg.norm(first[both])
    return bool(np.linalg.norm(first[both] - second[both].conj()) <= MIRRORED * size)


def _select(curve: Curve, index: NDArray[np.intp]) -> Curve:
    coherence = None if curve.coherence is None else curve.coherence[index]
    return replace(curve, frequency=curve.frequency[index], value=curve.value[index], coherence=coherence)


def _on_one_axis(curves: Mapping[str, Curve], reference: str) -> tuple[Array, ComplexArray, Array | None]:
    """Return frequency (k,), values (k, c) and coherences (k, c) at the lines that all curves have."""
    shortest = min(curves.values(), key=lambda curve: len(curve.frequency))
    frequency, index = shortest.frequency, []
    step = float(np.min(np.diff(frequency))) if len(frequency) > 1 else 1.0
    keep = np.ones(len(frequency), bool)
    for curve in curves.values():
        nearest = _nearest(curve.frequency, frequency)
        keep &= np.abs(curve.frequency[nearest] - frequency) < SAME_LINE * step
        index.append(nearest)
    if np.mean(keep) < LEAST_COMMON:
        steps = ", ".join(sorted({f"{np.median(np.diff(curve.frequency)):.6g}" for curve in curves.values()}))
        fault = f"functions over `{reference}` have {np.sum(keep)} frequencies in common (steps of {steps} Hz)"
        raise UserError(fault, place=f"reference {reference}", remedy="Export all channels at the same lines")
    values = np.stack([curve.value[at[keep]] for curve, at in zip(curves.values(), index, strict=True)], axis=1)
    if any(curve.coherence is None for curve in curves.values()):
        return frequency[keep], values, None
    parts = [
        curve.coherence[at[keep]]
        for curve, at in zip(curves.values(), index, strict=True)
        if curve.coherence is not None
    ]
    return frequency[keep], values, np.stack(parts, axis=1)


def _nearest(lines: Array, frequency: Array) -> NDArray[np.intp]:
    """Return the index of the nearest of `lines` (l,), rising, to each frequency (k,)."""
    above = np.clip(np.searchsorted(lines, frequency), 1, max(len(lines) - 1, 1))
    if len(lines) < 2:
        return np.zeros(len(frequency), np.intp)
    return np.asarray(np.where(frequency - lines[above - 1] < lines[above] - frequency, above - 1, above), np.intp)


def _usable_lines(frequency: Array, values: ComplexArray) -> tuple[Mask, list[str]]:
    """Return which lines (k,) are used, and in words which are not."""
    causes = {
        "0 Hz, which an average of spectra does not tell": frequency <= 0.0,
        "not finite": ~np.isfinite(values).all(axis=1),
        "zero in all channels": ~np.any(values, axis=1),
    }
    keep, notes = np.ones(len(frequency), bool), []
    for text, wrong in causes.items():
        new = wrong & keep
        if new.any():
            notes.append(f"{plural(int(new.sum()), 'line')} left out: {text}")
        keep &= ~wrong
    return keep, notes
