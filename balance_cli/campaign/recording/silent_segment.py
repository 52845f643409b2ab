"""Channels that fall silent for a part of a record, with the noise of their amplifier: a cable off, a switch, a range.

A flatline has no noise, and is told by equal samples. Here the scatter of a channel within each revolution is compared
with that in the other revolutions, and with what the other channels do meanwhile: a rotor that stops, or a load that
ends, makes several channels quiet. As a signal, a channel of zero volts for a fifth of a record reads a fifth less of
all loads, and that was taken for a gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from balance_cli.campaign.recording.run import Array, Run, read_channel_rows

SILENT = 0.03
"""Scatter of a revolution over that of the loud ones, below which a channel is silent: a load that reaches a cell of a
rigid plate reaches others."""
LOUD_LEVEL = 0.9
"""Quantile of the scatter of the revolutions that counts as loud."""
OTHERS_LOUD = 0.3
"""The same of the median of the other channels, from which these are not silent."""
STEADY = 0.3
"""Least scatter of the loud revolutions over their usual one: a channel that comes and goes by gusts is sound."""
LEAST_WINDOWS = 2
"""Revolutions in a row: within one the beginning and the end of a segment fall."""
FEWEST_WINDOWS = 8
FEWEST_CHANNELS = 3
BLOCK = 65536
"""Samples that are read at a time."""


def silent_segments(run: Run, names: Sequence[str]) -> Mapping[str, tuple[int, int]]:
    """Return the longest segment (first and last sample) in which each channel is silent and the others are not."""
    if run.kind not in ("check", "wind") or not run.rotor_speed or not run.sample_rate:
        return {}
    window = max(int(run.sample_rate / run.rotor_speed), 2)
    if len(names) < FEWEST_CHANNELS or run.samples < FEWEST_WINDOWS * window:
        return {}
    scatter = _window_scatter(run, names, window)
    loud = np.quantile(scatter, LOUD_LEVEL, axis=0)
    relative = scatter / np.where(loud > 0.0, loud, np.inf)
    found = {}
    for k, name in enumerate(names):
        silent = (relative[:, k] < SILENT) & (loud[k] > 0.0)
        if np.count_nonzero(silent) < LEAST_WINDOWS or np.quantile(relative[~silent, k], 1.0 - LOUD_LEVEL) < STEADY:
            continue
        silent &= np.median(np.delete(relative, k, axis=1), axis=1) > OTHERS_LOUD
        edges = np.flatnonzero(np.diff(np.concatenate([[False], silent, [False]]).astype(np.int8)))
        first, last = max(zip(edges[::2], edges[1::2], strict=True), key=lambda ends: ends[1] - ends[0], default=(0, 0))
        if last - first >= LEAST_WINDOWS:
            # The revolutions at its ends are silent in part.
            found[name] = max(int(first - 1) * window, 0), min(int(last + 1) * window, run.samples) - 1
    return found


def _window_scatter(run: Run, names: Sequence[str], window: int) -> Array:
    """Return the standard deviation (w, c) of the channels in windows of so many samples, NaN as zero."""
    step = max(BLOCK // window, 1) * window
    parts = []
    for start in range(0, run.samples // window * window, step):
        rows = read_channel_rows(run, names, start, min(start + step, run.samples // window * window))
        parts.append(np.nan_to_num(rows).reshape(len(names), -1, window).std(axis=2).T)
    return np.concatenate(parts)
