"""Where the start transient of a record has gone: the first revolution that is like the later ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.azimuth import Azimuth

Array = NDArray[np.float64]

# Revolutions between those that are compared: long enough for a decay to show, short against a manoeuvre. What turns by
# whole cycles in 3 and in 4 revolutions turns so in one, and is a harmonic.
APART = (3, 4)
LONGEST = max(APART)
SMOOTHED = 5  # revolutions
LATER = 200  # revolutions of the later part that are looked at, the last ones
LATER_SHARE = 0.25  # of the record, at least: it is never discarded
USUAL = (
    0.9  # quantile of the later part that counts as steady: a moving speed or a step late in the record may be there
)
CERTAIN = 4.0  # standard errors
LEAST_NOISE = 1e-5  # of the signal, where a computed record has no noise


@dataclass(frozen=True)
class Settling:
    """The first steady revolution and its time [s].

    `reached` is False where the record was still settling at the limit; `last_channel` is the channel that settled
    last ("" where the record was steady from its beginning).
    """

    first_revolution: int
    time: float
    reached: bool
    last_channel: str


def settling(run: Run, azimuth: Azimuth, limit: float, names: Sequence[str] | None = None) -> Settling:
    """First revolution of the run from which on the start transient has gone.

    `limit` [s from the first sample] caps the search: the caller knows the slowest decay that can be there; nor is the
    last quarter of the record ever discarded. `names`: the channels to look at (all by default; they must be finite).

    Each revolution is compared with the third and the fourth after it, sample by sample in azimuth: what repeats in
    every revolution drops out, what moves slowly nearly so, and what decays or is no rotor harmonic stays. The mean
    square of that difference, channel by channel, is set against its usual size in the later part of the record. The
    first revolution at which no channel exceeds that is steady. A step or manoeuvre later on is never looked at, and
    raises the usual size at worst.
    """
    names = tuple(run.channel_names if names is None else names)
    last = int(min(float(np.searchsorted(_starts(azimuth), limit)), (1 - LATER_SHARE) * azimuth.turns))
    if last < 1 or azimuth.turns - last <= 2 * LONGEST:
        return Settling(0, azimuth.first, True, "")
    points = _points(run, azimuth)
    early = _smoothed(_energy(run, azimuth, names, (0, last + LONGEST + SMOOTHED), points))
    span = (max(last, azimuth.turns - LATER), azimuth.turns)
    later = _smoothed(_energy(run, azimuth, names, span, points))
    spread = 1.0 + CERTAIN * np.sqrt(2.0 / (SMOOTHED * points))
    excess = early[: last + 1] / (spread * _usual(later, run, azimuth, names, last))
    steady = np.flatnonzero(np.all(excess <= 1.0, axis=1))
    first = int(steady[0]) if steady.size else last
    worst = names[int(np.argmax(excess[max(first - 1, 0)]))] if first else ""
    return Settling(first, float(azimuth.time_of(np.array(first))), bool(steady.size), worst)


def _starts(azimuth: Azimuth) -> Array:
    """Times [s] at which the revolutions begin."""
    return azimuth.time_of(np.arange(azimuth.turns))


def _points(run: Run, azimuth: Azimuth) -> int:
    """Points of comparison in a revolution: about one a sample."""
    assert run.sample_rate is not None
    return max(4, int(run.sample_rate / azimuth.mean_rate))


def _revolutions(run: Run, azimuth: Azimuth, names: tuple[str, ...], span: tuple[int, int], points: int) -> Array:
    """Signals at even azimuths (revolutions, points, c), by a cubic spline through the samples."""
    from scipy.interpolate import make_interp_spline

    assert run.sample_rate is not None
    first, last = max(span[0], 0), min(span[1], azimuth.turns)
    time = azimuth.time_of(first + np.arange((last - first) * points) / points)
    low = max(int(time[0] * run.sample_rate) - 8, 0)
    high = min(int(time[-1] * run.sample_rate) + 9, run.samples)
    columns = [run.channel_names.index(name) for name in names]
    samples = run.read(low, high).channels[:, columns]
    spline = make_interp_spline(np.arange(low, high) / run.sample_rate, samples, k=3)
    return np.asarray(spline(time)).reshape(last - first, points, len(names))


def _energy(run: Run, azimuth: Azimuth, names: tuple[str, ...], span: tuple[int, int], points: int) -> Array:
    """Mean square (revolutions - LONGEST, c) of the differences of revolutions that are APART."""
    x = _revolutions(run, azimuth, names, span, points)
    rows = len(x) - LONGEST
    differences = [np.mean((x[apart : apart + rows] - x[:rows]) ** 2, axis=1) for apart in APART]
    return np.asarray(sum(differences))


def _smoothed(energy: Array) -> Array:
    """Mean over SMOOTHED revolutions from each on; as many rows as are whole."""
    window = np.lib.stride_tricks.sliding_window_view(energy, min(SMOOTHED, len(energy)), axis=0)
    return np.asarray(window.mean(axis=-1))


def _usual(later: Array, run: Run, azimuth: Azimuth, names: tuple[str, ...], last: int) -> Array:
    """Usual size (c,) of the energy in the later part."""
    signal = _revolutions(run, azimuth, names, (last, last + 1), _points(run, azimuth))[0]
    floor = (LEAST_NOISE * np.std(signal, axis=0)) ** 2 + np.finfo(float).tiny
    return np.asarray(np.maximum(np.quantile(later, USUAL, axis=0), floor))
