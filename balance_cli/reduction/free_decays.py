"""Free decays: modes and high-passes that a start has set in motion, fitted beside the harmonics of the rotor."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.system import System
from balance_cli.model.transient_modes import transient_modes
from balance_cli.reduction.measured_response import highest_frequency, lowest_frequency
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.edge_weight import EDGE_REVOLUTIONS
from balance_cli.signals.rotor.harmonics import BELOW_NYQUIST
from balance_cli.signals.rotor.other_lines import OtherLines
from balance_cli.signals.run_samples import sample_rate

DECAY_TIME_CONSTANTS = 12.0
"""Time constants of a mode after which its start transient is not fitted: exp(-12) is 6e-6, below what the noise of
amplitudes lets one see. A mode at 122.5 Hz with a damping ratio of 0.0003, 28 % of whose transient were left, had
changed a load at 120 Hz by 14 standard deviations."""
HIGH_PASS_TIME_CONSTANTS = 7.0
"""Time constants of a high-pass up to which a record has its decay fitted. In a longer one it fades early; the search
for the end of the start transient leaves that part out (`rotor_record.TRANSIENT_TIME_CONSTANTS`)."""
KEPT_SYSTEMS = 4
"""Systems, speeds and sample rates whose modes are kept: the runs of a batch have few of them."""
LARGEST_RESPONSE_CHANGE = 1e-3
"""Relative change of the response to a harmonic over an interval, with the rotor speed, up to which decays are fitted
to the record as it is.

Beyond it the harmonic itself changes in the channels, and a decay would take part of that: at a speed that drifted by
2 % loads were 10 % wrong. What changes is then taken out of the record first."""


def with_free_decays(
    other: OtherLines, run: Run, azimuth: Azimuth, first_revolution: int, source: ResponseSource
) -> OtherLines:
    """Return the lines, and the free decays of the modes that may still ring in an interval from a revolution on.

    What rings there below the noise of a sample leaks into the harmonics next to it. Of a measured response these are
    the poles: without them sound records of 12 revolutions were up to 18 standard deviations off at 3/rev.
    """
    start = float(azimuth.time_of(np.array(first_revolution)))
    since_start = start + 0.5 * EDGE_REVOLUTIONS / azimuth.mean_rate
    return replace(other, exponents=_lasting_exponents(source, run, since_start), start=start)


def with_high_pass_decays(
    lines: OtherLines, azimuth: Azimuth, first_revolution: int, geometry: Geometry, names: Sequence[str]
) -> OtherLines:
    """Return the lines, and the decays of the named channels' high-passes that last for a share of the record.

    A load that begins with the record sets them in motion: in a dozen revolutions from rest, within a time constant,
    channels with a high-pass had been wrong by up to 1 % at 1/rev.
    """
    start, end = azimuth.time_of(np.array([first_revolution, azimuth.turns])).tolist()
    constants = {channel.time_constant for channel in geometry.channels if channel.name in names}
    slow = sorted(tau for tau in constants if tau is not None and end - start < HIGH_PASS_TIME_CONSTANTS * tau)
    return replace(lines, start=start, rates=tuple(1.0 / tau for tau in slow), duration=end - start)


def response_is_constant(
    run: Run, azimuth: Azimuth, first_revolution: int, max_harmonic: int, source: ResponseSource
) -> bool:
    """Return whether the rotor speed from a revolution on leaves the response to each harmonic as it is."""
    speed = azimuth.speed(azimuth.time_of(np.arange(first_revolution, azimuth.turns + 1)))
    harmonic = np.arange(1, max(max_harmonic, 1) + 1)
    extremes = np.concatenate([harmonic * speed.min(), harmonic * speed.max()])
    extremes = np.clip(extremes, lowest_frequency(source), highest_frequency(source))
    slow, fast = np.split(source.at(extremes, run.rotor_speed), 2)
    change = np.linalg.norm(fast - slow, axis=1)
    return bool(np.all(change <= LARGEST_RESPONSE_CHANGE * np.linalg.norm(slow, axis=1)))


def rig_eigenvalues(source: ResponseSource, run: Run) -> NDArray[np.complex128]:
    """Return the eigenvalues [1/s] of the oscillating modes that a run can show; none where the source knows none."""
    highest = 0.5 * BELOW_NYQUIST * sample_rate(run)
    if source.system is None:
        return np.array([pole for pole in source.poles if pole.imag < 2.0 * np.pi * highest], complex)
    return _oscillating_modes(source.system, source.system.coupled_spin(run.rotor_speed), highest)


def _lasting_exponents(source: ResponseSource, run: Run, time: float) -> tuple[complex, ...]:
    """Return the eigenvalues [1/s] of the oscillating modes that have not decayed at a time [s]."""
    s = rig_eigenvalues(source, run)
    return tuple(s[-s.real < DECAY_TIME_CONSTANTS / time].tolist())


@functools.lru_cache(maxsize=KEPT_SYSTEMS)
def _oscillating_modes(system: System, spin: float, highest: float) -> NDArray[np.complex128]:
    """Return the eigenvalues [1/s] of the oscillating modes below a frequency [Hz]."""
    modes = transient_modes(system, spin, highest, with_derivatives=False)
    return modes.s[: modes.oscillating]
