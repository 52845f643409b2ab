"""Which channels of a run can be used, and why the others cannot: absent, not finite, not plausible, dead, clipped.

The tests use the samples alone, in one pass over blocks. Two things must not be mistaken for faults: coarse
quantization of a quiet channel, which repeats values, and a smooth signal, which dwells at its peaks. The tests for
dead and clipped channels therefore compare a channel with itself.

- Dead for part of the record: a flatline, a stretch of identical samples, is far longer than expected from the share p
  of repeated samples in the same channel. Among n independent samples the longest such stretch is about
  log n / log(1/p) long (the longest run of heads; Erdos and Renyi, 1970).
- Clipped: samples reach the declared range; where none is declared, the extreme value of the record occurs far more
  often than the values next to it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.recording.channel_statistics import ChannelStatistics, gather_statistics
from balance_cli.campaign.recording.outer_values import EXTREME_VALUES, Integers
from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE, Run, read_channel_rows
from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import carried_components

FLATLINE_FACTOR = 5.0
"""Length of a flatline that makes a channel dead, over the expected longest one.

The length of the longest run scatters by about 1 / log(1/p), a fraction 1 / log n of its mean: a tenth for 20 000
samples. Five times the mean leaves room for samples that are not independent.
"""
PEAK_DWELL_FACTOR = 2.0
"""Length of a flatline that makes a channel dead, over the mean interval between turning points.

At a peak a smooth signal dwells for less than one such interval.
"""
LEAST_FLATLINE = 20
"""Samples. A shorter flatline is never a fault: no sensor fails and recovers within so few samples."""
RECORD_ENDED = ", as all channels are: the recording seems to have ended there, cut the record"
LARGEST_END_SPREAD = 10
"""Samples between the last changes of channels that end together; the last values of some may be zeros by chance."""
LEAST_SAMPLES = 3
"""Samples below which a constant channel proves nothing: two load points may well have equal readings."""
PLATEAU_FACTOR = 1.5
"""A channel is clipped where its extreme occurs so many times as often as the other values counted at its end.

At the peak of a sine, where values are densest, that ratio is 1 / (sqrt(8) - 1) = 0.55 for eight steps of a converter.
The limit is about three times that, and LEAST_PLATEAU more, because a few coarse samples at a peak may coincide.
"""
LEAST_PLATEAU = 3
"""A channel that repeats no other value (load points, say) is clipped where its extreme occurs so often, and more often
than its excitation repeats itself: without noise each period has the same peak."""
COMPARED_FIRST = 64
"""Samples by which copies of a channel are sought: noise makes no two channels equal in so many."""
BLOCK = 65536
"""Samples that are compared at a time."""
REST_SHARE = 0.1
"""Loads at the start of a record, over the largest, up to which it begins at rest: a hundredth of the power is lost."""
SMALLEST_PEAK = 1e-60
"""Volts below which no channel stays throughout; the fourth power is still a number, and rounding leaves far more."""
AT_RANGE = 1.0 - 1e-6
"""Share of the declared range from which a sample is clipped; the margin is that of rounding to float32."""


@dataclass(frozen=True)
class ChannelHealth:
    """Channels of a run that can be used, in the order of the geometry, and the others with the reason.

    In a static run channels with a high-pass are in neither.
    """

    live: tuple[str, ...]
    left_out: dict[str, str]

    def without(self, reasons: Mapping[str, str]) -> ChannelHealth:
        """Return the health with further channels left out, each for its reason; one that is out keeps its own."""
        further = {name: reason for name, reason in reasons.items() if name in self.live}
        return ChannelHealth(tuple(name for name in self.live if name not in further), {**self.left_out, **further})


def live_channels(run: Run, geometry: Geometry) -> ChannelHealth:
    """Test every channel that the geometry declares. Reads all samples of the run, block by block."""
    declared = [channel for channel in geometry.channels if run.kind != "static" or channel.measures_dc]
    present = [channel for channel in declared if channel.name in run.channel_names]
    driving_loads = {channel.name: _loads_through_channel(channel, geometry) for channel in present}
    faults = channel_faults(run, {channel.name: channel.range for channel in present}, driving_loads)
    if run.kind in ("check", "wind"):
        faults = {**_silent_faults(run, geometry, present), **faults}
    if run.kind == "wind":
        faults = {**_copies(run, {channel.name: channel.source for channel in present}), **faults}
    absent = {channel.name: "absent from the run" for channel in declared if channel.name not in run.channel_names}
    left_out = {channel.name: {**faults, **absent}.get(channel.name, "") for channel in declared}
    live = tuple(name for name, reason in left_out.items() if not reason)
    return ChannelHealth(live, {name: reason for name, reason in left_out.items() if reason})


def channel_faults(
    run: Run, ranges: Mapping[str, float | None], driving_loads: Mapping[str, tuple[str, ...]] | None = None
) -> dict[str, str]:
    """Return the faults of these channels of the run (name -> text); sound channels are not in the result.

    `ranges` maps each name to the range at which the channel clips [V], None where that is not declared.
    `driving_loads` maps it to the loads that reach the channel (default: all): in a static run a channel may be
    constant as long as these are.
    """
    records = dict(zip(ranges, gather_statistics(run, list(ranges)), strict=True))
    faults = {}
    for name, record in records.items():
        record.periods = _whole_periods(run)
        components = COMPONENTS if driving_loads is None else driving_loads[name]
        fault = _channel_fault(record, ranges[name], _may_be_constant(run, record, components))
        faults[name] = fault or run.held.get(name, "")
    ended = RECORD_ENDED if run.kind != "static" and _end_together(list(records.values())) else ""
    return {name: fault + ended for name, fault in faults.items() if fault}


def _end_together(records: Sequence[ChannelStatistics]) -> bool:
    """Whether all channels are constant from about one sample to the last: programs fill a fixed length with zeros."""
    if len(records) < 2 or not all(_has_flatline(record) and record.flatline_start > 0 for record in records):
        return False
    starts = [record.flatline_start for record in records]
    to_end = all(record.flatline_start + record.flatline_length == record.samples for record in records)
    return to_end and max(starts) - min(starts) <= LARGEST_END_SPREAD


def _copies(run: Run, sources: Mapping[str, str]) -> dict[str, str]:
    """Return the channels that are equal to one of another sensor in every sample: one of the two was not recorded."""
    first = read_channel_rows(run, list(sources), 0, COMPARED_FIRST)
    groups: dict[bytes, list[str]] = {}
    for name, samples in zip(sources, first, strict=True):
        if np.ptp(samples) > 0.0:
            groups.setdefault(samples.tobytes(), []).append(name)
    copies: dict[str, str] = {}
    for names in groups.values():
        if len({sources[name] for name in names}) < 2 or not _are_equal(run, names):
            continue
        copies |= {a: f"equal to {next(b for b in names if b != a)} in every sample" for a in names}
    return copies


def _are_equal(run: Run, names: list[str]) -> bool:
    parts = (read_channel_rows(run, names, start, start + BLOCK) for start in range(0, run.samples, BLOCK))
    return all(bool(np.all((rows == rows[0]) | np.isnan(rows))) for rows in parts)


def _whole_periods(run: Run) -> int:
    """How often the excitation repeats itself, 0 where it does not."""
    return int(run.samples / (run.sample_rate * run.period)) if run.period and run.sample_rate else 0


def _loads_through_channel(channel: Channel, geometry: Geometry) -> tuple[str, ...]:
    """Components that reach a channel: a moment through a shaft its torque meters, and the plate that carries it."""
    if channel.torque_meter:
        named = channel.torque_meter
        return tuple(meter.component for meter in geometry.shaft_meters if named is True or meter.name == named)
    beside = {meter.component for meter in geometry.shaft_meters if meter.carried_by == "ground"}
    return tuple(name for name in COMPONENTS if name not in beside)


def _may_be_constant(run: Run, record: ChannelStatistics, components: tuple[str, ...]) -> bool:
    """Whether the loads that reach a channel are constant, or have hardly begun, during its longest flatline."""
    length = record.flatline_length
    if run.kind != "static":
        return record.flatline_start == 0 and _has_flatline(record) and _begins_at_rest(run, length)
    loads = run.read(record.flatline_start, record.flatline_start + length).loads if length >= LEAST_SAMPLES else None
    columns = [COMPONENTS.index(name) for name in components]
    return loads is not None and not np.ptp(loads[:, columns], axis=0).any()


def _begins_at_rest(run: Run, samples: int) -> bool:
    """Whether the loads of the first samples are small: steps of a coarse converter may hide the response to them."""
    first = run.read(0, samples).loads
    if first is None or 2 * samples > run.samples:
        return False
    sizes = [np.max(np.abs(block.loads), axis=0) for block in run.blocks() if block.loads is not None]
    return bool(np.all(np.max(np.abs(first), axis=0) <= REST_SHARE * np.max(sizes, axis=0)))


# ---- faults ----------------------------------------------------------------------------------------------------------


def _channel_fault(record: ChannelStatistics, limit: float | None, may_be_constant: bool) -> str:
    """Why a channel cannot be used; empty where it can."""
    fault = _nonfinite_fault(record) or _magnitude_fault(record)
    if may_be_constant:
        return fault or _clipping_fault(record, limit)
    return fault or _constant_fault(record) or _clipping_fault(record, limit) or _flatline_fault(record)


def _nonfinite_fault(record: ChannelStatistics) -> str:
    if not record.nonfinite_count:
        return ""
    share = f"{record.nonfinite_count} of {record.samples} samples"
    return f"not finite: {share}, the first is sample {record.first_nonfinite}, more than can be bridged"


def _magnitude_fault(record: ChannelStatistics) -> str:
    extremes = [float(values[0]) for values, _ in (record.lowest, record.highest) if len(values)]
    peak = max(extremes, key=abs, default=0.0)
    if 0.0 < abs(peak) < SMALLEST_PEAK:
        return f"not plausible: never exceeds {abs(peak):.6g} V"
    return f"not plausible: reaches {peak:.6g} V" if abs(peak) > LARGEST_MAGNITUDE else ""


def _constant_fault(record: ChannelStatistics) -> str:
    constant = record.samples >= LEAST_SAMPLES and record.flatline_length == record.samples
    return f"dead: constant at {record.flatline_value:.6g} V" if constant else ""


def _flatline_fault(record: ChannelStatistics) -> str:
    if not _has_flatline(record):
        return ""
    first, last = record.flatline_start, record.flatline_start + record.flatline_length - 1
    return f"dead for part of the record: constant at {record.flatline_value:.6g} V from sample {first} to {last}"


def _has_flatline(record: ChannelStatistics) -> bool:
    return record.samples >= LEAST_SAMPLES and record.flatline_length > _longest_plausible_flatline(record)


def _silent_faults(run: Run, geometry: Geometry, channels: Sequence[Channel]) -> dict[str, str]:
    """Return the channels that fall silent while the others do not, and how long.

    One that does so to the end of the record, and that the loads need, is left to the tests of steadiness.
    """
    from balance_cli.campaign.recording.silent_segment import silent_segments  # runs with a rotor alone need it

    sources = {item.name: item.source for item in channels}
    segments = silent_segments(run, list(sources))
    others = {source for name, source in sources.items() if name not in segments}
    is_needed = len(others) < len(carried_components(geometry))
    return {
        name: f"dead for part of the record: noise alone from sample {first} to {last}, while other channels go on"
        for name, (first, last) in segments.items()
        if not is_needed or last < run.samples - 1
    }


def _longest_plausible_flatline(record: ChannelStatistics) -> float:
    """Samples; at most half the record, since a channel that is constant for most of it measures nothing either."""
    share = min(max(record.repeated_count / (record.samples - 1), 1e-9), 1.0 - 1e-9)
    expected = math.log(record.samples) / -math.log(share)
    interval = record.samples / (record.turning_points + 1)
    plausible = max(FLATLINE_FACTOR * expected, PEAK_DWELL_FACTOR * interval)
    return max(LEAST_FLATLINE, min(plausible, record.samples / 2))


def _clipping_fault(record: ChannelStatistics, limit: float | None) -> str:
    for values, counts in (record.lowest, record.highest):
        extreme, times = float(values[0]), int(counts[0])
        if limit is not None and abs(extreme) >= AT_RANGE * limit:
            return f"clipped: reaches {extreme:.6g} V, its range is {limit:g} V"
        in_flatline = _has_flatline(record) and record.flatline_value == extreme and 2 * record.flatline_length >= times
        if extreme != 0.0 and _is_clipping_plateau(record, extreme, counts) and not in_flatline:
            return f"clipped: {times} samples at its extreme of {extreme:.6g} V"
    return ""


def _is_clipping_plateau(record: ChannelStatistics, extreme: float, counts: Integers) -> bool:
    """Whether the extreme (first count) stands out among its neighbors, in a channel of enough distinct values."""
    if len(counts) < EXTREME_VALUES or record.highest[0][-1] <= record.lowest[0][-1]:
        return False
    only_there = record.flatline_value == extreme and 0 < record.repeated_count < counts[0] and counts[1:].max() == 1
    plateau = counts[0] > PLATEAU_FACTOR * counts[1:].sum() + LEAST_PLATEAU
    return bool(plateau or (only_there and counts[0] >= max(LEAST_PLATEAU, record.periods + 1)))
