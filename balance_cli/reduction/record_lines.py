"""Lines of a record beside its reduced harmonics, without the light modes that gusts excite."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.measured_response import highest_frequency, lowest_frequency
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.record_spectrum import RecordSpectrum
from balance_cli.signals.rotor.near_tones import find_near_tones
from balance_cli.signals.rotor.unmodelled_lines import UnmodelledLine, unmodelled_lines

Array = NDArray[np.float64]

MODE_REACH = np.linspace(-1.0, 1.0, 5)
"""Bins around a tone within which a mode that gusts excite may be what is found."""


def lines_of_record(
    record: RotorRecord, source: ResponseSource, over_time: RecordSpectrum | None = None
) -> tuple[UnmodelledLine, ...]:
    """Return the lines beside the harmonics; none at named frequencies, whose user knows that there are others.

    `over_time` is the spectrum for tones that do not turn with the rotor, by default that of the record.
    """
    if record.fixed_frequency:
        return ()
    n, gain = len(record.spectra.frequency_hz) - 1, _power_gain(record, source)
    lines = unmodelled_lines(record.spectrum_over_time, record.azimuth, n, gain, record.other_rotors, over_time)
    return (*lines, *_lines_in_lobes(record, gain))


def _lines_in_lobes(record: RotorRecord, power_gain: Callable[[Array], Array] | None) -> Iterator[UnmodelledLine]:
    """Yield the tones so near to a harmonic that a spectrum shows one line for both."""
    spectra, live = record.spectra, record.health.live
    lines, speed = spectra.noise_lines, float(spectra.frequency_hz[1])
    if lines is None:
        return
    tones = find_near_tones(lines, spectra.columns(live))
    turns = spectra.revolutions[1] - spectra.revolutions[0]
    for h in np.flatnonzero(tones.power.max(axis=1) > tones.least_power):
        c, order = int(np.argmax(tones.power[h])), h + 1 + tones.distance[h] / turns
        resonance = 1.0
        if power_gain is not None:
            near, beside = order + MODE_REACH / turns, h + 1 + lines.offsets / turns
            gain = power_gain(speed * np.concatenate([near, beside]))[:, c]
            peak, level = gain[: len(near)].max(axis=0), np.median(gain[len(near) :], axis=0)
            resonance = float(np.max(peak / np.maximum(level, np.finfo(float).tiny)))
        if tones.power[h, c] > tones.least_power[h] * resonance:
            yield UnmodelledLine(order * speed, float(order), live[c], float(tones.amplitude[h, c]), False)


def _power_gain(record: RotorRecord, source: ResponseSource) -> Callable[[Array], Array] | None:
    """Return |T|^2 (k, c, 6) of the live channels at k frequencies; None where the rows of the response are others."""
    live = record.health.live
    picked = source.channel_combination(record.spectra.frequency_hz[1:2], live)
    if not picked.rows_are_channels:
        return None
    band = lowest_frequency(source), highest_frequency(source)
    return lambda frequency: np.abs(source.at(np.clip(frequency, *band), record.spin)[:, picked.rows]) ** 2
