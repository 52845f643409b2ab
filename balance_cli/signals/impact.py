"""Records of an impact hammer: its hits, double hits, and loads of a hammer that are declared as something else.

Between its hits a hammer applies no force: what its cell reads there is noise, and by far the most of all that a record
holds. A force window takes it out (Ewins, Modal Testing, 2nd ed., 2000, section 3.7). An exponential window of the
channels is not needed, because the local models describe what is left of earlier taps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Array, Run, excerpt_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError

IMPACT = "impact"
LEAST_CREST = 8.0
"""Of a hit, over the standard deviation of the noise between hits; noise alone reaches 5 in a million samples."""
ZERO_SHARE = 0.01
"""Of the largest load: less counts as no load. Of Gaussian noise one sample in forty is so small, and of a hammer
nearly all are, its noise included."""
SHORT_SHARE = 0.05
"""Share of the samples with a load below which a record consists of hits. Hits of 10 ms in frames of 0.5 s fill 2 %."""
HIT_ENERGY_SHARE = 1.0 / 3.0
"""Of all of a load, in its hits: a force cell that drifts holds as much between them. One wrong sample of 50 standard
deviations in a random record of 20 s at 1 kHz has a ninth."""
HIT_SHARE = 0.1
"""Of the largest load, from which a peak is a hit: the rebound of a double hit is larger."""
RINGING_SHARE = 0.7
"""Of the largest opposite force between a peak and the hit beside it, up to which the peak is ringing of the anti-alias
filter. A lobe has 0.3 to 0.54 of the one before behind Butterworth filters of order 4 to 10, 0.59 behind an ideal
low-pass; a hammer that rebounds pushes again and never pulls."""
DOUBLE_INTERVAL = 0.15
"""[s] between two hits that are one tap which bounced; nobody taps twice so fast."""
WINDOW_SIGMAS = 5.0
"""Standard deviations of the noise of a force from which a sample belongs to a hit."""
LEAST_NOISE = 1e-7
"""Of the largest force: a computed record has no noise, but the ringing of a filter without end."""
MOST_SAMPLES = 2**24
"""Samples of a record whose force is held in memory; a longer one is used as it is."""
MARGIN = 1
"""Length of the window before and after a hit over that of the hit: the ringing of an anti-alias filter falls below the
noise, but not at once to zero."""
BEFORE_TAP = 0.02
"""[s] from the start of a part of a record to its first tap: more than a filter of linear phase rings before a hit."""
GAUSSIAN = 1.4826
"""Standard deviation of Gaussian noise over the median of its absolute values."""


@dataclass(frozen=True)
class Hits:
    """Hits of a record: times of their peaks [s], and which of them follow another within DOUBLE_INTERVAL."""

    times: Array
    is_double: NDArray[np.bool_]

    @property
    def note(self) -> str:
        """What to tell of them."""
        taps, doubles = int(np.sum(~self.is_double)), int(np.sum(self.is_double))
        text = f"{taps} {'tap' if taps == 1 else 'taps'} of the hammer"
        if not doubles:
            return text
        first = float(self.times[self.is_double][0])
        times = "once" if doubles == 1 else f"{doubles} times"
        return f"{text}, which bounced {times} (first at {first:.4g} s): the force has notches there"


@dataclass(frozen=True)
class HammerRecord:
    """The part of a hammer record that is used: samples `start` to `stop`, and its taps.

    `taps` (t,) are the times [s] of all taps in the record as it was read, `is_double` (t,) those that bounced and
    `is_used` (t,) those within the part.
    """

    start: int
    stop: int
    taps: Array
    is_double: NDArray[np.bool_]
    is_used: NDArray[np.bool_]

    @property
    def summary(self) -> dict[str, Any]:
        """The taps in JSON; they count from 1."""
        number = np.arange(1, len(self.taps) + 1)
        return {
            "taps": [float(time) for time in self.taps],
            "bounced": number[self.is_double].tolist(),
            "dropped": number[~self.is_used].tolist(),
        }

    @property
    def note(self) -> str:
        """What to tell of dropped taps; empty where there are none."""
        if self.is_used.all():
            return ""
        number = np.arange(1, len(self.taps) + 1)
        bounced = ", ".join(f"{k} (at {self.taps[k - 1]:.4g} s)" for k in number[self.is_double])
        used = int(self.is_used.sum())
        return f"tap {bounced} of {len(number)} bounced; the longest part without such taps is used, with {used}"


def hammer_record(run: Run) -> HammerRecord | None:
    """The part of a hammer record with the most taps of which none bounced; None where a run is not such a record.

    Raises UserError where every tap bounced.
    """
    loads = hammer_loads(run)
    if loads is None or run.sample_rate is None:
        return None
    hits = find_hits(_combined_force(loads), run.sample_rate)
    tap = np.cumsum(~hits.is_double) - 1
    taps = hits.times[~hits.is_double]
    is_double = np.bincount(tap[hits.is_double], minlength=len(taps)) > 0
    if is_double.all():
        fault = f"every tap of the hammer bounced ({len(taps)} taps)"
        raise UserError(fault, run.file, "loads", "Repeat the record with single hits")
    first, last = _longest_part(is_double)
    begin = int((taps[first] - BEFORE_TAP) * run.sample_rate) if first else 0
    end = int((taps[last] - BEFORE_TAP) * run.sample_rate) if last < len(taps) else run.samples
    inside = np.arange(len(taps))
    return HammerRecord(max(begin, 0), end, taps, is_double, (inside >= first) & (inside < last))


def use_hammer_record(run: Run) -> Run:
    """The part of a hammer record that is used; the same run where it is no such record.

    Raises UserError where every tap bounced, or a run that is declared as one has no hit.
    """
    record = hammer_record(run)
    if record is None:
        return run
    if (record.start, record.stop) == (0, run.samples):
        return run
    return excerpt_run(run, record.start, record.stop)


@dataclass(frozen=True)
class WindowedForces:
    """Loads (n, u) of a hammer, zero between its hits, the `noise` (u,) of a sample, and how many `samples` are left.

    Where no load is zero but for short hits there is no window: the loads are as they were, and no samples are named.
    """

    loads: Array
    noise: Array
    samples: float


def window_forces(loads: Array) -> WindowedForces:
    """Set the loads (n, u) of a hammer to zero where it does not hit, with smooth edges, and their median to zero."""
    short = np.array([has_short_hits(column, noisy=True) for column in loads.T], bool)
    if not short.any():
        return WindowedForces(loads, np.zeros(loads.shape[1]), 0.0)
    centered = loads - np.median(loads, axis=0)
    window = force_window(combined_hits(loads[:, short]))
    noise = GAUSSIAN * np.median(np.abs(centered), axis=0)
    windowed = np.where(short, centered * window[:, None], loads)
    return WindowedForces(windowed, np.where(short, noise, 0.0), float(np.sum(window**2)))


def force_window(size: Array) -> Array:
    """Return the window (n,) of a hammer: 1 about its hits, 0 elsewhere, with edges of half a cosine.

    `size` (n,) are the absolute values of its force about the median.
    """
    from scipy.ndimage import maximum_filter1d

    noise = max(GAUSSIAN * float(np.median(size)), LEAST_NOISE * float(size.max(initial=0.0)))
    is_hit = size > WINDOW_SIGMAS * noise
    margin = MARGIN * max(_longest_run(is_hit), 2)
    wide = maximum_filter1d(is_hit.astype(float), 2 * margin + 1)
    edge = np.hanning(2 * margin + 1)
    # At the ends of the record the window goes on as it is there: a hit at the start would be cut in half.
    return np.asarray(np.clip(np.convolve(np.pad(wide, margin, "edge"), edge / edge.sum(), "valid"), 0.0, 1.0))


def _longest_run(flags: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _longest_part(is_double: NDArray[np.bool_]) -> tuple[int, int]:
    """First tap and the one behind the last, of the longest part without a double hit."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~is_double).astype(int), [0]])))
    longest = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * longest]), int(edges[2 * longest + 1])


def hammer_loads(run: Run) -> Array | None:
    """The loads (n, k) of a run that are zero but for short hits; None where it is no record of a hammer."""
    if run.kind != "sweep" or run.excitation != IMPACT or not run.has_loads or run.samples > MOST_SAMPLES:
        return None
    loads = run.read().loads
    if loads is None or not np.isfinite(loads).all():
        return None
    hits = _excited_hits(run, loads)
    if not hits.shape[1] and np.any(loads) and not any(has_hit(column) for column in loads.T):
        fault = "it is declared as `impact`, but no load has a hit that stands out of its noise"
        remedy = "Leave the record out, or declare its `excitation`"
        raise UserError(fault, run.file, "loads", remedy)
    return hits if hits.shape[1] else None


def _excited_hits(run: Run, loads: Array) -> Array:
    """The columns of the loads that `excited` names, or all, as far as they are hits."""
    names: Sequence[str] = run.excited or COMPONENTS
    columns = [COMPONENTS.index(name) for name in names if name in COMPONENTS]
    return loads[:, [k for k in columns if has_short_hits(loads[:, k], noisy=True)]]


def combined_hits(loads: Array) -> Array:
    """One signal (n,) of the size of the hits of several loads (n, k), each relative to its largest."""
    return np.abs(_combined_force(loads))


def _combined_force(loads: Array) -> Array:
    """Return the force (n,), of several loads (n, k), that is largest relative to the largest of its load, signed."""
    centered = loads - np.median(loads, axis=0)
    relative = centered / np.abs(centered).max(axis=0)
    largest = np.argmax(np.abs(relative), axis=1)[:, None]
    return np.asarray(np.take_along_axis(relative, largest, axis=1)[:, 0])


def has_short_hits(load: Array, noisy: bool = False) -> bool:
    """Whether a load (n,) is zero but for short hits; `noisy`: or noise, which is no hit of a declared hammer."""
    size = np.abs(load - np.median(load))
    largest = float(size.max(initial=0.0))
    noise = GAUSSIAN * float(np.median(size)) if noisy and has_hit(load) else 0.0
    return largest > 0.0 and float(np.mean(size > max(ZERO_SHARE * largest, WINDOW_SIGMAS * noise))) < SHORT_SHARE


def is_mostly_hits(load: Array) -> bool:
    """Whether short hits hold most of a load (n,) that noise and a drift of its cell keep from zero between them."""
    size = np.abs(load - np.median(load))
    in_hits = size > WINDOW_SIGMAS * GAUSSIAN * float(np.median(size))
    has_energy = float(np.sum(size[in_hits] ** 2)) > HIT_ENERGY_SHARE * float(np.sum(size**2))
    return has_energy and has_hit(load) and float(np.mean(in_hits)) < SHORT_SHARE


def has_hit(load: Array) -> bool:
    """Whether the largest value of a load (n,) stands out of all others as a hit does."""
    size = np.abs(load - np.median(load))
    return float(size.max(initial=0.0)) > LEAST_CREST * GAUSSIAN * float(np.median(size))


def find_hits(load: Array, rate: float) -> Hits:
    """Find the hits in a load (n,) sampled at `rate` [Hz]; the ringing of a filter beside a hit does not count."""
    force = load - np.median(load)
    size = np.abs(force)
    above = np.concatenate([[False], size > HIT_SHARE * float(size.max(initial=0.0)), [False]])
    edges = np.flatnonzero(np.diff(above.astype(int)))
    peaks = np.array([a + int(np.argmax(size[a:b])) for a, b in zip(edges[::2], edges[1::2], strict=True)], int)
    taps = np.split(peaks, np.flatnonzero(np.diff(peaks) >= DOUBLE_INTERVAL * rate) + 1)
    times = np.array([peak for tap in taps for peak in _without_ringing(force, tap)], float) / rate
    return Hits(times, np.concatenate([[False], np.diff(times) < DOUBLE_INTERVAL])[: len(times)])


def _without_ringing(force: Array, peaks: NDArray[np.intp]) -> list[int]:
    """Return those of neighboring peaks of a force (n,) that push like the largest one, and are no lobes of another."""
    if not len(peaks):
        return []
    push = force * np.sign(force[peaks[np.argmax(np.abs(force[peaks]))]])

    def pull(peak: int) -> float:
        """The largest opposite force between a peak and all larger ones."""
        reach = [peak, *peaks[push[peaks] > push[peak]].tolist()]
        return -float(push[min(reach) : max(reach) + 1].min())

    return [peak for peak in peaks.tolist() if push[peak] > max(RINGING_SHARE * pull(peak), 0.0)]
