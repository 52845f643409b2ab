"""Statistics of the channels of a run by which faults are told, gathered in one pass over its samples."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from balance_cli.campaign.recording.outer_values import EXTREME_VALUES, Integers, merge_extremes, outer_values
from balance_cli.campaign.recording.run import Array, Run, read_channel_rows

BLOCK_SAMPLES = 65536
"""Samples that are read at a time."""


@dataclass
class ChannelStatistics:
    """Statistics of one channel.

    `lowest` and `highest` are the distinct values nearest either end, outermost first, with the number of times that
    each occurs. `current_start` is the first sample of the flatline that is still open.
    """

    samples: int = 0
    nonfinite_count: int = 0
    first_nonfinite: int = -1
    repeated_count: int = 0
    flatline_length: int = 0
    flatline_start: int = 0
    flatline_value: float = np.nan
    lowest: tuple[Array, Integers] = (np.empty(0), np.empty(0, np.int64))
    highest: tuple[Array, Integers] = (np.empty(0), np.empty(0, np.int64))
    turning_points: int = 0
    current_start: int = 0
    last: float = np.nan
    last_direction: float = 0.0
    periods: int = 0

    def add(self, values: Array, is_finite: bool, repeats: bool) -> None:
        """Add the next samples of the channel; whether all are finite, and whether any equals the one before it."""
        if is_finite and not repeats and values[0] != self.last:
            self._add_varying(values)
        else:
            self._add_flatlines(values)
        self._add_extremes(values if is_finite else self._finite_part(values))
        self.samples += len(values)

    def _finite_part(self, values: Array) -> Array:
        """Count the samples that are not finite, and return the others."""
        finite = np.isfinite(values)
        if not self.nonfinite_count:
            self.first_nonfinite = self.samples + int(np.argmin(finite))
        self.nonfinite_count += int((~finite).sum())
        return np.asarray(values[finite])

    def _add_varying(self, values: Array) -> None:
        """Samples without equal neighbors, as in most records: the general case takes four times as long."""
        if not self.flatline_length:
            self.flatline_length, self.flatline_start, self.flatline_value = 1, self.samples, float(values[0])
        falls = values[:-1] > values[1:]
        self.turning_points += int(np.count_nonzero(falls[1:] != falls[:-1]))
        directions = [self.last_direction]
        if not np.isnan(self.last):
            directions.append(-1.0 if self.last > values[0] else 1.0)
        if len(falls):
            directions.append(-1.0 if falls[0] else 1.0)
        self.turning_points += sum(a * b < 0 for a, b in pairwise(directions))
        self.last_direction = directions[-1] if not len(falls) else (-1.0 if falls[-1] else 1.0)
        self.current_start, self.last = self.samples + len(values) - 1, float(values[-1])

    def _add_flatlines(self, values: Array) -> None:
        """Flatlines; the one still open at the end of the last block is continued."""
        starts = np.flatnonzero(values[1:] != values[:-1]) + 1
        is_new = bool(values[0] != self.last)
        self.repeated_count += len(values) - len(starts) - is_new
        begin = 0 if is_new else self.current_start - self.samples
        edges = np.concatenate([[begin], starts, [len(values)]])
        lengths = np.diff(edges)
        longest = int(np.argmax(lengths))
        if lengths[longest] > self.flatline_length:
            self.flatline_length, self.flatline_start = int(lengths[longest]), self.samples + int(edges[longest])
            self.flatline_value = float(values[max(int(edges[longest]), 0)])
        with np.errstate(invalid="ignore", over="ignore"):
            steps = np.concatenate([[values[0] - self.last], values[starts] - values[starts - 1]])
        self._add_turning_points(steps[np.isfinite(steps) & (steps != 0.0)])
        self.current_start, self.last = self.samples + int(edges[-2]), float(values[-1])

    def _add_turning_points(self, steps: Array) -> None:
        """Turning points: steps against the direction of the step before, flatlines skipped."""
        if not len(steps):
            return
        rises = steps > 0.0
        self.turning_points += int(np.count_nonzero(rises[1:] != rises[:-1]))
        self.turning_points += bool(self.last_direction) and (self.last_direction > 0) != bool(rises[0])
        self.last_direction = 1.0 if rises[-1] else -1.0

    def _add_extremes(self, values: Array) -> None:
        new_values, counts = outer_values(values)
        self.lowest = merge_extremes(*self.lowest, new_values[:EXTREME_VALUES], counts[:EXTREME_VALUES])
        self.highest = merge_extremes(
            *self.highest, new_values[-EXTREME_VALUES:], counts[-EXTREME_VALUES:], highest=True
        )


def gather_statistics(run: Run, names: list[str]) -> list[ChannelStatistics]:
    """Return the statistics of these channels of a run."""
    records = [ChannelStatistics() for _ in names]
    for start in range(0, run.samples, BLOCK_SAMPLES):
        samples = read_channel_rows(run, names, start, start + BLOCK_SAMPLES)
        finite = np.asarray(np.isfinite(samples).all(axis=1))
        repeats = np.asarray((samples[:, 1:] == samples[:, :-1]).any(axis=1))
        for record, values, *state in zip(records, samples, finite.tolist(), repeats.tolist(), strict=True):
            record.add(values, *state)
    return records
