"""Run files (`balance-run/1`): the only reader and writer of raw data, whole or in blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Block:
    """Consecutive samples: `start` index, `channels` (m, n_channels) [V], `loads` (m, 6) [N, N m] or None."""

    start: int
    channels: Array
    loads: Array | None


class Source(Protocol):
    """Where the samples of a run come from (a file, or memory)."""

    def read(self, start: int, stop: int) -> Block:
        """Samples start to stop as float64, channels in the order of `Run.channel_names`."""
        ...


@dataclass(frozen=True)
class MemorySource:
    """Samples held in memory."""

    channels: Array
    loads: Array | None

    def read(self, start: int, stop: int) -> Block:
        """Samples start to stop."""
        loads = None if self.loads is None else self.loads[start:stop]
        return Block(start, self.channels[start:stop], loads)


@dataclass(frozen=True)
class Run:
    """One recorded run: what the file says of itself, and its samples on demand.

    `excited` and `level` (rms in N or N m) are parallel tuples; `period` [s] where the excitation is periodic;
    `pulse_times` (n_rev,) [s from the first sample]; `digest` is the hex SHA-256 of the content.
    """

    name: str
    rig: str
    kind: str
    channel_names: tuple[str, ...]
    samples: int
    source: Source = field(repr=False)
    has_loads: bool = True
    sample_rate: float | None = None
    rotor_speed: float = 0.0
    excited: tuple[str, ...] = ()
    excitation: str | None = None
    level: tuple[float, ...] = ()
    period: float | None = None
    trim: str | None = None
    pulse_times: Array | None = field(default=None, repr=False)
    recorded: str | None = None
    note: str | None = None
    path: Path | None = None
    digest: str = ""

    def read(self, start: int = 0, stop: int | None = None) -> Block:
        """Samples start to stop (default: all) as one block."""
        return self.source.read(start, self.samples if stop is None else min(stop, self.samples))

    def blocks(self, size: int = 65536) -> Iterator[Block]:
        """All samples, in blocks of at most `size`."""
        for start in range(0, self.samples, size):
            yield self.read(start, start + size)
