"""Where the start transient of a record has gone: the first revolution that is like the later ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]

# Revolutions between those that are compared: long enough for a decay to show, short against a manoeuvre. What turns by
# whole cycles in 3 and in 4 revolutions turns so in one, and is a harmonic.
COMPARED_LAGS = (3, 4)
MAX_LAG = max(COMPARED_LAGS)
SMOOTHING_REVOLUTIONS = 5  # revolutions
LATE_REVOLUTIONS = 200  # revolutions of the later part that are looked at, the last ones
LATE_SHARE = 0.25  # of the record, at least: it is never discarded
STEADY_QUANTILE = (
    0.9  # quantile of the later part that counts as steady: a moving speed or a step late in the record may be there
)
SIGNIFICANT_SIGMAS = 4.0  # standard errors
MIN_RELATIVE_NOISE = 1e-5  # of the signal, where a computed record has no noise


@dataclass(frozen=True)
class TransientEnd:
    """The first steady revolution and its time [s].

    `reached` is False where the record was still settling at the limit; `last_channel` is the channel that settled
    last ("" where the record was steady from its beginning).
    """

    first_revolution: int
    time: float
    within_limit: bool
    last_channel: str


def transient_end(run: Run, azimuth: Azimuth, limit: float, names: Sequence[str] | None = None) -> TransientEnd:
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
    last = int(min(float(np.searchsorted(_revolution_starts(azimuth), limit)), (1 - LATE_SHARE) * azimuth.turns))
    if last < 1 or azimuth.turns - last <= 2 * MAX_LAG:
        return TransientEnd(0, azimuth.first, True, "")
    points = _points_per_revolution(run, azimuth)
    early = _average_energy(
        _difference_energy(run, azimuth, names, (0, last + MAX_LAG + SMOOTHING_REVOLUTIONS), points)
    )
    span = (max(last, azimuth.turns - LATE_REVOLUTIONS), azimuth.turns)
    later = _average_energy(_difference_energy(run, azimuth, names, span, points))
    spread = 1.0 + SIGNIFICANT_SIGMAS * np.sqrt(2.0 / (SMOOTHING_REVOLUTIONS * points))
    excess = early[: last + 1] / (spread * _steady_energy(later, run, azimuth, names, last))
    steady = np.flatnonzero(np.all(excess <= 1.0, axis=1))
    first = int(steady[0]) if steady.size else last
    worst = names[int(np.argmax(excess[max(first - 1, 0)]))] if first else ""
    return TransientEnd(first, float(azimuth.time_of(np.array(first))), bool(steady.size), worst)


def _revolution_starts(azimuth: Azimuth) -> Array:
    """Times [s] at which the revolutions begin."""
    return azimuth.time_of(np.arange(azimuth.turns))


def _points_per_revolution(run: Run, azimuth: Azimuth) -> int:
    """Points of comparison in a revolution: about one a sample."""
    assert run.sample_rate is not None
    return max(4, int(run.sample_rate / azimuth.mean_rate))


def _resample_revolutions(
    run: Run, azimuth: Azimuth, names: tuple[str, ...], span: tuple[int, int], points: int
) -> Array:
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


def _difference_energy(run: Run, azimuth: Azimuth, names: tuple[str, ...], span: tuple[int, int], points: int) -> Array:
    """Mean square (revolutions - LONGEST, c) of the differences of revolutions that are APART."""
    x = _resample_revolutions(run, azimuth, names, span, points)
    rows = len(x) - MAX_LAG
    differences = [np.mean((x[apart : apart + rows] - x[:rows]) ** 2, axis=1) for apart in COMPARED_LAGS]
    return np.asarray(sum(differences))


def _average_energy(energy: Array) -> Array:
    """Mean over SMOOTHED revolutions from each on; as many rows as are whole."""
    window = np.lib.stride_tricks.sliding_window_view(energy, min(SMOOTHING_REVOLUTIONS, len(energy)), axis=0)
    return np.asarray(window.mean(axis=-1))


def _steady_energy(later: Array, run: Run, azimuth: Azimuth, names: tuple[str, ...], last: int) -> Array:
    """Usual size (c,) of the energy in the later part."""
    signal = _resample_revolutions(run, azimuth, names, (last, last + 1), _points_per_revolution(run, azimuth))[0]
    floor = (MIN_RELATIVE_NOISE * np.std(signal, axis=0)) ** 2 + np.finfo(float).tiny
    return np.asarray(np.maximum(np.quantile(later, STEADY_QUANTILE, axis=0), floor))
