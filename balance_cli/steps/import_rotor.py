"""The rotor reference of an imported run, on its time base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.import_map import MappedRotor
from balance_cli.io.errors import UserError
from balance_cli.io.units import FREQUENCY, parse_unit
from balance_cli.signals.rotor.tachometer import (
    AnalogLowPass,
    RotorReference,
    TachometerSettings,
    read_rotor_reference,
)
from balance_cli.steps.import_signals import ChannelFinder, FoundChannel
from balance_cli.steps.import_timeline import Timeline

Array = NDArray[np.float64]


def rotor_reference(finder: ChannelFinder, rotor: MappedRotor, timeline: Timeline, place: str) -> RotorReference:
    """The 1/rev pulses from the first sample of the run on. Raises UserError where they cannot be found."""
    source = finder.find(rotor.channel)
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
    times = reference.pulse_times + begin - timeline.start
    inside = (times >= 0.0) & (times <= (timeline.samples - 1) / timeline.rate)
    return replace(reference, pulse_times=times[inside])


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
