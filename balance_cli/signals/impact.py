"""Records of an impact hammer: its hits, double hits, and loads of a hammer that are declared as something else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

IMPACT = "impact"
ZERO_SHARE = 0.01
"""Of the largest load: less counts as no load. Of Gaussian noise one sample in forty is so small, and of a hammer
nearly all are, its noise included."""
SHORT_SHARE = 0.05
"""Share of the samples with a load below which a record consists of hits. Hits of 10 ms in frames of 0.5 s fill 2 %."""
HIT_SHARE = 0.1
"""Of the largest load, from which a peak is a hit: the rebound of a double hit is larger, ringing is smaller."""
DOUBLE_INTERVAL = 0.15
"""[s] between two hits that are one tap which bounced; nobody taps twice so fast."""


@dataclass(frozen=True)
class Hits:
    """Hits of a record: times of their peaks [s], and which of them follow another within DOUBLE_INTERVAL."""

    times: Array
    is_double: NDArray[np.bool_]

    @property
    def note(self) -> str:
        """What to tell of them."""
        taps, doubles = int(np.sum(~self.is_double)), int(np.sum(self.is_double))
        text = f"{taps} taps of the hammer"
        if not doubles:
            return text
        first = float(self.times[self.is_double][0])
        times = "once" if doubles == 1 else f"{doubles} times"
        return f"{text}, which bounced {times} (first at {first:.4g} s): the force has notches there"


def has_short_hits(load: Array) -> bool:
    """Whether a load (n,) is zero but for short hits."""
    size = np.abs(load - np.median(load))
    largest = float(size.max(initial=0.0))
    return largest > 0.0 and float(np.mean(size > ZERO_SHARE * largest)) < SHORT_SHARE


def find_hits(load: Array, rate: float) -> Hits:
    """Find the hits in a load (n,) that was sampled at `rate` [Hz]."""
    size = np.abs(load - np.median(load))
    above = np.concatenate([[False], size > HIT_SHARE * float(size.max(initial=0.0)), [False]])
    edges = np.flatnonzero(np.diff(above.astype(int)))
    peaks = [start + int(np.argmax(size[start:stop])) for start, stop in zip(edges[::2], edges[1::2], strict=True)]
    times = np.array(peaks, float) / rate
    return Hits(times, np.concatenate([[False], np.diff(times) < DOUBLE_INTERVAL])[: len(times)])
