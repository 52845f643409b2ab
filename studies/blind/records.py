"""Run files of the true rig: what is applied, what the exciters' force cells and the channels record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from studies.blind.physics import (
    STEP_ANGLE,
    Mechanics,
    anti_alias,
    equilibria,
    linear_forces,
    nonlinear_forces,
    plate_mechanics,
    static_forces,
)
from studies.blind.rigs import Rig

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
UNITS = ("N", "N", "N", "N m", "N m", "N m")
# Loads have no content above half the rate; the ramp of a start leaves some up to the whole of it.
OVERSAMPLING = 4
# Time constants of the slowest mode before a record, so that nothing of the start is left in it.
SETTLED = 16.0


@dataclass(frozen=True)
class Record:
    """One dynamic record to be made: `loads` of times [s] (negative before it) gives the recorded loads (m, 6)."""

    name: str
    kind: str
    duration: float
    loads: Callable[[Array], Array]
    attributes: dict[str, object]
    constant: Array = field(default_factory=lambda: np.zeros(6))
    azimuth: Callable[[Array], Array] | None = None
    excited: tuple[int, ...] = ()
    spin: float = 0.0


@dataclass(frozen=True)
class Truth:
    """The true rig and all that nobody declared; per channel where keys are channel numbers."""

    rig: Rig
    mechanics: Mechanics
    per_run: Callable[[Mechanics, Record], Mechanics] = lambda mechanics, record: mechanics
    at_the_end: Callable[[Mechanics], Mechanics] | None = None
    """What becomes of the mechanics in the course of a record, so slowly that each instant is that of a steady rig."""
    exciter: Array = field(default_factory=lambda: np.eye(6))
    load_offset: Array = field(default_factory=lambda: np.zeros(6))
    load_dynamics: dict[int, Callable[[Array], ComplexArray]] = field(default_factory=dict)
    """Load of an exciter over what is recorded of it, by component."""
    dynamics: dict[int, Callable[[Array], ComplexArray]] = field(default_factory=dict)
    mix: dict[tuple[int, int], float] = field(default_factory=dict)
    offset: dict[int, float] = field(default_factory=dict)
    drift: dict[int, float] = field(default_factory=dict)
    late_clock: dict[int, float] = field(default_factory=dict)
    saturation: dict[int, float] = field(default_factory=dict)
    curvature: dict[int, float] = field(default_factory=dict)
    """What a channel reads before its filter beyond a linear one, per square of what that one reads [1/V]."""
    converter: dict[int, Callable[[Array], Array]] = field(default_factory=dict)
    mains: dict[int, tuple[float, float]] = field(default_factory=dict)


def true_rig(rig: Rig) -> Truth:
    """The rig with nothing undeclared."""
    return Truth(rig, plate_mechanics(rig))


def channel_gains(truth: Truth, frequency: Array) -> ComplexArray:
    """Volts per newton of each channel's cell (k, c), without crosstalk and anti-alias filter."""
    jw = 2j * np.pi * frequency
    gains = []
    for i, channel in enumerate(truth.rig.channels):
        gain = np.full(len(frequency), channel.sensitivity, complex)
        if channel.lowpass is not None:
            gain /= 1 + jw / (2 * np.pi * channel.lowpass)
        if channel.time_constant is not None:
            gain *= jw * channel.time_constant / (1 + jw * channel.time_constant)
        gains.append(gain * truth.dynamics[i](frequency) if i in truth.dynamics else gain)
    return np.column_stack(gains)


def _mixed(truth: Truth, volts: Array) -> Array:
    """Crosstalk, from the voltages without any."""
    result = volts.copy()
    for (to, source), fraction in truth.mix.items():
        result[..., to] += fraction * volts[..., source]
    return result


def simulate_records(truth: Truth, records: list[Record], noise: float, rng: np.random.Generator) -> dict[str, dict]:
    """Content of the run files by name; noise as a share of the rms of the strongest record."""
    if truth.mechanics.laws:
        forces = _integrated(truth, records)
    else:
        forces = {record.name: _convolved(truth, record) for record in records}
    raw = {record.name: _channels(truth, record, *forces[record.name]) for record in records}
    size = np.max([volts.std(axis=0) for volts, _ in raw.values()], axis=0)
    size = np.maximum(size, 0.1 * np.median(size))
    result = {}
    for record in records:
        volts, loads = raw[record.name]
        volts = volts + noise * size * rng.normal(size=volts.shape)
        for channel, (amplitude, frequency) in truth.mains.items():
            time = np.arange(len(volts)) / truth.rig.sample_rate
            gain = abs(anti_alias(truth.rig, np.array([frequency]))[0])
            volts[:, channel] += gain * amplitude * np.cos(2 * np.pi * frequency * time + rng.uniform(0, 6.3))
        for channel, codes in truth.converter.items():
            volts[:, channel] = codes(volts[:, channel])
        result[record.name] = _content(truth, record, volts, loads, noise, rng)
    return result


def _grid(truth: Truth, record: Record, oversampling: int, shared: float = 0.0) -> tuple[Array, int]:
    """Times of the fine grid, and the number of its points before the record."""
    rate = truth.rig.sample_rate
    before = int(np.ceil(SETTLED / truth.mechanics.slowest_decay * rate))
    n = round(max(record.duration, shared) * rate) + 8
    before += next_fast_len(before + n, real=True) - before - n
    return (np.arange((before + n) * oversampling) - before * oversampling) / (rate * oversampling), before


def _convolved(truth: Truth, record: Record) -> tuple[Array, Array, int, int]:
    """Forces, recorded loads (fine), points before the record, oversampling."""
    time, before = _grid(truth, record, OVERSAMPLING)
    recorded = record.loads(time)
    acting = _followed(truth, recorded, time[1] - time[0])
    applied = (acting - _offset(truth, record)) @ truth.exciter.T if record.kind != "wind" else recorded
    mechanics = truth.per_run(truth.mechanics, record)
    rate = truth.rig.sample_rate
    forces = linear_forces(mechanics, applied, rate * OVERSAMPLING, record.spin, rate)
    if truth.at_the_end is not None:
        last = linear_forces(truth.at_the_end(mechanics), applied, rate * OVERSAMPLING, record.spin, rate)
        forces = forces + np.clip(time / record.duration, 0, 1)[:, None] * (last - forces)
    return forces, recorded, before, OVERSAMPLING


def _followed(truth: Truth, recorded: Array, step: float) -> Array:
    """The loads (m, 6) with which the exciters follow those recorded."""
    loads = recorded.copy()
    frequency = np.fft.rfftfreq(len(loads), step)
    for i, response in truth.load_dynamics.items():
        loads[:, i] = np.fft.irfft(np.fft.rfft(loads[:, i]) * response(frequency), len(loads))
    return loads


def _offset(truth: Truth, record: Record) -> Array:
    offset = np.zeros(6)
    for i in record.excited:
        offset[i] = truth.load_offset[i]
    return offset


def _integrated(truth: Truth, records: list[Record]) -> dict[str, tuple[Array, Array, int, int]]:
    rate = truth.rig.sample_rate
    fastest = np.max(np.abs(np.linalg.eigvals(truth.mechanics.state_matrix(0.0))))
    oversampling = max(OVERSAMPLING, int(np.ceil(fastest / STEP_ANGLE / rate)))
    longest = max(record.duration for record in records)
    steady = np.array([_steady(truth, record) for record in records])
    recorded, inputs = [], []
    for record in records:
        time, before = _grid(truth, record, 2 * oversampling, longest)
        loads = record.loads(time)
        acting = _followed(truth, loads, time[1] - time[0])
        inputs.append(acting @ truth.exciter.T if record.kind != "wind" else loads)
        recorded.append(loads[::2])
    # The loads rise smoothly from zero where the records begin before their first sample.
    ramp = np.clip(np.arange(len(time)) / (0.3 * before * 2 * oversampling), 0, 1) ** 2
    total = np.stack(inputs, axis=1) * ramp[:, None, None] + steady
    start = np.array([equilibria(truth.mechanics, load[None])[0] for load in steady])
    forces = nonlinear_forces(truth.mechanics, total, rate * oversampling, start)
    rest = start @ truth.mechanics.E.T * truth.mechanics.stiffness
    return {
        record.name: (forces[:, i] - rest[i], recorded[i], before, oversampling) for i, record in enumerate(records)
    }


def _channels(truth: Truth, record: Record, forces: Array, loads: Array, before: int, fine: int) -> tuple[Array, Array]:
    """Volts (n, c) and recorded loads (n, 6) as sampled, without noise."""
    rig, rate = truth.rig, truth.rig.sample_rate
    n = round(record.duration * rate)
    longest = max(channel.time_constant or 0.0 for channel in rig.channels)
    count = len(forces) // fine
    pad = next_fast_len(count + int(np.ceil(SETTLED * longest * rate)), real=True) - count
    forces = np.concatenate([np.zeros((pad * fine, forces.shape[1])), forces])
    frequency = np.fft.rfftfreq(len(forces), 1 / (rate * fine))
    filtered = anti_alias(rig, frequency)[:, None]
    cells = [channel.cell for channel in rig.channels]
    spectrum = np.fft.rfft(forces, axis=0)[:, cells] * channel_gains(truth, frequency)
    at = (pad + before + np.arange(n)) * fine
    whole = np.fft.irfft(_mixed(truth, spectrum * filtered), len(forces), axis=0)
    rest = static_forces(truth.per_run(truth.mechanics, record), _steady(truth, record)[None])[:, cells]
    rest = _mixed(truth, rest * channel_gains(truth, np.zeros(1)).real)
    for channel, curvature in truth.curvature.items():
        linear = np.fft.irfft(spectrum[:, channel], len(forces)) + rest[:, channel]
        whole[:, channel] += np.fft.irfft(np.fft.rfft(curvature * linear**2) * filtered[:, 0], len(forces))
    volts = whole[at]
    for channel, share in truth.late_clock.items():
        position = (pad + before + np.arange(n) * (1 + share)) * fine
        volts[:, channel] = _interpolated(whole[:, channel], position)
    volts = volts + rest
    for channel, drift in truth.drift.items():
        volts[:, channel] *= 1 + drift * (np.arange(n) / n - 0.5)
    for channel, volt in truth.offset.items():
        volts[:, channel] += volt
    for channel, limit in truth.saturation.items():
        volts[:, channel] = limit * np.tanh(volts[:, channel] / limit)
    frequency = np.fft.rfftfreq(len(loads), 1 / (rate * fine))
    measured = np.fft.irfft(np.fft.rfft(loads, axis=0) * anti_alias(rig, frequency)[:, None], len(loads), axis=0)
    return volts, measured[(before + np.arange(n)) * fine]


def _steady(truth: Truth, record: Record) -> Array:
    """The constant part of what acts on the rig."""
    return truth.exciter @ (record.constant - _offset(truth, record)) if record.kind != "wind" else record.constant


def _interpolated(values: Array, position: Array) -> Array:
    """Cubic interpolation (Lagrange, four points) of values on the fine grid."""
    i = np.floor(position).astype(int)
    s = position - i
    weights = (
        -s * (s - 1) * (s - 2) / 6,
        (s + 1) * (s - 1) * (s - 2) / 2,
        -(s + 1) * s * (s - 2) / 2,
        (s + 1) * s * (s - 1) / 6,
    )
    return np.asarray(sum(w * values[np.clip(i + k - 1, 0, len(values) - 1)] for k, w in enumerate(weights)))


def _content(truth: Truth, record: Record, volts: Array, loads: Array, noise: float, rng: np.random.Generator) -> dict:
    content = {"attributes": record.attributes, "channels": volts}
    if record.kind in ("sweep", "check"):
        sizes = loads.std(axis=0)
        loads = loads + record.constant + 0.3 * noise * sizes * rng.normal(size=loads.shape)
        content["loads"] = loads * np.isin(np.arange(6), record.excited)
    if record.azimuth is not None:
        time = np.linspace(0, record.duration, 40 * int(record.duration * truth.rig.rotor_speed + 10))
        turns = record.azimuth(time) / (2 * np.pi)
        content["pulses"] = np.interp(np.arange(np.ceil(turns[0]), np.floor(turns[-1]) + 1), turns, time)
    return content


def simulate_static(truth: Truth, loads: Array, noise: float, rng: np.random.Generator) -> tuple[list[str], Array]:
    """Names and readings (m, c) of the channels that hold a constant force, under loads (m, 6)."""
    forces = static_forces(truth.mechanics, loads)
    kept = [i for i, channel in enumerate(truth.rig.channels) if channel.time_constant is None]
    cells = [channel.cell for channel in truth.rig.channels]
    volts = _mixed(truth, forces[:, cells] * channel_gains(truth, np.zeros(1)).real)
    for channel, curvature in truth.curvature.items():
        volts[:, channel] += curvature * volts[:, channel] ** 2
    for channel, volt in truth.offset.items():
        volts[:, channel] += volt
    size = volts.std(axis=0)
    volts = volts + noise * np.maximum(size, 0.1 * np.median(size[kept])) * rng.normal(size=volts.shape)
    return [truth.rig.channels[i].name for i in kept], volts[:, kept]


def write_run(path: Path, attributes: dict[str, object], names: list[str], content: dict[str, Array]) -> None:
    """Write one run file."""
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "balance-run/1"
        for key, value in attributes.items():
            file.attrs[key] = value
        channels = file.create_dataset("channels", data=content["channels"].astype("f4"))
        channels.attrs["names"], channels.attrs["unit"] = names, "V"
        if "loads" in content:
            loads = file.create_dataset("loads", data=content["loads"])
            loads.attrs["names"], loads.attrs["units"] = list(COMPONENTS), list(UNITS)
        if "pulses" in content:
            file["rotor/pulse_times"] = content["pulses"]
