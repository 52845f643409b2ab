"""Whether the hub loads of a record are the same throughout, or step or drift within it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import TrimCalibration
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.free_decays import rig_eigenvalues
from balance_cli.reduction.harmonic_loads import window_harmonic_loads, window_mean_loads
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.slow_changes import material_change, slow_changes
from balance_cli.signals.rotor.channel_change import (
    BEYOND_CHANCE,
    ChannelChange,
    channel_change,
    harmonic_drift,
    step_remainder,
)
from balance_cli.signals.rotor.common_change import CommonChange, changes_of_columns, common_change
from balance_cli.signals.rotor.steadiness import (
    FEWEST_WINDOWS,
    WindowedAmplitudes,
    largest_change,
    sigma_if_steady,
    unsteady,
    windowed_amplitudes,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

START_TIME_CONSTANTS = 3.0
"""Time constants of the slowest mode after which the start of a record is compared: 5 % of a load that was applied at
once are left then, as an oscillation, which the mean over a revolution reduces below a material change."""
LARGEST_START_SHARE = 0.125
"""Share of a record without a transient that is left out of the comparison all the same: a step within it changes the
mean by less than an eighth of itself."""
SLOW_MODE_CORRELATION = 0.9
"""Correlation of neighboring windows from which the slowest mode may be slower than a window: it then shakes the means
of windows, too, which average faster modes out."""
SAID_CHANGE = 0.01
"""Factor less one, or turn [rad], from which a change of all harmonics is described by it."""
TONE_QUESTION = "is the tone at the given frequency, or were samples lost?"
"""What a turn of all loads at a given frequency asks: no azimuth tells where the tone is."""
AVERAGED_PERIODS = 2.0
"""Periods of a mode in a window that leave less than a sixth of its amplitude in the mean, 1 over 2 pi."""
BEYOND_STATED = 2.0
"""Standard deviations of a mean load from which its distance from the median of windows counts: slow gusts make the
distance 0.75 of one."""
STEADY_SPEED = 2e-3
"""Relative range of the speed of windows up to which they have one response: pulses scatter by less."""
START_UP_SHARE = 0.03
"""Departure of the rotor speed of a window from that of the interval by which a record begins with a start-up."""


@dataclass(frozen=True)
class Steadiness:
    """Which loads (n+1, m) of a record step or drift within it, and `note`, why where all do; empty without.

    `mean_change` (m,) is by how much the mean loads do so, if one does by more than chance; it may be immaterial.
    `harmonic_error` (n, m) is by how much such changes make the harmonics uncertain, zero where they do not; `passing`
    names those near which a tone or the like passes.
    """

    unsteady: NDArray[np.bool_]
    note: str = ""
    mean_change: Array | None = None
    harmonic_error: Array | None = None
    passing: str = ""


def examine_steadiness(
    record: RotorRecord,
    geometry: Geometry,
    source: ResponseSource,
    static: TrimCalibration | None,
    sigma: Array,
    reported: ComplexArray,
    constant_response: ComplexArray | None = None,
) -> Steadiness:
    """Return which loads (n+1, m) step or drift within a record, by more than chance and by more than is immaterial.

    `sigma` (n+1, m) are the standard deviations that are stated for the loads, `reported` (n, m) the harmonics; without
    a static calibration harmonic 0 is not examined. What was left out at the start as a transient is examined too, from
    where the rig alone is steady: a step of the load looks like the end of a transient. A change that all harmonics
    have in common makes all unsteady.
    `constant_response` (n, rows, 6) is that to the harmonics of a record from which its change with the speed was
    taken out; without, that at the speed of each window counts, from which a light mode departs.
    """
    n = len(record.spectra.frequency_hz) - 1
    windows = _windows_at_speed(record, source)
    if not len(windows.values):
        return Steadiness(np.zeros(sigma.shape, bool))
    loads = np.zeros((len(windows.values), *sigma.shape), complex)
    loads[:, 1:] = window_harmonic_loads(windows, record, geometry, source, constant_response)
    if static is not None:
        loads[:, 0] = window_mean_loads(windows, static)
    of_harmonics = _correlation(windows, source)
    correlation = np.full((n + 1, 1), of_harmonics)
    correlation[0] *= of_harmonics > SLOW_MODE_CORRELATION and not _averages_modes(windows, record, source)
    # Of harmonics only the interval: the transient of a high-pass, which the slowest mode does not tell, is among them.
    duration = windows.turns / float(np.median(windows.speed))
    first, last = record.spectra.interval
    start = max(len(loads) - int((last - first) / duration), 0)
    within = loads[start:]
    loads[:, 0] = _beyond_transient(loads[:, 0], start, of_harmonics)
    stated = sigma[0]
    if static is not None:
        # A step makes the noise of a mean red, and its sigma large.
        sigma = np.vstack([np.minimum(sigma[0], sigma_if_steady(loads[:, 0])), sigma[1:]])
    is_unsteady = unsteady(loads, _least_change(sigma, loads), correlation)
    mean_change = _mean_change(loads[:, 0], sigma[0], stated, correlation[0])
    is_unsteady[1:] = unsteady(within, _least_change(sigma, within), correlation)[1:]
    note = _change_of_all(within, windows, start, lambda window: first + window * duration, record, geometry)
    whole = _reported(within[:, 1:], windows, reported)
    error = harmonic_drift(within[:, 1:], whole, sigma[1:], bool(mean_change.any()))
    slow = slow_changes(record, geometry, source, within[:, 1:], sigma[1:], constant_response)
    is_unsteady[1:] |= slow.material
    return Steadiness(is_unsteady | bool(note), note, mean_change, np.maximum(error, slow.error), slow.note)


def _mean_change(means: ComplexArray, sigma: Array, stated: Array, correlation: Array) -> Array:
    """Return by how much the mean loads of windows (w, m) change, by more than chance; zero where none does.

    `sigma` (m,) is that of steady means, `stated` that of the loads. Of what a few windows depart by, as of a channel
    that is displaced now and then, the mean contains a part that the median does not: it counts as half of a change.
    """
    # What steps in one load, as of a channel whose zero steps, does so in others, less clearly.
    change = largest_change(means) * unsteady(means, sigma, correlation).any()
    if len(means) < FEWEST_WINDOWS:
        return np.asarray(change)
    remainder = step_remainder(means, means.mean(axis=0), BEYOND_CHANCE)
    return np.asarray(np.maximum(change, 2.0 * remainder * (remainder > BEYOND_STATED * stated)))


def _reported(values: ComplexArray, windows: WindowedAmplitudes, reported: ComplexArray) -> ComplexArray:
    """Return the harmonics (n, m) as they are reported, or the means of windows (w, n, m) where the speed varies.

    The response at the mean speed is then another one than those of the windows.
    """
    varies = np.ptp(windows.speed) > STEADY_SPEED * float(np.median(windows.speed))
    return np.asarray(values.mean(axis=0) if varies else reported)


def _change_of_all(
    loads: ComplexArray,
    windows: WindowedAmplitudes,
    start: int,
    time_of: Callable[[int], float],
    record: RotorRecord,
    geometry: Geometry,
) -> str:
    """Say what all loads (w, n+1, m), or all harmonics of a channel, do within a record; empty where they do nothing.

    `time_of` gives the time [s] of a window, counted from window `start`.
    """
    change, whose = common_change(loads[:, 1:]), ""
    if change is None:
        change, whose = _change_of_channel(windows, start)
    if change is not None:
        return _explain(change, time_of(change.window), whose, record.fixed_frequency)
    alone = _channel_alone(windows, start, record, geometry)
    if alone is None:
        return ""
    whose = "" if alone.column is None else f" of {windows.names[alone.column]}"
    question = TONE_QUESTION if record.fixed_frequency and alone.column is None else alone.question
    return f"from {time_of(alone.window):.3g} s on all harmonics{whose} {alone.description}: {question}"


def _channel_alone(
    windows: WindowedAmplitudes, start: int, record: RotorRecord, geometry: Geometry
) -> ChannelChange | None:
    """Return what one channel does from window `start` on that no other sensor shows, or all by one turn."""
    source = {channel.name: channel.source for channel in geometry.channels}
    sources = list(dict.fromkeys(source[name] for name in windows.names))
    sensors = np.array([sources.index(source[name]) for name in windows.names])
    columns = record.spectra.columns(windows.names)
    variance = np.einsum("hcc->hc", record.spectra.covariance[1:][:, columns][:, :, columns]).real
    return channel_change(windows.values[start:, 1:], sensors, np.sqrt(variance / 2.0))


def _change_of_channel(windows: WindowedAmplitudes, start: int) -> tuple[CommonChange | None, str]:
    """Return the change that all harmonics of a channel have in common, counted from window `start`, and whose it is.

    The loads of a rig without redundancy do not tell a channel whose gain is switched, or whose cable comes off, from a
    change of the loads; these do not change all harmonics of one channel alike. A channel that ceases looks like the
    end of a transient, so that the windows before the interval are examined, too.
    """
    for name, change in zip(windows.names, changes_of_columns(windows.values[:, 1:]), strict=True):
        if change is not None:
            return replace(change, window=change.window - start), f" of {name}"
    return None, ""


def _explain(change: CommonChange, time: float, whose: str, is_tone: bool) -> str:
    """Say what all harmonics, or those of one channel, do from a time [s] on, and what may have made them.

    A tone has no azimuth that could slip.
    """
    turn = np.degrees(change.turn)
    parts = [
        f"have {change.factor:.3g} times their size" if abs(change.factor - 1.0) > SAID_CHANGE else "",
        f"turn by harmonic times {turn:+.2g} deg" if min(abs(change.turn), change.factor) > SAID_CHANGE else "",
    ]
    reasons = "was a gain switched, or did a cable come off?" if parts[0] else ""
    if parts[1]:
        reasons = TONE_QUESTION if is_tone else "did the azimuth slip, or were samples lost?"
    return f"from {time:.3g} s on all harmonics{whose} {' and '.join(filter(None, parts))}: {reasons}"


def _correlation(windows: WindowedAmplitudes, source: ResponseSource) -> float:
    """Return the correlation of gusts in the harmonics of neighboring windows, as the slowest mode transmits them."""
    duration = windows.turns / float(np.median(windows.speed))
    return float(np.exp(-duration / source.slowest_decay)) if source.slowest_decay > 0 else 0.0


def _averages_modes(windows: WindowedAmplitudes, record: RotorRecord, source: ResponseSource) -> bool:
    """Whether the means of windows average all modes out, also those that ring longer than a window."""
    s = rig_eigenvalues(source, record.run)
    periods = s.imag * windows.turns / (2.0 * np.pi * float(np.median(windows.speed)))
    is_slowest_known = np.max(-1.0 / s.real, initial=0.0) > 0.99 * source.slowest_decay
    return bool(is_slowest_known and periods.min() > AVERAGED_PERIODS)


def _beyond_transient(means: ComplexArray, start: int, decay: float) -> ComplexArray:
    """Return the means (w, m), before window `start` by what no transient that fades by `decay` a window explains.

    A transient stays below an envelope that falls from its largest value in the first time constant; what the load
    itself departs by stays as it is.
    """
    if not 0 < start < len(means) or decay <= 0:
        return means
    steps = -np.log(decay) * np.arange(start)
    steady = means[start:].mean(axis=0)
    departure = means[:start] - steady
    size = np.abs(departure)
    envelope = size[steps <= 1.0].max(axis=0) * np.exp(1.0 - steps)[:, None]
    share = np.maximum(size - envelope, 0.0) / np.where(size > 0, size, 1.0)
    return np.concatenate([steady + departure * share, means[start:]])


def _first_revolution(record: RotorRecord, source: ResponseSource) -> int:
    """Return the first revolution that a transient of the rig cannot have reached, at most that of the interval.

    A transient below the noise of a sample is part of the interval, and still moves the means of the first windows.
    """
    start = START_TIME_CONSTANTS * source.slowest_decay
    first, last = record.spectra.revolutions
    most = max(first, int(LARGEST_START_SHARE * last))
    return min(most, int(np.searchsorted(record.azimuth.time_of(np.arange(most + 1)), start)))


def _windows_at_speed(record: RotorRecord, source: ResponseSource) -> WindowedAmplitudes:
    """Return the windows of a record that can be compared, from the first on at which the rotor has its speed."""
    n, speed = len(record.spectra.frequency_hz) - 1, float(record.spectra.frequency_hz[1])
    revolutions = (_first_revolution(record, source), record.spectra.revolutions[1])
    windows = windowed_amplitudes(record.run, record.azimuth, record.health.live, n, revolutions)
    at_speed = np.flatnonzero(np.abs(windows.speed / speed - 1.0) < START_UP_SHARE)
    first = int(at_speed[0]) if at_speed.size else 0
    return replace(windows, values=windows.values[first:], speed=windows.speed[first:])


def _least_change(sigma: Array, loads: ComplexArray) -> Array:
    """Return a third of the change (n+1, m) of loads (w, n+1, m) that matters, at least sigma."""
    return np.maximum(sigma, material_change(np.abs(loads.mean(axis=0))) / 3.0)
