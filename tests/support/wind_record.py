"""Wind records at any rotor speed, exact in frequency: loads over azimuth and time through the responses of a rig."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.signals.anti_alias import anti_alias_response

Array = NDArray[np.float64]

LEAD = 5.0
"""[s] before the first sample and after the last one, in which what begins or ends there decays."""


@dataclass(frozen=True)
class WindRecord:
    """A run, and the amplitudes (n+1, 6) of its harmonic loads as complex numbers; phases count from the pulses."""

    run: Run
    loads: NDArray[np.complex128]


def wind_record(
    geometry: Geometry,
    loads: NDArray[np.complex128],
    *,
    seconds: float = 12.0,
    rate: float = 1000.0,
    speed_change: Callable[[Array], Array] = np.zeros_like,
    further: Callable[[Array, Array], Array] | None = None,
    noise: float = 3e-3,
    seed: int = 1,
) -> WindRecord:
    """Return a record of a rotor whose speed departs from that of the rig by `speed_change` (relative) over time [s].

    `further` returns loads (m, 6) of time [s] and azimuth [rad], beside the harmonics; `noise` is a share of the rms of
    each channel. The response is that of the equations of motion, over the whole spectrum of the loads.
    """
    assert geometry.rotor is not None
    speed, count = geometry.rotor.speed, int(seconds * rate)
    time = (np.arange(count + 2 * int(LEAD * rate)) - int(LEAD * rate)) / rate
    relative = 1.0 + speed_change(np.clip(time, 0.0, seconds))
    turns = np.cumsum(0.5 * (relative + np.roll(relative, 1))) * speed / rate
    psi = 2.0 * np.pi * turns
    applied = sum((np.exp(1j * n * psi)[:, None] * amplitude).real for n, amplitude in enumerate(loads))
    if further is not None:
        applied = applied + further(time, psi)
    volts = _channels(geometry, np.asarray(applied), rate, speed)[int(LEAD * rate) :][:count]
    volts = volts + noise * volts.std(axis=0) * np.random.default_rng(seed).standard_normal(volts.shape)
    numbers = np.arange(np.ceil(np.interp(0.0, time, turns)), np.interp((count - 1) / rate, time, turns))
    run = Run(
        name="wind",
        rig=geometry.rig,
        kind="wind",
        channel_names=geometry.channel_names,
        samples=count,
        source=MemorySource(volts, None),
        has_loads=False,
        sample_rate=rate,
        rotor_speed=speed,
        pulse_times=np.interp(numbers, turns, time),
    )
    return WindRecord(run, loads)


def _channels(geometry: Geometry, applied: Array, rate: float, speed: float) -> Array:
    """Return the volts (n, c) that loads (n, 6), repeated for ever, make."""
    system, frequency = balance_model(geometry).system(), np.fft.rfftfreq(len(applied), 1.0 / rate)
    T = (
        response(system, solve(system, frequency, speed))
        * anti_alias_response(geometry.acquisition, frequency)[:, None, None]
    )
    return np.fft.irfft(np.einsum("kcj,kj->kc", T, np.fft.rfft(applied, axis=0)), len(applied), axis=0)
