"""Loads of sampled runs on a fine grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.declared_values import Vector
from balance_cli.simulation.excitation import (
    MultisineLines,
    half_sine_hits,
    multisine,
    multisine_lines,
    random_noise,
    sine_sweep,
    stepped_sine,
)
from balance_cli.simulation.plans import RotorPlan, SampledPlan, SweepPlan, ZeroPlan
from balance_cli.simulation.rotor import RotorKinematics, harmonic_load, smooth_step
from balance_cli.simulation.statics import load_row

Array = NDArray[np.float64]

OVERSAMPLING = 8
"""Steps of the fine grid per sample; at 800 Hz the interpolation is then exact to 1e-7 up to 200 Hz."""

CONTACT_OVERSAMPLING = 16
"""The same where a force has kinks, as that of a contact that slips: they cost accuracy with the square of the step."""

TAIL_SAMPLES = 8
"""Samples computed beyond the end, for channels that run ahead of time (by up to 10 ms at 800 Hz)."""


HIT_TAPER = 0.8
"""Part of the frequencies between the band and half of the sample rate in which the force of a hit falls to zero."""


@dataclass(frozen=True)
class Grid:
    """The fine grid of a record: `samples` at `sample_rate` [Hz], each divided into `oversampling` steps."""

    samples: int
    sample_rate: float
    oversampling: int = OVERSAMPLING

    @property
    def step(self) -> float:
        """Step of the fine grid [s]."""
        return 1 / (self.oversampling * self.sample_rate)

    @property
    def fine_time(self) -> Array:
        """Times of the fine grid [s], a little beyond the end."""
        return np.arange(self.oversampling * (self.samples + TAIL_SAMPLES), dtype=float) * self.step

    @property
    def time(self) -> Array:
        """Times of the samples [s]."""
        return np.arange(self.samples, dtype=float) / self.sample_rate


def record_grid(plan: SampledPlan, oversampling: int) -> Grid:
    """The grid of a planned record."""
    return Grid(round(plan.duration * plan.sample_rate), plan.sample_rate, oversampling)


def _sweep_component(plan: SweepPlan, index: int, time: Array, rng: np.random.Generator) -> Array:
    level, band = plan.level[index], plan.band
    # Components that are excited together must not be proportional.
    ahead = index * plan.period / len(plan.excited)
    frequencies = np.roll(np.geomspace(*band, plan.steps), index * plan.steps // len(plan.excited))
    wave: dict[str, Callable[[], Array]] = {
        "multisine": lambda: multisine(sweep_lines(plan, index, rng), time),
        "random": lambda: random_noise(time, band, level, rng),
        "sine-sweep": lambda: sine_sweep(time + ahead, plan.period, band, level),
        "stepped": lambda: stepped_sine(time, frequencies, plan.duration / plan.steps, level),
        "impact": lambda: _hits(plan, time),
    }
    return wave[plan.excitation]()


def _hits(plan: SweepPlan, time: Array) -> Array:
    """Hits of a hammer; their force ends between the band and half of the sample rate."""
    assert plan.contact is not None
    end = plan.band[1] + HIT_TAPER * (0.5 * plan.sample_rate - plan.band[1])
    return half_sine_hits(time, plan.period, plan.contact, plan.level[0], (plan.band[1], end))


def sweep_lines(plan: SweepPlan, index: int, rng: np.random.Generator) -> MultisineLines:
    """Lines of the multisine on the excited component of this index."""
    every, shift = (len(plan.excited), index) if plan.interleaved else (1, 0)
    return multisine_lines(plan.period, plan.band, plan.level[index], rng, every, shift, plan.phases, plan.power)


def sweep_loads(plan: SweepPlan, time: Array, rng: np.random.Generator, hub: Vector) -> Array:
    """Loads (n, 6) of the exciters at `time` (n,), and the steady ones, at the `hub` (3,) [m]."""
    loads = np.zeros((len(time), len(COMPONENTS)))
    for index, name in enumerate(plan.excited):
        loads[:, COMPONENTS.index(name)] = _sweep_component(plan, index, time, rng)
    if plan.point is not None:
        loads = loads[:, [COMPONENTS.index(plan.excited[0])]] * plan.point.wrench(hub)
    return loads + load_row(plan.steady or {})


def rotor_kinematics(plan: RotorPlan) -> RotorKinematics:
    """How the rotor of a plan turns."""
    return RotorKinematics(plan.rotor_speed, plan.drift, plan.drift_period)


def rotor_loads(plan: RotorPlan, time: Array, rng: np.random.Generator) -> Array:
    """Hub loads (n, 6) of a turning rotor at `time` (n,)."""
    azimuth = rotor_kinematics(plan).azimuth(time)
    loads = np.tile(load_row(plan.steady), (len(time), 1))
    for name, amplitudes in plan.harmonics.items():
        scatter = np.maximum(1 + plan.scatter * rng.standard_normal(len(amplitudes)), 0.1)
        phases = rng.uniform(0, 2 * np.pi, len(amplitudes))
        turned = np.concatenate([[0], np.array(amplitudes) * scatter * np.exp(1j * phases)])
        loads[:, COMPONENTS.index(name)] += harmonic_load(azimuth, turned.real, turned.imag)
    for name, level in plan.turbulence.items():
        loads[:, COMPONENTS.index(name)] += random_noise(time, plan.turbulence_band, level, rng)
    if plan.step:
        ramp = smooth_step(time, plan.step.time, plan.step.duration)
        loads += np.outer(ramp, load_row(plan.step.loads))
    return loads


def attached_exciters(plan: SampledPlan) -> tuple[str, ...]:
    """Components whose exciters are attached in a run: those that a sweep excites or a check run applies."""
    match plan:
        case SweepPlan():
            return plan.excited if plan.point is None else ()
        case RotorPlan(kind="check"):
            return tuple(dict.fromkeys((*plan.harmonics, *plan.steady, *plan.turbulence)))
        case _:
            return ()


def planned_loads(plan: SampledPlan, grid: Grid, rng: np.random.Generator, hub: Vector) -> Array:
    """Loads (n, 6) of a run on the fine grid, as the exciters' force cells measure them; the same on every grid."""
    match plan:
        case SweepPlan():
            return sweep_loads(plan, grid.fine_time, rng, hub)
        case RotorPlan():
            return rotor_loads(plan, grid.fine_time, rng)
        case ZeroPlan():
            return np.zeros((len(grid.fine_time), len(COMPONENTS)))
