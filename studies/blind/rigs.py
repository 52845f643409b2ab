"""Rigs drawn at random, as a declaration (the geometry file) and as the truth, which differs by the tolerances.

Nothing here imports balance_cli: axes, signs and file content follow the description of the files alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# 14 kg at 0.17 m to 3 t at 1 m: what balances of this kind weigh and measure.
REFERENCE_MASS, REFERENCE_RADIUS = 20.0, 0.19
# Ratio of the largest to the smallest singular value of the cells' rows, moments over the radius of the rig.
LARGEST_CONDITION = 8.0


@dataclass(frozen=True)
class Channel:
    """One channel: its cell (index, -1 is the torque meter), sensitivity and declared dynamics."""

    name: str
    cell: int
    sensitivity: float
    lowpass: float | None = None
    time_constant: float | None = None


@dataclass(frozen=True)
class Rig:
    """A rigid plate on cells, in SI units; rows of `axis` are the cells' unit vectors, `inertia` is about `cg`."""

    hub: Array
    mass: float
    cg: Array
    inertia: Array
    position: Array
    axis: Array
    stiffness: Array
    damping_ratio: Array
    channels: tuple[Channel, ...]
    filter_order: int
    filter_cutoff: float
    sample_rate: float
    rotor_speed: float
    blades: int
    radius: float
    torque: tuple[float, float, float] | None = None
    """Stiffness [N m/rad], inertia [kg m2] and damping ratio of the torque meter."""

    @property
    def modes(self) -> Array:
        """Undamped eigenfrequencies of the plate [Hz], rising."""
        return eigen(self)[0] / (2 * np.pi)


def cross(p: Array) -> Array:
    """Matrix of p x."""
    return np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])


def mass_matrix(mass: float, cg: Array, inertia: Array) -> Array:
    """Mass matrix (6, 6) for motions of the origin of the rig axes."""
    S = cross(cg)
    return np.block([[mass * np.eye(3), -mass * S], [mass * S, inertia - mass * S @ S]])


def cell_rows(position: Array, axis: Array) -> Array:
    """Elongations of the cells per motion of the origin (n, 6)."""
    return np.hstack([axis, np.cross(position, axis)])


def eigen(rig: Rig) -> tuple[Array, Array]:
    """Angular eigenfrequencies and mass-normalized shapes of the plate."""
    M = mass_matrix(rig.mass, rig.cg, rig.inertia)
    E = cell_rows(rig.position, rig.axis)
    L = np.linalg.inv(np.linalg.cholesky(M))
    w2, V = np.linalg.eigh(L @ (E.T * rig.stiffness) @ E @ L.T)
    return np.sqrt(w2), L.T @ V


def draw_declared(rng: np.random.Generator) -> Rig:
    """Draw a rig: cells and axes, mass 20 kg to 3 t, rotor 3 to 50 Hz, sample rate 200 Hz to 10 kHz, channels."""
    mass = float(np.exp(rng.uniform(np.log(20), np.log(3000))))
    R = REFERENCE_RADIUS * (mass / REFERENCE_MASS) ** (1 / 3) * rng.uniform(0.9, 1.6)
    position, axis = _draw_cells(rng, R)
    n = len(position)
    cg = R * np.array([rng.uniform(-0.08, 0.08), rng.uniform(-0.08, 0.08), rng.uniform(0.0, 0.4)])
    across = rng.uniform(0.2, 0.35, 2)
    # No body has a moment above the sum of the two others; the largest ratio leaves room for the tolerances.
    inertia = np.diag(mass * R**2 * np.append(across, across.sum() * rng.uniform(0.6, 0.8)))
    rig = Rig(
        hub=np.array([0.0, 0.0, R * rng.uniform(0.6, 1.6)]),
        mass=mass,
        cg=cg,
        inertia=inertia,
        position=position,
        axis=axis,
        stiffness=rng.uniform(0.8, 1.2, n),
        damping_ratio=np.full(6, float(np.round(rng.uniform(0.008, 0.03), 4))),
        channels=(),
        filter_order=int(rng.choice([4, 6, 8])),
        filter_cutoff=1.0,
        sample_rate=1.0,
        rotor_speed=1.0,
        blades=int(rng.integers(2, 6)),
        radius=R,
    )
    lowest = float(10 * (300 / mass) ** 0.35 * np.exp(rng.uniform(0, np.log(3.5))))
    rig = replace(rig, stiffness=rig.stiffness * (lowest / rig.modes[0]) ** 2)
    return _with_acquisition(rig, rng)


def _draw_cells(rng: np.random.Generator, R: float) -> tuple[Array, Array]:
    """Six to twelve cells around a circle, upright and along it, inclined; at least three of each kind."""
    n = int(rng.integers(6, 13))
    while True:
        upright = rng.permutation(n) < max(3, n // 2)
        angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.2, 0.2, n)) / n + rng.uniform(0, 6.28)
        radial = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
        position = R * (radial * rng.uniform(0.8, 1.1, (n, 1)) + np.array([0, 0, -0.2]))
        along = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(n)]) * rng.choice([-1, 1], (n, 1))
        axis = np.where(upright[:, None], np.array([0.0, 0.0, 1.0]), along + rng.normal(0, 0.6, (n, 1)) * radial)
        axis = axis + rng.normal(0, 0.25 * rng.integers(0, 2), (n, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        rows = cell_rows(position, axis) / np.array([1, 1, 1, R, R, R])
        if np.linalg.cond(rows) < LARGEST_CONDITION:
            return position, axis


def _with_acquisition(rig: Rig, rng: np.random.Generator) -> Rig:
    """The rig with rotor, torque meter, rates, filter and channels."""
    lowest, highest = rig.modes[0], rig.modes[-1]
    rotor = float(np.clip(np.round(lowest * np.exp(rng.uniform(np.log(0.15), np.log(0.9))), 2), 3, 50))
    band = max(1.2 * highest, 8.6 * rotor)
    rate = float(np.round(np.clip(band * rng.uniform(3.5, 6), 200, 10000)))
    cutoff = float(np.round(min(0.4 * rate, band * rng.uniform(1.1, 1.8)), 1))
    kinds = [("strain", "piezo"), ("strain", "piezo"), ("strain",)][rng.integers(0, 3)]
    force = rig.mass * 9.81
    channels = []
    for kind in kinds:
        lowpass = float(np.round(band * rng.uniform(0.6, 2), 1)) if kind == "strain" and rng.random() < 0.7 else None
        constant = float(np.round(rng.uniform(8, 40) / rotor, 2)) if kind == "piezo" else None
        gain = float(f"{(8.0 if kind == 'strain' else 60.0) / force:.3g}")
        channels += [Channel(f"c{i + 1}.{kind}", i, gain, lowpass, constant) for i in range(len(rig.stiffness))]
    torque = None
    if rng.random() < 0.5:
        inertia = float(f"{rig.inertia[2, 2] * 0.1:.3g}")
        stiffness = float(f"{inertia * (2 * np.pi * lowest * rng.uniform(1.2, 3)) ** 2:.4g}")
        torque = (stiffness, inertia, float(rig.damping_ratio[0]))
        channels.append(Channel("torque", -1, float(f"{40.0 / (force * rig.radius):.3g}")))
    return replace(
        rig,
        rotor_speed=rotor,
        sample_rate=rate,
        filter_cutoff=cutoff,
        channels=tuple(channels),
        torque=torque,
    )


TOLERANCES = {"stiffness": 0.05, "mass": 0.02, "inertia": 0.1, "damping_ratio": 0.5}
# The tolerance of the center of gravity over the radius of the rig: 5 mm at 0.3 m.
CG_TOLERANCE = 0.015


def draw_true(declared: Rig, rng: np.random.Generator) -> Rig:
    """Draw the truth: the declared values, each off by its tolerance at random."""
    scale = np.sqrt(np.diag(declared.inertia))
    tilt = np.zeros((3, 3))
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        tilt[i, j] = tilt[j, i] = TOLERANCES["inertia"] * rng.normal() * scale[i] * scale[j] * 0.6
    damping = np.clip(declared.damping_ratio * (1 + TOLERANCES["damping_ratio"] * rng.normal(size=6)), 0.004, None)
    torque = declared.torque
    if torque is not None:
        torque = (torque[0] * (1 + 0.05 * rng.normal()), torque[1] * (1 + 0.1 * rng.normal()), torque[2])
    return replace(
        declared,
        mass=declared.mass * (1 + TOLERANCES["mass"] * rng.normal()),
        cg=declared.cg + CG_TOLERANCE * declared.radius * rng.normal(size=3),
        inertia=declared.inertia + tilt,
        stiffness=declared.stiffness * (1 + TOLERANCES["stiffness"] * rng.normal(size=len(declared.stiffness))),
        damping_ratio=damping,
        torque=torque,
    )


def geometry_content(rig: Rig, name: str) -> dict[str, Any]:
    """Content of the geometry file that declares a rig, its mass as two bodies."""
    offset = np.array([0.0, 0.0, 0.15 * rig.radius])
    lower, upper = 0.6 * rig.mass, 0.4 * rig.mass
    # The two bodies' own inertia is what is left of the whole after their distance.
    spread = rig.mass * (cross(offset) @ cross(offset).T) * (2 / 3)
    left = np.diag(rig.inertia - spread)
    bodies = [
        _body("plate", lower, rig.cg - offset * (2 / 3), 0.5 * left),
        _body("drive", upper, rig.cg + offset, 0.5 * left),
    ]
    cells = [
        {
            "name": f"c{i + 1}",
            "position": p.tolist(),
            "axis": a.tolist(),
            "stiffness": float(k),
            "full_range": float(np.round(1.5 * rig.mass * 9.81, 0)),
        }
        for i, (p, a, k) in enumerate(zip(rig.position, rig.axis, rig.stiffness, strict=True))
    ]
    content: dict[str, Any] = {
        "format": "balance-geometry/1",
        "name": name,
        "rig": name.upper(),
        "hub": rig.hub.tolist(),
        "bodies": bodies,
        "cells": cells,
        "channels": [_channel(channel) for channel in rig.channels],
        "acquisition": {
            "filter": {"type": "butterworth", "order": rig.filter_order, "cutoff": rig.filter_cutoff},
        },
        "damping_ratio": float(rig.damping_ratio[0]),
        "tolerances": {**TOLERANCES, "centre_of_gravity": CG_TOLERANCE * rig.radius},
        "rotor": {"blades": rig.blades, "speed": rig.rotor_speed},
    }
    if rig.torque is not None:
        content["torque_meter"] = {"stiffness": rig.torque[0], "inertia": rig.torque[1]}
    return content


def _body(name: str, mass: float, position: Array, inertia: Array) -> dict[str, Any]:
    diagonal = dict(zip(("xx", "yy", "zz"), map(float, inertia), strict=True))
    return {
        "name": name,
        "mass": float(mass),
        "position": position.tolist(),
        "inertia": {**diagonal, "xy": 0.0, "xz": 0.0, "yz": 0.0},
    }


def _channel(channel: Channel) -> dict[str, Any]:
    content: dict[str, Any] = {"name": channel.name, "sensitivity": channel.sensitivity}
    content |= {"torque_meter": True} if channel.cell < 0 else {"cell": f"c{channel.cell + 1}"}
    if channel.lowpass is not None:
        content["lowpass"] = channel.lowpass
    if channel.time_constant is not None:
        content["time_constant"] = channel.time_constant
    return content
