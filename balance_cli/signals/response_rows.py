"""Channels and loads of one run at selected frequencies: enough to see which channel answers to which load, and how.

The estimate is quick and coarse, meant for comparisons in which a factor, a sign or an order is at stake. Records are
transformed once, and lines are averaged over narrow bands with the spectrum of an applied load as reference:
Y = S_yu / sqrt(S_uu), U = S_vu / sqrt(S_uu), so that Y = T U holds for the averages as for each line.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

from balance_cli.campaign.recording.run import Run, pick_channels
from balance_cli.campaign.rig.attitude import attitude_segments, gravity_directions
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

BAND_RATIO = 1.01
"""Width of a band relative to its frequency: half of the width of a mode with 1 % damping."""
START_SHARE = 0.2
"""Share of a record that is left out at its start: most of the start transient, and exciters that are being started."""
MOST_SAMPLES = 2**17
"""Samples of a record that are transformed, the last ones; more would only add lines."""
FEWEST_SAMPLES = 64
LEAST_POWER = 1e-3
"""Power of a band relative to the strongest band of the same load, from which the load drives the channels there."""
MOST_BANDS = 1000
"""Bands of one run and load."""
TINY = float(np.finfo(np.float32).tiny)
NOISE_LINES = 5
"""Lines from whose scatter about one response the noise of a band is estimated, where the band itself has fewer."""


@dataclass(frozen=True)
class ResponseRows:
    """Rows (k,) of one run: `frequency` [Hz], `channels` (k, c) [V], `loads` (k, 6) [N, N m], complex.

    `reference` (k,) is the index of the component that drives a row; `band` (k,) numbers the bands alike in all runs.
    Load points of a static run have frequency zero, reference -1 and band -1; they count from the mean of their
    attitude, in which the rig has a weight of its own. Channels that the run lacks, or that are not finite, are NaN.
    `noise_share` (k, c) is the energy that a channel has without a load relative to that of its row; zero in static
    runs. `by_points` are the components that forces beside the hub drive at once, with the reference; none where loads
    act at the hub.
    """

    run: str
    kind: str
    rotor_speed: float
    excited: tuple[str, ...]
    frequency: Array
    channels: ComplexArray
    loads: ComplexArray
    reference: Index
    band: Index
    noise_share: Array
    by_points: tuple[int, ...] = field(default=(), kw_only=True)

    @property
    def is_static(self) -> bool:
        """Whether the rows are load points."""
        return self.kind == "static"


def select_rows(rows: ResponseRows, keep: NDArray[np.bool_]) -> ResponseRows:
    """Return the selected rows (k,)."""
    names = ("frequency", "channels", "loads", "reference", "band", "noise_share")
    return replace(rows, **{name: getattr(rows, name)[keep] for name in names})


def response_rows(run: Run, channel_names: tuple[str, ...]) -> ResponseRows | None:
    """Return the rows of a run with known loads, channels in this order; None where it has no load or no sample."""
    if not run.has_loads or run.kind not in ("static", "sweep", "check"):
        return None
    return _static_rows(run, channel_names) if run.kind == "static" else _dynamic_rows(run, channel_names)


def _static_rows(run: Run, channel_names: tuple[str, ...]) -> ResponseRows | None:
    channels, loads = _read(run, channel_names, 0)
    if len(loads) < 2 or not np.ptp(loads, axis=0).any():
        return None
    rows = len(loads)
    index = np.full(rows, -1)
    attitude = attitude_segments(index, None if run.attitude is None else gravity_directions(run.attitude))
    channels, loads = _from_means(channels, attitude), _from_means(loads, attitude)
    return ResponseRows(
        run=run.name,
        kind=run.kind,
        rotor_speed=0.0,
        excited=(),
        frequency=np.zeros(rows),
        channels=channels.astype(complex),
        loads=loads.astype(complex),
        reference=index,
        band=index,
        noise_share=np.zeros(channels.shape),
    )


def _from_means(values: Array, group: Index) -> Array:
    """Return values (m, c) less the mean of their group (m,)."""
    sums = np.zeros((group.max() + 1, values.shape[1]))
    np.add.at(sums, group, values)
    return np.asarray(values - (sums / np.bincount(group)[:, None])[group])


def _read(run: Run, channel_names: tuple[str, ...], start: int) -> tuple[Array, Array]:
    block = run.read(start)
    assert block.loads is not None
    return pick_channels(block.channels, run.channel_names, channel_names), np.nan_to_num(block.loads)


def _dynamic_rows(run: Run, channel_names: tuple[str, ...]) -> ResponseRows | None:
    start = max(int(START_SHARE * run.samples), run.samples - MOST_SAMPLES)
    samples = _fast_length(run.samples - start)
    if samples < FEWEST_SAMPLES:
        return None
    channels, loads = _read(run, channel_names, run.samples - samples)
    Y, U = _spectra(channels), _spectra(loads)
    frequency = np.arange(len(U)) * sample_rate(run) / samples
    bands = np.full(len(U), -1)
    bands[2:] = np.round(np.log(frequency[2:]) / np.log(BAND_RATIO))
    parts = [_band_rows(j, frequency, bands, Y, U) for j in _driving_components(run, U)]
    if not parts:
        return None
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    has_points = run.additions is not None and run.additions.load_points is not None
    by_points = tuple(int(j) for j in np.flatnonzero(np.any(U[2:] != 0, axis=0))) if has_points else ()
    return ResponseRows(run.name, run.kind, run.rotor_speed, run.excited, *columns, by_points=by_points)


def _spectra(signals: Array) -> ComplexArray:
    """Return the windowed spectra (l, c) of signals (n, c), in single precision: comparisons by 1 % need no more.

    Signals count from their first sample, so that single precision loses nothing beside a large mean.
    """
    samples = len(signals)
    window = (np.hanning(samples) * np.sqrt(8.0 / 3.0) / samples).astype(np.float32)
    windowed = np.empty(signals.T.shape, np.float32)
    np.subtract(signals.T, signals[0][:, None], out=windowed, casting="same_kind")
    windowed -= windowed.mean(axis=1, keepdims=True)
    windowed *= window
    return np.asarray(rfft(windowed, axis=1).T)


def _fast_length(samples: int) -> int:
    """Return a length of at most `samples`, and little less, that is quickly transformed."""
    for length in range(samples, max(samples - 512, 1), -1):
        if next_fast_len(length, real=True) == length:
            return length
    return samples


def _driving_components(run: Run, U: ComplexArray) -> list[int]:
    """Return the components that were excited, or all that were measured where none of these was."""
    measured = np.flatnonzero(np.any(U[2:] != 0, axis=0))
    excited = [COMPONENTS.index(name) for name in run.excited]
    return [j for j in excited if j in measured] or [int(j) for j in measured]


def _band_rows(
    j: int, frequency: Array, bands: Index, Y: ComplexArray, U: ComplexArray
) -> tuple[Array, ComplexArray, ComplexArray, Index, Index, Array]:
    """Return frequency, channels, loads, reference, band and noise of the bands in which component j is strong."""
    power = np.abs(U[2:, j].astype(complex)) ** 2
    edges = np.flatnonzero(np.diff(bands[1:]))
    total = np.add.reduceat(power, edges)
    keep = np.flatnonzero(total > LEAST_POWER * total.max())
    keep = keep[np.linspace(0, len(keep) - 1, min(len(keep), MOST_BANDS)).astype(int)]
    # Only the lines from the first to the last of these bands are multiplied.
    first, last = edges[keep[0]], edges[keep[-1] + 1] if keep[-1] + 1 < len(edges) else len(power)
    inside, starts = slice(2 + first, 2 + last), edges[keep[0] : keep[-1] + 1] - first
    reference, bands_inside = U[inside, j].conj(), keep - keep[0]
    scale = 1.0 / np.sqrt(total[keep])

    def averages(spectra: ComplexArray) -> ComplexArray:
        products = spectra[inside].T * reference
        return np.asarray(np.add.reduceat(products, starts, axis=1)[:, bands_inside].T * scale[:, None])

    center = np.add.reduceat(power * frequency[2:], edges)[keep] / total[keep]
    channels = averages(Y)
    noise_share = _noise_energy(Y[inside], U[inside, j], starts)[bands_inside] / np.maximum(np.abs(channels) ** 2, TINY)
    numbers = np.full(len(keep), j), bands[2 + edges[keep]].astype(np.intp)
    return center, channels, averages(U), *numbers, noise_share


def _noise_energy(Y: ComplexArray, u: ComplexArray, starts: Index) -> Array:
    """Return the energy (b, c) of a line of each channel that is not proportional to the load, in bands of lines (l,).

    It is the scatter of the lines of a band, or of NOISE_LINES about its middle, about their mean response to the load.
    """
    lines = len(u)
    ends = np.append(starts[1:], lines)
    wider = np.maximum(NOISE_LINES - (ends - starts), 0)
    first = np.clip(starts - wider // 2, 0, max(lines - NOISE_LINES, 0))
    last = np.minimum(np.maximum(ends, first + NOISE_LINES), lines)
    # Each second sum is that from the end of a window to the start of the next; there is one element behind the last.
    limits = np.column_stack([first, last]).ravel()

    def sums(values: NDArray[np.generic]) -> NDArray[np.complex128]:
        padded = np.concatenate([values, np.zeros((1, *values.shape[1:]), values.dtype)])
        return np.asarray(np.add.reduceat(padded, limits, axis=0)[::2])

    of_load = np.maximum(sums(np.abs(u)[:, None] ** 2), TINY)
    scatter = sums(np.abs(Y) ** 2) - np.abs(sums(Y * u.conj()[:, None])) ** 2 / of_load
    return np.asarray(np.maximum(scatter.real, 0.0) / np.maximum(last - first - 1, 1)[:, None], float)
