"""The time base of an imported run: channel groups of different rates and starts, aligned in their common part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from balance_cli.importers.base import ChannelGroup
from balance_cli.io.errors import UserError
from balance_cli.signals.resampling import PASSBAND, LinearInterpolator, Resampler, kernel_half_length

LARGEST_INTERPOLATION = 100.0
"""Rate of the run files over the highest rate of the channels: more adds samples, and nothing that was measured."""
EQUAL_PLACE = 1e-3
"""Samples by which two grids may differ and still be one: 0.2 deg of phase at half the rate, nothing below."""


@dataclass(frozen=True)
class Clock:
    """Rate [Hz], time of the first sample [s] and number of samples of a channel group."""

    rate: float
    start: float
    samples: int

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self.start + (self.samples - 1) / self.rate


@dataclass(frozen=True)
class Timeline:
    """Common samples of all groups: rate [Hz], time of the first [s] and their number.

    `interpolated` are the clocks of slow quantities, which are interpolated linearly.
    """

    rate: float
    start: float
    samples: int
    interpolated: frozenset[Clock] = frozenset()

    def is_direct(self, clock: Clock) -> bool:
        """Whether the samples of a group are those of the timeline, from some sample on."""
        return same_rate(clock, self.rate) and _is_whole((self.start - clock.start) * self.rate)

    def first_sample(self, clock: Clock) -> int:
        """The sample of a direct group at which the timeline begins."""
        return round((self.start - clock.start) * self.rate)

    def resampler(self, group: ChannelGroup, clock: Clock, columns: Sequence[int]) -> Resampler | LinearInterpolator:
        """A reader of a group at the rate of the timeline."""

        def read(start: int, stop: int) -> object:
            return group.read(columns, start, min(stop, clock.samples))

        start = self.start - clock.start
        if clock in self.interpolated:
            return LinearInterpolator(read, clock.rate, self.rate, start, clock.samples)  # type: ignore[arg-type]
        return Resampler(read, clock.rate, self.rate, start, self.samples)  # type: ignore[arg-type]


def same_rate(clock: Clock, rate: float) -> bool:
    """Whether a rate is that of the group to within rounding over its length."""
    return abs(clock.rate - rate) / rate * clock.samples < EQUAL_PLACE


def common_timeline(clocks: Sequence[Clock], rate: float | None, slow: Sequence[Clock]) -> Timeline:
    """The time base in which all groups have samples: at `rate`, or the lowest rate of `clocks`.

    The lowest rate is that at which no channel lacks the upper part of its band. `slow` are the clocks of quantities
    that the signals are not made of, temperatures and supplies: they do not set the rate, and below it they are
    interpolated linearly, each end held for one of their steps, so that they do not shorten the record.
    Raises UserError where the groups have no common part.
    """
    target = min(clock.rate for clock in clocks) if rate is None else rate
    fastest = max(clock.rate for clock in clocks)
    if target > LARGEST_INTERPOLATION * fastest:
        fault = f"{target:g} Hz is more than {LARGEST_INTERPOLATION:g} times the highest rate, {fastest:g} Hz"
        raise UserError(fault, place="resample", remedy="Give a lower rate")
    below = {clock for clock in slow if clock.rate < target and not same_rate(clock, target)}
    interpolated = frozenset(below - set(clocks))
    every = [*clocks, *slow]
    anchor = next((clock for clock in every if same_rate(clock, target)), None)
    origin = clocks[0].start if anchor is None else anchor.start

    def margin_of(clock: Clock) -> float:
        if clock in interpolated:
            return -1.0 / clock.rate
        is_on_grid = same_rate(clock, target) and _is_whole((clock.start - origin) * target)
        return 0.0 if is_on_grid else kernel_half_length(clock.rate, target)

    margins = [margin_of(clock) for clock in every]
    begin = max(clock.start + margin for clock, margin in zip(every, margins, strict=True))
    end = min(clock.end - margin for clock, margin in zip(every, margins, strict=True))
    first = math.ceil((begin - origin) * target - EQUAL_PLACE)
    samples = math.floor((end - origin) * target + EQUAL_PLACE) - first + 1
    if samples < 2:
        raise _too_short(max(zip(margins, every, strict=True), key=lambda item: item[0])[1], target)
    return Timeline(target, origin + first / target, samples, interpolated)


def _too_short(short: Clock, target: float) -> UserError:
    slow = f"{short.rate:.6g} Hz"
    fault = (
        f"{short.samples} samples at {slow} are too few to be brought to {target:.6g} Hz with the other channels: "
        "resampling needs some before and behind the part that is kept"
    )
    remedy = f"Leave the channels at {slow} out of the map, import them as another run, or record longer"
    return UserError(fault, place="time", remedy=remedy)


def timeline_notes(timeline: Timeline, groups: Sequence[tuple[Sequence[str], Clock]]) -> list[str]:
    """What the alignment did: channels that were resampled, and what was cut."""
    notes = []
    for names, clock in groups:
        if timeline.is_direct(clock):
            continue
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        if clock in timeline.interpolated:
            rates = f"from {clock.rate:.10g} Hz to {timeline.rate:.10g} Hz"
            notes.append(f"{shown}: interpolated linearly {rates}, the channels that measure loads set the rate")
            continue
        band = 0.5 * PASSBAND * min(clock.rate, timeline.rate)
        what = "shifted" if same_rate(clock, timeline.rate) else f"resampled from {clock.rate:.10g} Hz"
        notes.append(
            f"{shown}: {what} to {timeline.rate:.10g} Hz, band-limited, sound up to {band:.4g} Hz, no phase shift"
        )
    longest = max(clock.samples / clock.rate for _, clock in groups)
    duration = timeline.samples / timeline.rate
    if duration < longest - 1.5 / timeline.rate:
        notes.append(f"the common part of the channels is kept: {duration:.6g} s of {longest:.6g} s")
    return notes


def _is_whole(value: float) -> bool:
    return abs(value - round(value)) < EQUAL_PLACE
