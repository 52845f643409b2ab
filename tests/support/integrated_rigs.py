"""Steady records of small rigs with forces beside a cell that depend on its rate, by Runge-Kutta steps.

Nothing of the project computes them. The laws of all cases are integrated at once, one column for each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from tests.support.rigs import one_degree_of_freedom, two_degrees_of_freedom

RATE, PERIOD, FINE = 512.0, 1.0, 16
SETTLING, RECORDED = 5, 8
"""Periods until the motion is steady, and of the record."""
COARSE = 4
"""Steps taken at once in these periods but the last, in which what that leaves decays by a factor of 50."""
BAND = (5, 120)
NOISE = 1e-4
"""Noise of a channel and of a load over its rms."""


@dataclass(frozen=True)
class Law:
    """A force of elongation d and rate v beside the first cell: `c2 |v| v + difference |v| / 2` and a contact.

    The contact is a spring `stick` [N/m] that slips at `limit` times `asymmetry` + 1 and - 1; its force times `fast` +
    (1 - `fast`) exp(-(v / `speed`)^2) acts.
    """

    c2: float = 0.0
    difference: float = 0.0
    stick: float = 0.0
    limit: float = 0.0
    asymmetry: float = 0.0
    fast: float = 1.0
    speed: float = 1.0


@dataclass(frozen=True)
class SmallRig:
    """A rig whose motions are its modes: inertia, damping and elongation of the cells per motion, what is excited."""

    geometry: Geometry
    inertia: np.ndarray
    damping: np.ndarray
    elongation: np.ndarray
    excited: tuple[str, ...]
    level: tuple[float, ...]

    @property
    def stiffness(self) -> np.ndarray:
        return np.array([cell.stiffness for cell in self.geometry.cells])


def heaving_rig() -> SmallRig:
    """One mass on one cell, 32 Hz."""
    return SmallRig(
        one_degree_of_freedom(),
        np.array([10.0]),
        2 * 0.02 * np.sqrt([4e5 * 10.0]),
        np.array([[1.0]]),
        ("Fz",),
        (60.0,),
    )


def pitching_rig() -> SmallRig:
    """A bar that heaves at 50 Hz and pitches at 76 Hz on two cells."""
    inertia, stiffness = np.array([20.0, 0.8]), np.array([2e6, 2e6 * 0.3**2])
    damping = 2 * 0.02 * np.sqrt(stiffness * inertia)
    elongation = np.array([[1.0, -0.3], [1.0, 0.3]])
    return SmallRig(two_degrees_of_freedom(), inertia, damping, elongation, ("Fz", "My"), (100.0, 20.0))


def steady_records(
    rig: SmallRig, laws: Mapping[str, Law], levels: tuple[float, ...], seed: int
) -> dict[str, list[Run]]:
    """The runs of each law, one for each level: a multisine, each load on lines of its own."""
    rng = np.random.default_rng(seed)
    count = round(RATE * PERIOD) * FINE
    loads = _multisine(rig, count, rng)
    columns = {
        item.name: np.repeat([getattr(law, item.name) for law in laws.values()], len(levels)) for item in fields(Law)
    }
    path = _integrate(rig, columns, loads, np.tile(levels, len(laws)))
    forces = (path @ rig.elongation.T) * rig.stiffness
    half = loads[::2]
    return {
        name: [
            _record(rig, f"{name}-{level:g}", forces[:, i * len(levels) + j], half * level, level, rng)
            for j, level in enumerate(levels)
        ]
        for i, name in enumerate(laws)
    }


def _multisine(rig: SmallRig, count: int, rng: np.random.Generator) -> np.ndarray:
    """One period of the loads (2 count, u), two samples a step: the load at half steps."""
    spectrum = np.zeros((count + 1, len(rig.excited)), complex)
    lines = np.arange(BAND[0] * PERIOD, BAND[1] * PERIOD, dtype=int)
    for j in range(len(rig.excited)):
        own = lines[j :: len(rig.excited)]
        spectrum[own, j] = np.exp(2j * np.pi * rng.random(len(own)))
    loads = np.fft.irfft(spectrum, 2 * count, axis=0)
    return loads / loads.std(axis=0) * rig.level


def _integrate(rig: SmallRig, law: Mapping[str, np.ndarray], loads: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Motions (count, r, n) of the last period of r columns, from rest: Runge-Kutta of fourth order."""
    row, count = rig.elongation[0], len(loads) // 2
    K = rig.elongation.T @ (rig.stiffness[:, None] * rig.elongation)
    (q, v), w = np.zeros((2, len(scale), len(rig.inertia))), np.zeros(len(scale))
    slip = [
        law["limit"] * (law["asymmetry"] + side) / np.where(law["stick"] > 0, law["stick"], 1.0) for side in (-1, 1)
    ]

    def acceleration(q, v, u):
        d, rate = q @ row, v @ row
        falling = law["fast"] + (1 - law["fast"]) * np.exp(-((rate / law["speed"]) ** 2))
        f = law["stick"] * np.clip(d - w, *slip) * falling
        f += np.abs(rate) * (law["c2"] * rate + 0.5 * law["difference"])
        return (np.outer(scale, u) - v * rig.damping - q @ K - np.outer(f, row)) / rig.inertia

    path = np.empty((count, len(scale), len(rig.inertia)))
    for stride in (*[COARSE] * (SETTLING - 1), 1, 1):
        h = stride * PERIOD / count
        for i in range(0, count, stride):
            path[i] = q
            u0, u1, u2 = (loads[j % len(loads)] for j in (2 * i, 2 * i + stride, 2 * i + 2 * stride))
            a1 = acceleration(q, v, u0)
            v2 = v + h / 2 * a1
            a2 = acceleration(q + h / 2 * v, v2, u1)
            v3 = v + h / 2 * a2
            a3 = acceleration(q + h / 2 * v2, v3, u1)
            v4 = v + h * a3
            a4 = acceleration(q + h * v3, v4, u2)
            q, v = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            w = np.clip(w, q @ row - slip[1], q @ row - slip[0])
    return path


def _record(rig: SmallRig, name: str, forces: np.ndarray, loads: np.ndarray, level: float, rng) -> Run:
    """A run of forces (count, c) and loads (count, u) of one period: band-limited samples with noise."""
    samples = round(RATE * PERIOD)
    volts = _sample(forces, samples) * [channel.sensitivity for channel in rig.geometry.channels]
    applied = np.zeros((samples, 6))
    applied[:, [COMPONENTS.index(component) for component in rig.excited]] = _sample(loads, samples)
    volts, applied = (np.tile(signals, (RECORDED, 1)) for signals in (volts, applied))
    volts, applied = (x + NOISE * x.std(axis=0) * rng.normal(size=x.shape) for x in (volts, applied))
    return Run(
        name=name,
        rig=rig.geometry.rig,
        kind="sweep",
        channel_names=rig.geometry.channel_names,
        samples=len(volts),
        source=MemorySource(volts, applied),
        has_loads=True,
        sample_rate=RATE,
        rotor_speed=0.0,
        excited=rig.excited,
        excitation="multisine",
        level=tuple(level * one for one in rig.level),
        period=PERIOD,
    )


def _sample(signals: np.ndarray, samples: int) -> np.ndarray:
    """Signals (count, s) of one period as samples, without what is above half of their rate."""
    spectrum = np.fft.rfft(signals, axis=0)[: samples // 2 + 1] * (samples / len(signals))
    spectrum[-1] = 0.0
    return np.fft.irfft(spectrum, samples, axis=0)
