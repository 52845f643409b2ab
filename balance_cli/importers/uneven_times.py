"""Samples at uneven times, as programs log them that wait between readings, interpolated to even steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers.base import Array, ChannelGroup

STEP_TOLERANCE = 0.02
"""Of the median step: the jitter of a timer is below 1 %, that of a loop in software 5 to 50 %."""
UNEVEN_SHARE = 0.1
"""Of all steps that differ by more, from which the times are uneven throughout: a record with gaps has even steps."""
LONGEST_STEP = 5.0
"""Median steps; a longer one is a gap, across which nothing is known."""
EQUAL_RATES = 1.1
"""Ratio of the mean rate to the wanted one up to which no filter is needed in between: what could alias is at the upper
end of the band, where the cubic is wrong anyway."""
MOST_REPEATED = 0.1
"""Of the rows that have the time of the row above; with more of them the rows are those of several sensors."""
NODES = 4
"""Samples of a cubic. A sine at a tenth of the rate has an error of 0.3 % rms, one at a fifth 4.5 %, in steps that
differ by 30 %."""


@dataclass(frozen=True)
class EvenedGroup:
    """A group at even steps, and what to tell of it."""

    group: ChannelGroup
    note: str


def are_uneven(steps: Array) -> bool:
    """Whether steps (n,) differ throughout, with no gap among them."""
    median = float(np.median(steps))
    if not (steps.min() > 0.0 and steps.max() <= LONGEST_STEP * median):
        return False
    return bool(np.mean(np.abs(steps - median) > STEP_TOLERANCE * median) > UNEVEN_SHARE)


def evened_group(group: ChannelGroup, times: Array, wanted: float) -> EvenedGroup | None:
    """A group whose samples are at uneven times (n,) [s], at even steps for a run file of a `wanted` rate [Hz].

    Of rows with one time the first is taken. None where the times are even, have gaps or do not increase. The rate is
    the wanted one or, where that is lower than the mean rate, a multiple of it that leaves room for a filter.
    """
    rows = np.flatnonzero(np.diff(times, prepend=-np.inf) != 0.0)
    repeated = len(times) - len(rows)
    times = times[rows] if repeated <= MOST_REPEATED * len(times) else times
    steps = np.diff(times)
    if len(times) < NODES or not np.isfinite(times).all() or not are_uneven(steps):
        return None
    mean = (len(times) - 1) / float(times[-1] - times[0])
    rate = wanted * (1 if mean <= EQUAL_RATES * wanted else math.ceil(mean / wanted))
    samples = math.floor((times[-1] - times[0]) * rate) + 1

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        at = times[0] + np.arange(start, stop) / rate
        first = np.clip(np.searchsorted(times, at, side="right") - NODES // 2, 0, len(times) - NODES)
        if not len(at):
            return np.empty((0, len(columns)))
        begin, end = int(first.min()), int(first.max()) + NODES
        nodes = (first - begin)[:, None] + np.arange(NODES)
        kept = rows[begin:end]
        values = group.read(columns, int(kept[0]), int(kept[-1]) + 1)[kept - kept[0]][nodes]
        return np.asarray(np.einsum("nk,nkc->nc", _cubic_weights(times[begin + nodes], at), values))

    note = (
        f"samples at uneven times ({steps.min():.3g} to {steps.max():.3g} s apart, {mean:.4g} Hz in the mean) were "
        f"interpolated to {rate:.10g} Hz: above {mean / NODES / 2:.3g} Hz the channels are not reliable"
    )
    if repeated:
        note += f"; {repeated} of {len(times) + repeated} rows have the time of the row above, and were left out"
    return EvenedGroup(replace(group, rate=rate, start=float(times[0]), samples=samples, read=read), note)


def _cubic_weights(nodes: Array, at: Array) -> NDArray[np.float64]:
    """Weights (n, k) of the samples at `nodes` (n, k) for Lagrange's polynomial through them, at the times (n,)."""
    weights = np.ones_like(nodes)
    for k in range(NODES):
        for other in range(NODES):
            if other != k:
                weights[:, k] *= (at - nodes[:, other]) / (nodes[:, k] - nodes[:, other])
    return weights
