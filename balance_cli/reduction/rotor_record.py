"""A record over azimuth: its usable channels and their harmonics, from the end of the start transient on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.io.errors import UserError
from balance_cli.reduction.free_decays import (
    LARGEST_RESPONSE_CHANGE,
    response_is_constant,
    with_free_decays,
    with_high_pass_decays,
)
from balance_cli.reduction.response_sources import ResponseSource, usable_channels
from balance_cli.reduction.speed_modulation import without_speed_modulation
from balance_cli.signals.record_spectrum import RecordSpectrum, record_spectrum
from balance_cli.signals.rotor.azimuth import Azimuth, azimuth_from_pulses
from balance_cli.signals.rotor.harmonic_residual import without_harmonics
from balance_cli.signals.rotor.harmonics import (
    BELOW_NYQUIST,
    FITTED_HARMONICS,
    Harmonics,
    estimate_harmonics,
)
from balance_cli.signals.rotor.other_lines import NO_OTHER_LINES, OtherLines, tones_beside
from balance_cli.signals.rotor.other_rotors import ConfoundedLine, other_azimuths, rotor_azimuth, without_other_rotors
from balance_cli.signals.rotor.pulse_consistency import pulse_faults
from balance_cli.signals.rotor.pulse_error import OrderedRecord, judge_pattern
from balance_cli.signals.rotor.pulse_pattern import PulsePattern, pulse_pattern, without_pattern
from balance_cli.signals.rotor.record_length import FEWEST_REVOLUTIONS, require_revolutions
from balance_cli.signals.run_samples import sample_rate
from balance_cli.signals.transient_end import find_transient_end

TRANSIENT_TIME_CONSTANTS = 7.0
"""Time constants of the slowest mode within which the transient end is sought: exp(-7) is a thousandth."""
MIN_TRANSIENT_TIME = 10.0
"""Time [s] that is searched at least: a response may lack the slowest mode, and the high-pass of a piezo channel decays
within seconds."""
MOST_MODULATION_PASSES = 3
"""Passes in which what changes with the speed is taken out, with the harmonics of the pass before; those of the first
contain what the modes leak. Where the harmonics change by less than the response, nothing would change in the next."""


MOST_PATTERNS = 4
"""Periodic departures of the pulses that are judged: a pattern of seven revolutions has three harmonics."""
TAKEN_OUT = "the channels are not, taken out"
DOUBT = "neither an error of the pulses nor the rotor speed alone explains what the channels have at this period"


@dataclass(frozen=True)
class RotorRecord:
    """A record over azimuth: its usable channels, and their harmonics and those of the loads after the transient.

    `components` are those that the balance carries. At a `fixed_frequency` the azimuth is that of a tone, which turns
    with no rotor. `rotor` is the number of the rotor whose azimuth it is. The lines of the others have been taken out
    of `run`, but for those that are `confounded` with its harmonics. `recorded`: the run with the contribution of
    nonlinear forces, which `run` does not have. `pulse_doubt` says what is not understood of the pulses.
    """

    run: Run
    health: ChannelHealth
    azimuth: Azimuth
    spectra: Harmonics
    components: tuple[str, ...]
    fixed_frequency: bool = False
    rotor: int = 1
    other_rotors: tuple[Azimuth, ...] = ()
    confounded: tuple[ConfoundedLine, ...] = ()
    recorded: Run | None = None
    pulse_doubt: str = ""

    @cached_property
    def spectrum_over_time(self) -> RecordSpectrum:
        """The spectrum of the usable channels in the interval of the harmonics, or in the middle of it."""
        return record_spectrum(self.run, self.health.live, self.spectra.interval)

    @cached_property
    def residual_spectrum(self) -> RecordSpectrum:
        """The same without the harmonics, which are lines over azimuth and bands over time."""
        rest = without_harmonics(self.run, self.azimuth, self.spectra, self.health.live)
        return record_spectrum(rest, self.health.live, self.spectra.interval)

    @property
    def spin(self) -> float:
        """Speed [Hz] of the first rotor over the interval; 0 at rest."""
        if self.fixed_frequency or self.rotor != 1:
            return self.run.rotor_speed
        return self.run.rotor_speed and float(self.spectra.frequency_hz[1])


def rotor_record(
    run: Run,
    geometry: Geometry,
    source: ResponseSource,
    max_harmonic: int = 8,
    rotor: int = 1,
    remove_other_rotors: bool = True,
) -> RotorRecord:
    """Return harmonics 0 to `max_harmonic` of one `check` or `wind` run, from the end of its start transient on.

    The harmonics are those of `rotor`; the lines of further rotors are taken out first (unless they are to be found as
    lines that no harmonic describes). Raises UserError where no channel is usable or the 1/rev pulses are not.
    """
    health = usable_channels(run, geometry, source)
    for contradiction in pulse_faults(run, None if geometry.rotor is None else geometry.rotor.speed):
        raise contradiction
    azimuth = rotor_azimuth(run, rotor)
    require_revolutions(run, azimuth)
    confounded: tuple[ConfoundedLine, ...] = ()
    if remove_other_rotors:
        alone, _ = without_other_rotors(run, azimuth, rotor, max_harmonic, 0)
        start = _steady_revolution(alone, azimuth, source, health) if alone is not run else 0
        run, confounded = without_other_rotors(run, azimuth, rotor, max_harmonic, start)
    record = _judge_pulses(
        _record(run, azimuth, max_harmonic, geometry, source, health),
        lambda corrected: _record(run, corrected, max_harmonic, geometry, source, health),
        geometry,
        source,
    )
    others = other_azimuths(run, rotor) if remove_other_rotors else ()
    return replace(record, rotor=rotor, other_rotors=others, confounded=confounded)


def _judge_pulses(
    record: RotorRecord, remake: Callable[[Azimuth], RotorRecord], geometry: Geometry, source: ResponseSource
) -> RotorRecord:
    """Return the record by pulses without the periodic errors that its channels show; `remake` makes one by an azimuth.

    Where neither an error nor the speed explains what the channels have at the period, `pulse_doubt` says so.
    """
    known: list[PulsePattern] = []
    while len(known) < MOST_PATTERNS:
        azimuth = record.azimuth
        pattern = pulse_pattern(azimuth.pulse_times, azimuth.revolutions, known)
        if pattern is None:
            break
        known.append(pattern)
        without = remake(_corrected(azimuth, pattern))
        given, removed = _ordered(record, geometry, source), _ordered(without, geometry, source)
        verdict = judge_pattern(given, removed, pattern, record.health.live)
        if verdict is None or verdict.share == 0.0:
            continue
        if verdict.share == 1.0:
            record = replace(without, pulse_doubt=record.pulse_doubt)
        else:
            wrong = replace(pattern, amplitude=pattern.amplitude * verdict.share)
            record = replace(remake(_corrected(azimuth, wrong)), pulse_doubt=record.pulse_doubt)
        if verdict.contradicted or verdict.share != 1.0:
            record = replace(record, pulse_doubt=f"{pattern.description}: {DOUBT}")
    return record


def _corrected(azimuth: Azimuth, pattern: PulsePattern) -> Azimuth:
    """Return the azimuth by pulses without a pattern, with a note."""
    times = without_pattern(azimuth.pulse_times, azimuth.revolutions, pattern)
    return replace(azimuth, pulse_times=times, notes=(*azimuth.notes, f"{pattern.description}: {TAKEN_OUT}"))


def _ordered(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> OrderedRecord:
    """Return the record without what its harmonics change with the speed, as far as that is known."""
    demodulated = at_constant_speed(record, geometry, source) or record
    return OrderedRecord(demodulated.run, demodulated.azimuth, demodulated.spectra)


def _record(
    run: Run,
    azimuth: Azimuth,
    max_harmonic: int,
    geometry: Geometry,
    source: ResponseSource,
    health: ChannelHealth,
    other: OtherLines = NO_OTHER_LINES,
) -> RotorRecord:
    """Return the harmonics of a run over an azimuth, from the end of its start transient on."""
    recorded, run = run, source.remove_nonlinear_contribution(run, health.live)
    start = _steady_revolution(run, azimuth, source, health)
    signals = health.live + (COMPONENTS if run.has_loads else ())
    lines = with_free_decays(other, run, azimuth, start, source)
    lines = with_high_pass_decays(lines, azimuth, start, geometry, health.live)

    def harmonics(of: Run, beside: OtherLines) -> Harmonics:
        return estimate_harmonics(of, azimuth, max_harmonic, names=signals, first_revolution=start, other=beside)

    if not lines.exponents or response_is_constant(run, azimuth, start, max_harmonic, source):
        return RotorRecord(run, health, azimuth, harmonics(run, lines), carried_components(geometry), recorded=recorded)
    spectra = harmonics(run, other)
    for _ in range(MOST_MODULATION_PASSES):
        demodulated = without_speed_modulation(run, azimuth, spectra, geometry, source, health.live)
        if demodulated is None:
            break
        before, spectra = spectra.amplitude[1:], harmonics(demodulated, lines)
        if np.linalg.norm(spectra.amplitude[1:] - before) < LARGEST_RESPONSE_CHANGE * np.linalg.norm(before):
            break
    return RotorRecord(run, health, azimuth, spectra, carried_components(geometry), recorded=recorded)


def _steady_revolution(run: Run, azimuth: Azimuth, source: ResponseSource, health: ChannelHealth) -> int:
    """Return the revolution at which the start transient has ended."""
    limit = max(TRANSIENT_TIME_CONSTANTS * source.slowest_decay, MIN_TRANSIENT_TIME)
    return find_transient_end(run, azimuth, limit, health.live)


def tone_record(
    run: Run, frequency: float, others: Sequence[float], geometry: Geometry, source: ResponseSource
) -> RotorRecord:
    """Return the mean and the tone at `frequency` [Hz] of one run; `others` are tones that are regressed with it.

    The phase counts from the first sample. Raises UserError where the record holds too few cycles or no channel.
    """
    health = usable_channels(run, geometry, source)
    azimuth = azimuth_from_pulses(np.arange(count_cycles(run, frequency) + 1) / frequency)
    tones = tones_beside(frequency, others, (run.samples - 1) / sample_rate(run), FITTED_HARMONICS)
    return replace(_record(run, azimuth, 1, geometry, source, health, tones), fixed_frequency=True)


def count_cycles(run: Run, frequency: float) -> int:
    """Return the whole cycles of a tone [Hz] in a record; UserError where they are too few, or the rate is too low."""
    if frequency >= BELOW_NYQUIST * sample_rate(run) / 2.0:
        fault = f"{frequency:g} Hz is beyond half the sample rate of {sample_rate(run):g} Hz"
        raise UserError(fault, run.file, "--frequencies", "Give lower frequencies")
    cycles = int((run.samples - 1) / sample_rate(run) * frequency)
    if cycles < FEWEST_REVOLUTIONS:
        fault = f"holds {cycles} cycles of {frequency:g} Hz; at least {FEWEST_REVOLUTIONS} are needed"
        raise UserError(fault, run.file, "--frequencies", "Record for longer, or give a higher frequency")
    return cycles


def at_constant_speed(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> RotorRecord | None:
    """Return the record without what its harmonics change with the rotor speed; None where that is not known."""
    first, n = record.spectra.revolutions[0], len(record.spectra.frequency_hz) - 1
    if record.fixed_frequency or response_is_constant(record.run, record.azimuth, first, n, source):
        return record
    demodulated = without_speed_modulation(
        record.run, record.azimuth, record.spectra, geometry, source, record.health.live
    )
    return None if demodulated is None else replace(record, run=demodulated)
