"""The rotor reference of an imported run, on its time base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.import_map import MappedRotor
from balance_cli.io.errors import UserError
from balance_cli.io.units import FREQUENCY, parse_unit
from balance_cli.signals.rotor.low_pass_lag import AnalogLowPass
from balance_cli.signals.rotor.tachometer import (
    RotorReference,
    TachometerSettings,
    read_rotor_reference,
)
from balance_cli.steps.import_channels import FoundChannel
from balance_cli.steps.import_signals import ChannelFinder
from balance_cli.steps.import_timeline import Timeline

Array = NDArray[np.float64]

LARGEST_CLOCK_ERROR = 0.2
"""Samples by which the median of pulses may differ between two files: a box that starts by itself is off by more in
three cases of five, the edge of a mark that two converters sampled by less than 0.1 (manual, table of tachometers)."""


def rotor_reference(finder: ChannelFinder, rotor: MappedRotor, timeline: Timeline, place: str) -> RotorReference:
    """The 1/rev pulses from the first sample of the run on. Raises UserError where they cannot be found."""
    source = finder.find(rotor.channel)
    reference = _reference_of(source, finder, rotor, timeline, place)
    for other in finder.namesakes(source) if rotor.kind != "times" else ():
        _require_one_clock(source, reference, other, _reference_of(other, finder, rotor, timeline, place), finder)
    inside = (reference.pulse_times >= 0.0) & (reference.pulse_times <= (timeline.samples - 1) / timeline.rate)
    return replace(reference, pulse_times=reference.pulse_times[inside])


def _reference_of(
    source: FoundChannel, finder: ChannelFinder, rotor: MappedRotor, timeline: Timeline, place: str
) -> RotorReference:
    """The pulses of one channel, also those before the first and after the last sample of the run."""
    _refuse_speed(source, rotor, place)
    try:
        if rotor.kind == "times":
            reference = read_rotor_reference(
                lambda a, b: _column(source, a, b), source.group.samples, 1.0, _settings(rotor)
            )
            begin = source.group.start
        else:
            clock = finder.clock(source)
            reference = read_rotor_reference(
                lambda a, b: _column(source, a, b), clock.samples, clock.rate, _settings(rotor)
            )
            begin = clock.start
    except UserError as error:
        where = f"channel `{rotor.channel}` ({place} of the map)"
        raise UserError(error.fault, str(source.file.path), where, error.remedy) from error
    return replace(reference, pulse_times=reference.pulse_times + begin - timeline.start)


def _require_one_clock(
    source: FoundChannel, one: RotorReference, other_source: FoundChannel, other: RotorReference, finder: ChannelFinder
) -> None:
    """Raise UserError where the pulses that two files recorded of one rotor differ in time, but for whole revolutions.

    The clocks of files count from the start of each box, or run at rates of their own: nothing else shows it.
    """
    times = other.pulse_times[(other.pulse_times >= one.pulse_times[0]) & (other.pulse_times <= one.pulse_times[-1])]
    revolutions = np.interp(times, one.pulse_times, np.arange(len(one.pulse_times)))
    thirds = np.array_split((revolutions - np.round(revolutions)) / one.mean_rate, 3)
    late = [float(np.median(third)) for third in thirds if len(third)]
    worst = max(late, key=abs, default=0.0)
    limit = LARGEST_CLOCK_ERROR / min(finder.clock(source).rate, finder.clock(other_source).rate)
    if abs(worst) > limit:
        fault = (
            f"its pulses come up to {1e3 * abs(worst):.4g} ms {'after' if worst > 0 else 'before'} those of the same "
            f"channel in {source.file.path}, whole revolutions apart from that: the clocks of these files differ"
        )
        remedy = (
            "Correct the times of one file by this and by whole revolutions, cut both to a common start, or write "
            "the tachometer as FILE/CHANNEL and rename the other if it is one of another rotor"
        )
        raise UserError(fault, str(other_source.file.path), f"channel `{other_source.name}`", remedy)


def _refuse_speed(source: FoundChannel, rotor: MappedRotor, place: str) -> None:
    """Raise UserError for a channel in rpm or Hz: the speed tells no azimuth."""
    try:
        parse_unit(source.unit, FREQUENCY)
    except UserError:
        return
    if rotor.kind == "pulses":
        fault = f"is in {source.unit}: a speed, which tells no azimuth"
        remedy = (
            "Give the channel of the pulses; without one leave `rotor` out, state `rotor_speed: 0`, and reduce at "
            "`--frequencies` or within a `--band`"
        )
        raise UserError(fault, str(source.file.path), f"channel `{rotor.channel}` ({place} of the map)", remedy)


def _column(source: FoundChannel, start: int, stop: int) -> Array:
    return source.group.read([source.column], start, stop)[:, 0]


def _settings(rotor: MappedRotor) -> TachometerSettings:
    return TachometerSettings(
        kind=rotor.kind,
        level=rotor.level,
        hysteresis=rotor.hysteresis,
        slope=rotor.slope,
        pulses_per_revolution=rotor.pulses_per_revolution,
        index=rotor.index,
        counts_per_revolution=rotor.counts_per_revolution,
        offset_deg=rotor.offset_deg,
        delay=rotor.delay,
        low_pass=None if rotor.filter is None else AnalogLowPass(rotor.filter.order, rotor.filter.cutoff),
        smooth=rotor.smooth,
    )
