"""Which channels of a run can be used, and why the others cannot: absent, not finite, dead, clipped.

Judged from the samples alone, in one pass over blocks. Two things must not be mistaken for faults: coarse quantisation
of a quiet channel, which repeats values by itself, and a smooth signal, which dwells at its peaks. So both tests for
faults compare a channel with itself.

- Dead for part of the record: one stretch of identical samples far longer than the share p of repeated samples in
  this very channel lets expect; among n independent samples the longest such stretch is about log n / log(1/p) long
  (the longest run of heads; Erdos and Renyi, 1970).
- Clipped: samples at the declared range; where none is declared, the record's extreme is met far more often than the
  values next to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Array, Run, pick_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Channel, Geometry

Integers = NDArray[np.int64]

STRETCH_FACTOR = 5.0
"""How many times the expected longest stretch of identical samples makes a channel dead there."""
DWELL_FACTOR = 2.0
"""How many mean intervals between turning points a stretch must last; at a peak a smooth signal dwells for less."""
LEAST_STRETCH = 20
"""Samples; a shorter stretch of identical samples is never taken for a fault."""
LEAST_ROWS = 3
"""Below as many samples a constant channel is no evidence."""
NEAREST = 8
"""Distinct values kept at either end of a channel's values."""
PLATEAU_FACTOR = 1.5
"""Clipped: the extreme is met so many times as often as all other values kept at that end together.

At the peak of a sine, where values are densest, that ratio is 1 / (sqrt(8) - 1) = 0.55 for eight steps of a converter.
"""
LEAST_PLATEAU = 3
"""Clipped, too: the extreme is met so often in a channel that repeats no other value (load points, say)."""
AT_RANGE = 1.0 - 1e-6
"""Share of the declared range from which a sample is clipped."""


@dataclass(frozen=True)
class ChannelHealth:
    """Channels of a run that can be used, in the geometry's order, and the others with the reason (channel -> text).

    Channels with a high-pass are no part of a static run: there they are in neither.
    """

    live: tuple[str, ...]
    left_out: dict[str, str]


def live_channels(run: Run, geometry: Geometry) -> ChannelHealth:
    """Judge every channel that the geometry declares. Reads all samples of the run, block by block."""
    wanted = [channel for channel in geometry.channels if run.kind != "static" or channel.measures_dc]
    present = [channel for channel in wanted if channel.name in run.channel_names]
    driving = {channel.name: _driving_loads(channel, geometry) for channel in present}
    faults = channel_faults(run, {channel.name: channel.range for channel in present}, driving)
    absent = {channel.name: "absent from the run" for channel in wanted if channel not in present}
    left_out = {channel.name: {**faults, **absent}.get(channel.name, "") for channel in wanted}
    live = tuple(name for name, reason in left_out.items() if not reason)
    return ChannelHealth(live, {name: reason for name, reason in left_out.items() if reason})


def channel_faults(
    run: Run, ranges: Mapping[str, float | None], driving: Mapping[str, tuple[str, ...]] | None = None
) -> dict[str, str]:
    """What is wrong with these channels of the run (name -> range at which it clips [V], if declared): name -> text.

    Sound channels are not in the result. `driving` names the loads that reach a channel (default: all): in a static
    run a channel may stand still as long as these do.
    """
    records = dict(zip(ranges, _records(run, list(ranges)), strict=True))
    faults = {}
    for name, record in records.items():
        components = COMPONENTS if driving is None else driving[name]
        faults[name] = _fault(record, ranges[name], _may_stand_still(run, record, components))
    return {name: fault for name, fault in faults.items() if fault}


def _driving_loads(channel: Channel, geometry: Geometry) -> tuple[str, ...]:
    """With a torque meter Mz goes through it alone, and the other loads through the cells alone."""
    if geometry.torque_meter is None:
        return COMPONENTS
    return tuple(name for name in COMPONENTS if (name == "Mz") == channel.torque_meter)


def _may_stand_still(run: Run, record: _Record, components: tuple[str, ...]) -> bool:
    """Whether the loads that reach a channel stood still during its longest stretch of identical load points."""
    if run.kind != "static" or record.stretch < LEAST_ROWS:
        return False
    loads = run.read(record.stretch_start, record.stretch_start + record.stretch).loads
    columns = [COMPONENTS.index(name) for name in components]
    return loads is not None and not np.ptp(loads[:, columns], axis=0).any()


# ---- what one pass gathers of a channel ------------------------------------------------------------------------------


@dataclass
class _Record:
    """What one pass gathers of one channel.

    `lowest` and `highest` are the distinct values nearest either end, outermost first, with how often each was met.
    """

    samples: int = 0
    not_finite: int = 0
    first_not_finite: int = -1
    repeats: int = 0
    stretch: int = 0
    stretch_start: int = 0
    stretch_value: float = np.nan
    lowest: tuple[Array, Integers] = (np.empty(0), np.empty(0, np.int64))
    highest: tuple[Array, Integers] = (np.empty(0), np.empty(0, np.int64))
    turns: int = 0
    open_start: int = 0
    last: float = np.nan
    rising: float = 0.0

    def add(self, values: Array) -> None:
        """Take the next samples of the channel into account."""
        finite = np.isfinite(values)
        if not finite.all():
            if not self.not_finite:
                self.first_not_finite = self.samples + int(np.argmin(finite))
            self.not_finite += int((~finite).sum())
        self._add_stretches(values)
        self._add_extremes(values[finite])
        self.samples += len(values)

    def _add_stretches(self, values: Array) -> None:
        """Stretches of identical samples, the one still open at the end of the last block continued."""
        new = np.r_[values[0] != self.last, values[1:] != values[:-1]]
        self.repeats += int((~new).sum())
        starts = self.samples + np.flatnonzero(new)
        if not new[0]:
            starts = np.r_[self.open_start, starts]
        lengths = np.diff(np.r_[starts, self.samples + len(values)])
        longest = int(np.argmax(lengths))
        if lengths[longest] > self.stretch:
            self.stretch, self.stretch_start = int(lengths[longest]), int(starts[longest])
            self.stretch_value = float(values[max(self.stretch_start - self.samples, 0)])
        with np.errstate(invalid="ignore"):
            steps = np.diff(np.r_[self.last, values])
        self._add_turns(steps)
        self.open_start, self.last = int(starts[-1]), float(values[-1])

    def _add_turns(self, steps: Array) -> None:
        """Turning points: steps against the direction of the step before, stretches of identical samples skipped."""
        directions = np.r_[self.rising, np.sign(steps[np.isfinite(steps) & (steps != 0.0)])]
        self.turns += int((directions[1:] * directions[:-1] < 0).sum())
        self.rising = float(directions[-1])

    def _add_extremes(self, values: Array) -> None:
        found, counts = np.unique(values, return_counts=True)
        self.lowest = _outermost(*self.lowest, found[:NEAREST], counts[:NEAREST])
        self.highest = _outermost(*self.highest, found[-NEAREST:], counts[-NEAREST:], highest=True)


def _outermost(
    known: Array, known_counts: Integers, found: Array, found_counts: Integers, highest: bool = False
) -> tuple[Array, Integers]:
    """The distinct values nearest one end among known and found ones, outermost first, with their summed counts."""
    values, place = np.unique(np.r_[known, found], return_inverse=True)
    counts = np.bincount(place, np.r_[known_counts, found_counts], len(values)).astype(np.int64)
    order = slice(None, -NEAREST - 1, -1) if highest else slice(NEAREST)
    return values[order], counts[order]


def _records(run: Run, names: list[str]) -> list[_Record]:
    records = [_Record() for _ in names]
    for block in run.blocks():
        samples = pick_channels(block.channels, run.channel_names, names)
        for record, values in zip(records, samples.T, strict=True):
            record.add(values)
    return records


# ---- what is wrong with it -------------------------------------------------------------------------------------------


def _fault(record: _Record, limit: float | None, may_stand_still: bool) -> str:
    """Why a channel cannot be used, or nothing."""
    if may_stand_still:
        return _not_finite(record) or _clipped(record, limit)
    return _not_finite(record) or _constant(record) or _clipped(record, limit) or _dead_in_part(record)


def _not_finite(record: _Record) -> str:
    if not record.not_finite:
        return ""
    share = f"{record.not_finite} of {record.samples} samples"
    return f"not finite: {share}, the first is sample {record.first_not_finite}"


def _constant(record: _Record) -> str:
    constant = record.samples >= LEAST_ROWS and record.stretch == record.samples
    return f"dead: constant at {record.stretch_value:.6g} V" if constant else ""


def _dead_in_part(record: _Record) -> str:
    if not _stands_still(record):
        return ""
    first, last = record.stretch_start, record.stretch_start + record.stretch - 1
    return f"dead for part of the record: constant at {record.stretch_value:.6g} V from sample {first} to {last}"


def _stands_still(record: _Record) -> bool:
    return record.samples >= LEAST_ROWS and record.stretch > _longest_credible_stretch(record)


def _longest_credible_stretch(record: _Record) -> float:
    """Samples; at most half the record, since a channel that mostly stands still measures nothing either."""
    share = np.clip(record.repeats / (record.samples - 1), 1e-9, 1.0 - 1e-9)
    expected = np.log(record.samples) / -np.log(share)
    interval = record.samples / (record.turns + 1)
    credible = max(STRETCH_FACTOR * expected, DWELL_FACTOR * interval)
    return float(max(LEAST_STRETCH, min(credible, record.samples / 2)))


def _clipped(record: _Record, limit: float | None) -> str:
    for values, counts in (record.lowest, record.highest):
        extreme, times = float(values[0]), int(counts[0])
        if limit is not None and abs(extreme) >= AT_RANGE * limit:
            return f"clipped: reaches {extreme:.6g} V, its range is {limit:g} V"
        one_stretch = _stands_still(record) and record.stretch_value == extreme and 2 * record.stretch >= times
        if extreme != 0.0 and _is_plateau(record, counts) and not one_stretch:
            return f"clipped: {times} samples at its extreme of {extreme:.6g} V"
    return ""


def _is_plateau(record: _Record, counts: Integers) -> bool:
    """Whether the extreme (first count) stands out among its neighbours, in a channel of enough distinct values."""
    if len(counts) < NEAREST or record.highest[0][-1] <= record.lowest[0][-1]:
        return False
    only_there = 0 < record.repeats < counts[0] and counts[1:].max() == 1
    return bool(counts[0] > PLATEAU_FACTOR * counts[1:].sum() or (only_there and counts[0] >= LEAST_PLATEAU))
