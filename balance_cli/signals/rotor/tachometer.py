"""The rotor reference of a sampled tachometer: 1/rev pulse times, with the error of the azimuth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.azimuth import Azimuth, azimuth_from_pulses
from balance_cli.signals.rotor.counts import COUNTS_REMEDY, revolution_crossings
from balance_cli.signals.rotor.edges import (
    EXTREME_SHARE,
    Edges,
    Levels,
    ReadSamples,
    find_edges,
    find_levels,
    is_ramp,
)
from balance_cli.signals.rotor.low_pass_lag import AnalogLowPass, PulseShape, edge_delay, step_delay
from balance_cli.signals.rotor.pulse_smoothing import smooth_pulses

Array = NDArray[np.float64]

GAP_RATIO = 1.5
"""Interval over the median of its neighbors from which a tooth is missing, and ratio of two widths from which pulses
are of two kinds: halfway between one and two."""
EQUAL_STATES = 0.1
"""Share of a period by which two states differ at most that noise or the level may take for each other: a sine."""
FEW_INDICES = 0.75
"""Pulses of one width over those of the other, below which the former are the index: halfway between one index in two
pulses, which is the wide one, and one in three."""
FEWEST_SAMPLES = 6.0
"""Samples of a pulse and its pause, from which its edges are sure: those of a sampled step are off by half a sample."""
RESOLVED_SAMPLES = 2.5
"""The same, below which pulses that come faster than half the sample rate look nearly alike."""
MOST_EXAMINED = 2**16
"""Samples by which an angle is told from pulses: a minute at 1 kHz."""
WIDTH_ERROR = 0.02
"""Samples by which the length of a short pulse is wrong: pulses of 1 to 6 ms at 512 to 1000 Hz had 0.01 to 0.03."""
SMALL_DOUBT = 0.1
"""Azimuth [deg] that is not worth a word: 8/rev turns by 1.4 % in it."""
NEIGHBORS = 9
"""Intervals of the running median."""
PULSES_REMEDY = "Correct `level`, `slope` or `pulses_per_revolution`"
INDEX_REMEDY = "Correct `pulses_per_revolution` and `index`, or give another tachometer channel"


@dataclass(frozen=True)
class TachometerSettings:
    """How a tachometer signal is read.

    `kind`: `pulses`, `counts` (of an encoder; also an angle) or `times` (of the pulses themselves, [s]). `index` tells
    which of several pulses a revolution is the first: `none` (any), `gap` (the one behind a missing pulse) or `wide`
    (the one of another width). `offset_deg` is the azimuth of the rotor at the pulse, `delay` [s] what the pulses come
    too late. Levels are in the unit of the channel, by default from its swing.
    """

    kind: Literal["pulses", "counts", "times"] = "pulses"
    level: float | None = None
    hysteresis: float | None = None
    slope: Literal["auto", "rising", "falling"] = "auto"
    pulses_per_revolution: int = 1
    index: Literal["none", "gap", "wide"] = "none"
    counts_per_revolution: float | None = None
    offset_deg: float = 0.0
    delay: float = 0.0
    low_pass: AnalogLowPass | None = None
    smooth: bool = True


@dataclass(frozen=True)
class RotorReference:
    """1/rev pulse times (p,) [s] from the first sample, and what is known of their error.

    `azimuth_error_deg` is one standard deviation of the azimuth at a pulse, `scatter_deg` that of a pulse before
    smoothing over `window` revolutions. A constant error (of the mark on the shaft, of the level) is in neither.
    `alias_rate` [Hz]: speed of a faster rotor whose pulses, sampled as these, look the same.
    """

    pulse_times: Array = field(repr=False)
    mean_rate: float
    azimuth_error_deg: float
    scatter_deg: float
    window: float
    notes: tuple[str, ...]
    alias_rate: float = float("inf")


def read_rotor_reference(read: ReadSamples, samples: int, rate: float, settings: TachometerSettings) -> RotorReference:
    """Find the 1/rev pulses of a tachometer channel. Raises UserError where they cannot be found or repaired."""
    if settings.kind == "times":
        stated = np.asarray(read(0, samples), float)
        times, notes = stated[np.isfinite(stated)], list[str]()
    elif settings.kind == "counts":
        times, notes = revolution_crossings(read, samples, rate, settings.counts_per_revolution or 360.0)
    else:
        times, notes = _pulse_times(read, samples, rate, settings)
    is_encoder = settings.kind == "pulses" and settings.pulses_per_revolution > 1
    try:
        azimuth = azimuth_from_pulses(times, smooth=False)
    except UserError as error:
        remedy = COUNTS_REMEDY if settings.kind == "counts" else PULSES_REMEDY
        raise UserError(error.fault, place="tachometer", remedy=remedy) from error
    alias = rate / settings.pulses_per_revolution - azimuth.mean_rate if is_encoder else float("inf")
    return replace(_reference(azimuth, notes, settings), alias_rate=alias)


def _reference(azimuth: Azimuth, notes: list[str], settings: TachometerSettings) -> RotorReference:
    smoothed = smooth_pulses(azimuth.pulse_times, azimuth.revolutions)
    rate = azimuth.mean_rate
    scatter = 360.0 * rate * smoothed.scatter
    notes = [*notes, *(note for note in azimuth.notes if not note.startswith("pulses scatter"))]
    if settings.smooth and smoothed.window > 1.0:
        times, error, window = smoothed.times, 360.0 * rate * smoothed.sigma, smoothed.window
        notes.append(
            f"pulses scatter by {scatter:.3g} deg of azimuth (one sigma); smoothed over {window:.3g} revolutions, "
            f"for a speed that changes slowly: azimuth to {error:.2g} deg"
        )
    else:
        times, error, window = azimuth.pulse_times, scatter, 1.0
    times = _apply_offset(times, azimuth, settings) - settings.delay
    return RotorReference(times, rate, error, scatter, window, tuple(notes))


def _apply_offset(times: Array, azimuth: Azimuth, settings: TachometerSettings) -> Array:
    """The times at which the azimuth is zero, where it is `offset_deg` at the pulses."""
    if settings.offset_deg == 0.0:
        return times
    return times - settings.offset_deg / 360.0 / np.interp(
        times, azimuth.pulse_times, azimuth.speed(azimuth.pulse_times)
    )


# ---- pulses ----------------------------------------------------------------------------------------------------------


def _pulse_times(read: ReadSamples, samples: int, rate: float, settings: TachometerSettings) -> tuple[Array, list[str]]:
    levels = find_levels(read, samples, settings.level, settings.hysteresis)
    _check_levels(levels)
    if settings.level is None and settings.slope == "auto":
        _refuse_angle(read(0, min(samples, MOST_EXAMINED)))
    edges = find_edges(read, samples, rate, levels)
    high = _share_of_high(edges)
    is_even = settings.slope == "auto" and abs(2.0 * high - 1.0) <= EQUAL_STATES
    rising = settings.slope == "rising" or (settings.slope == "auto" and (is_even or high <= 0.5))
    leading, trailing = (edges.rising, edges.falling) if rising else (edges.falling, edges.rising)
    if len(leading) < 3:
        fault = f"crosses the level {levels.level:.4g} only {len(leading)} times"
        raise UserError(fault, place="tachometer", remedy="Correct `level` and `hysteresis`, or give another channel")
    notes = [f"pulses are the {'rising' if rising else 'falling'} edges at {levels.level:.4g}"]
    if is_even:
        notes.append("high and low state are about equally long: state `slope` if azimuth 0 is at the falling edges")
    times, more = _once_per_revolution(leading, trailing, settings, rate)
    if settings.low_pass is not None:
        indices = times if settings.index != "none" else leading
        pulse = _pulse_shape(indices, trailing, levels.share if rising else 1.0 - levels.share)
        lag = edge_delay(settings.low_pass, pulse)
        times = times - (step_delay(settings.low_pass, pulse.share) if lag is None else lag)
        more.append(_say_lag(settings.low_pass, pulse, lag, rate, float(np.median(np.diff(times)))))
    return times, notes + more


def _pulse_shape(starts: Array, trailing: Array, share: float) -> PulseShape:
    """The pulses that begin at some edges, by medians; between two of them the signal is low as before the pulse."""
    after = np.searchsorted(trailing, starts)
    sound = (after > 0) & (after < len(trailing))
    starts, after = starts[sound], after[sound]
    width, pause = np.median(trailing[after] - starts), np.median(starts - trailing[after - 1])
    return PulseShape(float(width), float(width + pause), share, EXTREME_SHARE)


def _say_lag(low_pass: AnalogLowPass, pulse: PulseShape, lag: float | None, rate: float, revolution: float) -> str:
    """What is known of the delay of the edges, of samples at `rate` [Hz] and revolutions that last `revolution` [s]."""
    if lag is None:
        return (
            f"its pulses of {1e3 * pulse.width:.3g} ms are shorter than a low-pass of order {low_pass.order} and "
            f"{low_pass.cutoff:g} Hz lets them be; the delay of a step was taken out: does the tachometer pass the "
            "`filter` of the map?"
        )
    said = f"the low-pass of the tachometer delays its edges by {1e3 * lag:.4g} ms, which was taken out"
    others = [edge_delay(low_pass, replace(pulse, width=pulse.width + sign * WIDTH_ERROR / rate)) for sign in (1, -1)]
    doubt = max((360.0 * abs(other - lag) / revolution for other in others if other is not None), default=0.0)
    if doubt < SMALL_DOUBT:
        return said
    known = f"its pulses are hardly longer than it lets them be, and the azimuth is known to {doubt:.2g} deg only"
    return f"{said}; {known}: a longer mark, or a tachometer sampled faster, would tell it better"


def _refuse_angle(signal: Array) -> None:
    """Raise UserError for an angle: the middle of its range is passed half a revolution away from zero."""
    finite = np.asarray(signal, float)[np.isfinite(signal)]
    if len(finite) and is_ramp(finite):
        limits = f"{np.min(finite):.4g} to {np.max(finite):.4g}"
        fault = f"passes evenly from {limits} and begins again: an angle, not pulses"
        remedy = "Give `kind: counts` with `counts_per_revolution` (360 for degrees, else the range), or a `slope`"
        raise UserError(fault, place="tachometer", remedy=remedy)


def _check_levels(levels: Levels) -> None:
    if levels.high <= levels.low:
        raise UserError("is constant", place="tachometer", remedy="Give the channel of the tachometer")
    if not levels.low < levels.level < levels.high:
        fault = f"the level {levels.level:.4g} is not between its states {levels.low:.4g} and {levels.high:.4g}"
        raise UserError(fault, place="tachometer", remedy="Correct `level`, or leave it out")


def _share_of_high(edges: Edges) -> float:
    """Return the share of a period in which the signal is high; where it is at most half, pulses begin by rising."""
    if not len(edges.rising) or not len(edges.falling):
        return 0.0
    after = np.searchsorted(edges.falling, edges.rising)
    sound = after < len(edges.falling)
    widths = edges.falling[after[sound]] - edges.rising[sound]
    intervals = np.diff(edges.rising)
    return float(np.median(widths) / np.median(intervals)) if len(widths) and len(intervals) else 0.0


def _once_per_revolution(
    leading: Array, trailing: Array, settings: TachometerSettings, rate: float
) -> tuple[Array, list[str]]:
    """The pulses at which the azimuth is zero."""
    count = settings.pulses_per_revolution
    if settings.index == "gap":
        return _behind_gaps(leading, count)
    if settings.index == "wide":
        return _wide_pulses(leading, trailing, count)
    if count == 1:
        return leading, []
    samples = rate * float(np.median(np.diff(leading)))
    faster = f"They come every {samples:.2g} samples: sample them faster, or give a channel of 1/rev pulses"
    if samples < RESOLVED_SAMPLES:
        raise UserError("pulses are not resolved", place="tachometer", remedy=faster)
    try:
        teeth = azimuth_from_pulses(leading, smooth=False)
    except UserError as error:
        remedy = faster if samples < FEWEST_SAMPLES else PULSES_REMEDY
        raise UserError(error.fault, place="tachometer", remedy=remedy) from error
    notes = [f"azimuth 0 is at the first of {count} pulses a revolution: there is no index that shows which one it is"]
    repairs = [note for note in teeth.notes if not note.startswith("pulses scatter")]
    if len(teeth.pulse_times) < teeth.turns * (1.0 - 0.5 / count):
        repairs = [note for note in repairs if " missing after " not in note]
        notes.append("a pulse is missing in each revolution: state `index: gap` if azimuth 0 is at the one behind it")
    notes += repairs
    return teeth.time_of(np.arange(0, teeth.turns + 1, count)), notes


def _behind_gaps(leading: Array, count: int) -> tuple[Array, list[str]]:
    intervals = np.diff(leading)
    half = NEIGHBORS // 2
    padded = np.pad(intervals, half, mode="reflect" if len(intervals) > half else "edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, NEIGHBORS), axis=1)
    gaps = np.flatnonzero(intervals > GAP_RATIO * usual)
    if len(gaps) < 3:
        raise UserError(f"has only {len(gaps)} gaps", place="tachometer", remedy=INDEX_REMEDY)
    between = np.diff(gaps)
    present = count - (round(float(np.median(intervals[gaps] / usual[gaps]))) - 1)  # a wheel 60-2 has 58
    wrong = int(np.sum(between % max(present, 1) != 0))
    if wrong > len(between) // 2:
        fault = f"{int(np.median(between))} pulses from gap to gap, where {present} were expected"
        raise UserError(fault, place="tachometer", remedy=INDEX_REMEDY)
    notes = [f"{wrong} revolutions do not have {present} pulses and a gap"] if wrong else []
    return leading[gaps + 1], notes


def _wide_pulses(leading: Array, trailing: Array, count: int) -> tuple[Array, list[str]]:
    """The pulses of the width that fewer have; of two a revolution the wide ones."""
    after = np.searchsorted(trailing, leading)
    sound = after < len(trailing)
    starts, widths = leading[sound], trailing[after[sound]] - leading[sound]
    few = 0.5 / count if count > 1 else 0.5 / max(len(widths), 1)
    narrow, wide = np.quantile(widths, [few, 1.0 - few]) if len(widths) else (1.0, 1.0)
    is_wide = widths > np.sqrt(narrow * wide)
    index = ~is_wide if (~is_wide).sum() < FEW_INDICES * is_wide.sum() else is_wide
    found = int(index.sum()) if wide > GAP_RATIO * narrow else 0
    if found < 3:
        raise UserError(f"has only {found} pulses of another width", place="tachometer", remedy=INDEX_REMEDY)
    return starts[index], []
