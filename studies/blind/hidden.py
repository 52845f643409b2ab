"""What nobody declared: effects of the library by their published laws, and causes that no effect describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from studies.blind.physics import Law, Mechanics, add_coordinate
from studies.blind.records import COMPONENTS, Record, Truth
from studies.blind.rigs import cross, mass_matrix

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Hidden:
    """A cause: the label that is right (empty: none is), true parameters by name, and the truth with it."""

    label: str
    parameters: dict[str, float]
    truth: Truth


Cause = Callable[[Truth, np.random.Generator], Hidden]


def draw_channel(truth: Truth, rng: np.random.Generator) -> int:
    cells = [i for i, channel in enumerate(truth.rig.channels) if channel.cell >= 0]
    return int(rng.choice(cells))


def point_rows(p: Array) -> Array:
    return np.hstack([np.eye(3), -cross(p)])


def padded(matrix: Array, size: int) -> Array:
    left = size - len(matrix)
    return np.pad(matrix, ((0, left), (0, left)))


def largest_elongation(truth: Truth) -> float:
    """Static elongation of a cell under 2 % of the weight, about what the sweeps reach."""
    return 0.06 * truth.rig.mass * 9.81 / float(np.mean(truth.rig.stiffness))


def nothing(truth: Truth, rng: np.random.Generator) -> Hidden:
    """No cause."""
    return Hidden("", {}, truth)


def channel_gain(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A wrong sensitivity."""
    i, gain = draw_channel(truth, rng), 1 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.05)
    dynamics = {**truth.dynamics, i: lambda f: np.full(len(f), gain, complex)}
    return Hidden(f"channel-gain@{truth.rig.channels[i].name}", {"gain": gain}, replace(truth, dynamics=dynamics))


def time_delay(truth: Truth, rng: np.random.Generator) -> Hidden:
    """One channel late."""
    i, delay = draw_channel(truth, rng), rng.uniform(0.1, 0.8) / truth.rig.sample_rate
    dynamics = {**truth.dynamics, i: lambda f: np.exp(-2j * np.pi * f * delay)}
    return Hidden(f"time-delay@{truth.rig.channels[i].name}", {"delay": delay}, replace(truth, dynamics=dynamics))


def low_pass(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A long cable."""
    i, cutoff = draw_channel(truth, rng), truth.rig.modes[-1] * rng.uniform(2, 6)
    dynamics = {**truth.dynamics, i: lambda f: 1 / (1 + 1j * f / cutoff)}
    return Hidden(f"low-pass@{truth.rig.channels[i].name}", {"cutoff": cutoff}, replace(truth, dynamics=dynamics))


def crosstalk(truth: Truth, rng: np.random.Generator) -> Hidden:
    """One channel in another."""
    a, b = (int(i) for i in rng.choice(len(truth.rig.channels), 2, replace=False))
    fraction = rng.uniform(0.01, 0.04)
    label = f"crosstalk@{truth.rig.channels[a].name},{truth.rig.channels[b].name}"
    return Hidden(label, {"fraction": fraction}, replace(truth, mix={**truth.mix, (a, b): fraction}))


def channel_offset(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A bridge that does not read zero."""
    dc = [i for i, channel in enumerate(truth.rig.channels) if channel.time_constant is None and channel.cell >= 0]
    i = int(rng.choice(dc))
    offset = 0.02 * truth.rig.channels[i].sensitivity * truth.rig.mass * 9.81 * rng.uniform(0.2, 1)
    return Hidden(
        f"channel-offset@{truth.rig.channels[i].name}",
        {"offset": offset},
        replace(truth, offset={**truth.offset, i: offset}),
    )


def exciter_misalignment(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A shaker that also pulls sideways."""
    a, b = ((0, 2), (2, 0), (1, 2), (2, 1), (0, 1))[rng.integers(0, 5)]
    fraction = rng.choice([-1, 1]) * rng.uniform(0.01, 0.05)
    exciter = truth.exciter.copy()
    exciter[b, a] += fraction
    label = f"exciter-misalignment@{COMPONENTS[a]},{COMPONENTS[b]}"
    return Hidden(label, {"fraction": fraction}, replace(truth, exciter=exciter))


def exciter_low_pass(truth: Truth, rng: np.random.Generator) -> Hidden:
    """What is recorded as load is the command, which all exciters follow like a low-pass of first or second order."""
    band = np.log([0.5 * truth.rig.modes[0], 4 * truth.rig.modes[-1]])
    natural = float(np.exp(rng.uniform(*band)))
    ratio, order = rng.uniform(0.2, 0.8), int(rng.integers(1, 3))
    cutoff = natural if order == 1 else natural / (2 * ratio)

    def follows(f: Array) -> ComplexArray:
        return np.asarray(1 / (1 + 1j * f / cutoff - (order == 2) * (f / natural) ** 2))

    dynamics = dict.fromkeys(range(6), follows)
    return Hidden("exciter-low-pass@all", {"cutoff": cutoff}, replace(truth, load_dynamics=dynamics))


def exciter_low_passes(truth: Truth, rng: np.random.Generator) -> Hidden:
    """What is recorded are the commands, which each exciter follows with a corner of its own."""
    lowest, highest = truth.rig.modes[0], truth.rig.modes[-1]
    corners = np.exp(rng.uniform(np.log(0.5 * lowest), np.log(10 * highest), 6))
    ratios = rng.uniform(0.4, 1.0, 6)

    def follows(f: Array, corner: float, ratio: float) -> ComplexArray:
        return np.asarray(1 / (1 + 2j * ratio * f / corner - (f / corner) ** 2))

    dynamics = {i: partial(follows, corner=corners[i], ratio=ratios[i]) for i in range(6)}
    return Hidden("exciter-low-pass", {}, replace(truth, load_dynamics=dynamics))


def added_mass(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A mass far from the center."""
    m = truth.rig.mass * rng.uniform(0.05, 0.15)
    p = truth.rig.radius * rng.uniform([-1, -1, 0.5], [1, 1, 2])
    M = truth.mechanics.M + padded(mass_matrix(m, p, np.zeros((3, 3))), truth.mechanics.size)
    return Hidden("added-mass", {"mass": m}, replace(truth, mechanics=replace(truth.mechanics, M=M)))


def parallel_stiffness(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A hose."""
    k = np.mean(truth.rig.stiffness) * rng.uniform(0.005, 0.05, 3)
    N = point_rows(truth.rig.radius * rng.uniform(-1, 1, 3))
    K = truth.mechanics.K + padded(N.T @ np.diag(k) @ N, truth.mechanics.size)
    parameters = {f"stiffness_{axis}": float(value) for axis, value in zip("xyz", k, strict=True)}
    return Hidden("parallel-stiffness", parameters, replace(truth, mechanics=replace(truth.mechanics, K=K)))


def transverse_stiffness(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Every cell also holds the plate sideways."""
    k = float(np.mean(truth.rig.stiffness) * rng.uniform(0.005, 0.03))
    K = np.zeros((6, 6))
    for p, a in zip(truth.rig.position, truth.rig.axis, strict=True):
        N = point_rows(p)
        K += k * N.T @ (np.eye(3) - np.outer(a, a)) @ N
    mechanics = replace(truth.mechanics, sideways=K)
    return Hidden("transverse-stiffness@all", {"stiffness": k}, replace(truth, mechanics=mechanics))


def structural_damping(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Every cell, and the shaft of a torque meter, dissipates a fixed share in each cycle."""
    loss = rng.uniform(0.005, 0.03)
    mechanics = replace(truth.mechanics, loss_factor=loss)
    return Hidden("structural-damping@all", {"loss_factor": loss}, replace(truth, mechanics=mechanics))


def viscous_cell(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A cell is damped inside: its channels read the viscous force."""
    i = int(rng.integers(0, len(truth.rig.axis)))
    tau = _loss_at_modes(truth, rng)
    times = np.where(np.arange(len(truth.mechanics.stiffness)) == i, tau, 0.0)
    mechanics = replace(truth.mechanics, viscous_time=times)
    return Hidden(f"viscous-damping@c{i + 1}", {"damping_time": tau}, replace(truth, mechanics=mechanics))


def cell_dashpot(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A rubber boot beside a cell."""
    i = int(rng.integers(0, len(truth.rig.axis)))
    d = float(truth.rig.stiffness[i]) * _loss_at_modes(truth, rng)
    row = truth.mechanics.E[i]
    mechanics = replace(truth.mechanics, D=truth.mechanics.D + d * np.outer(row, row))
    return Hidden(f"cell-dashpot@c{i + 1}", {"damping": d}, replace(truth, mechanics=mechanics))


def parallel_dashpot(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A damper between plate and ground."""
    d = np.mean(truth.rig.stiffness) * _loss_at_modes(truth, rng) * rng.uniform(0.3, 1, 3)
    N = point_rows(truth.rig.radius * rng.uniform(-1, 1, 3))
    D = truth.mechanics.D + padded(N.T @ np.diag(d) @ N, truth.mechanics.size)
    parameters = {f"damping_{axis}": float(value) for axis, value in zip("xyz", d, strict=True)}
    return Hidden("parallel-dashpot", parameters, replace(truth, mechanics=replace(truth.mechanics, D=D)))


def _loss_at_modes(truth: Truth, rng: np.random.Generator) -> float:
    """A time [s] with a loss factor of 0.5 to 10 % in the middle of the modes."""
    middle = float(np.exp(np.mean(np.log(truth.rig.modes))))
    return float(np.exp(rng.uniform(*np.log([0.005, 0.1])))) / (2 * np.pi * middle)


def gyroscopic_coupling(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A rotor with angular momentum, in every record with the rotor turning."""
    polar = truth.rig.inertia[2, 2] * rng.uniform(0.02, 0.1)
    G = np.zeros((truth.mechanics.size, truth.mechanics.size))
    G[3, 4], G[4, 3] = polar, -polar
    mechanics = replace(truth.mechanics, G=G)
    return Hidden("gyroscopic-coupling", {"polar_inertia": polar}, replace(truth, mechanics=mechanics))


def gravity_stiffness(truth: Truth, rng: np.random.Generator) -> Hidden:
    """The weight stands above the points where the cells carry it, by their shares."""
    rig, weight = truth.rig, truth.rig.mass * 9.81
    arm = rig.position - rig.cg
    preload = np.linalg.lstsq(np.hstack([rig.axis, np.cross(arm, rig.axis)]).T, weight * np.eye(6)[2])[0]
    moment = -preload * rig.axis[:, 2] @ arm[:, 2]
    tilts = np.diag([0.0, 0, 0, 1, 1, 0])
    K = truth.mechanics.K - moment * padded(tilts, truth.mechanics.size)
    return Hidden("gravity-stiffness", {"stiffness": moment}, replace(truth, mechanics=replace(truth.mechanics, K=K)))


def support_flexibility(truth: Truth, rng: np.random.Generator) -> Hidden:
    """The floor under the cells yields along one axis."""
    axis = int(rng.integers(0, 3))
    mass = truth.rig.mass * rng.uniform(1, 4)
    stiffness = mass * (2 * np.pi * truth.rig.modes[-1] * rng.uniform(0.6, 1.5)) ** 2
    mechanics = add_coordinate(truth.mechanics, mass, 2 * 0.02 * np.sqrt(mass * stiffness), stiffness)
    E = mechanics.E.copy()
    E[: len(truth.rig.axis), -1] = -truth.rig.axis[:, axis]
    # The plate's own damping acts on the motion relative to the floor.
    T = np.zeros((6, mechanics.size))
    T[:, :6] = np.eye(6)
    T[axis, -1] = -1
    D = mechanics.D.copy()
    D[:6, :6] -= truth.mechanics.D[:6, :6]
    D += T.T @ truth.mechanics.D[:6, :6] @ T
    floor = np.zeros((6, mechanics.size))
    floor[axis, -1] = 1
    label = f"support-flexibility@{'xyz'[axis]}"
    parameters = {f"compliance_{'xyz'[axis]}": 1 / stiffness}
    return Hidden(label, parameters, replace(truth, mechanics=replace(mechanics, E=E, D=D, floor=floor)))


def tuned_mass(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A cable that swings along one axis at a point of the plate."""
    axis, m = int(rng.integers(0, 3)), truth.rig.mass * rng.uniform(0.003, 0.02)
    f = float(np.exp(rng.uniform(*np.log(truth.rig.modes[[0, -1]]))))
    row = point_rows(truth.rig.radius * rng.uniform(-1, 1, 3))[axis]
    k, d = m * (2 * np.pi * f) ** 2, 2 * 0.03 * m * 2 * np.pi * f
    mechanics = add_coordinate(truth.mechanics, m, 0.0, 0.0)
    across = np.zeros(mechanics.size)
    across[:6], across[-1] = row, -1
    mechanics = replace(
        mechanics, K=mechanics.K + k * np.outer(across, across), D=mechanics.D + d * np.outer(across, across)
    )
    return Hidden("extra-mode", {"frequency": f}, replace(truth, mechanics=mechanics))


def mains_pickup(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Hum in one channel."""
    i = draw_channel(truth, rng)
    amplitude = 1e-4 * truth.rig.channels[i].sensitivity * truth.rig.mass * 9.81 * rng.uniform(0.5, 3)
    frequency = 50 + rng.uniform(-0.1, 0.1)
    return Hidden(
        f"mains-pickup@{truth.rig.channels[i].name}",
        {"amplitude": amplitude, "frequency": frequency},
        replace(truth, mains={**truth.mains, i: (amplitude, frequency)}),
    )


def cubic_stiffness(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A spring beside a cell that hardens."""
    i, d = int(rng.integers(0, len(truth.rig.stiffness))), largest_elongation(truth)
    k3 = truth.rig.stiffness[i] / d**2 * rng.uniform(0.01, 0.05)
    law = Law(i, lambda d, state: k3 * d**3)
    return beside(truth, law, f"cubic-stiffness@c{i + 1},beside", {"k3": k3})


def dry_friction(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A seal beside a cell that slips."""
    i, d = int(rng.integers(0, len(truth.rig.stiffness))), largest_elongation(truth)
    force = truth.rig.stiffness[i] * d * rng.uniform(0.01, 0.05)
    kappa = 0.1 * truth.rig.stiffness[i]

    def advance(elongation: Array, slider: Array) -> Array:
        return np.clip(slider, elongation - force / kappa, elongation + force / kappa)

    law = Law(i, lambda d, slider: np.clip(kappa * (d - slider), -force, force), advance)
    return beside(truth, law, f"dry-friction@c{i + 1}", {"force": force})


def square_damping(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A damper beside a cell whose force grows with the square of the velocity."""
    i = int(rng.integers(0, len(truth.rig.stiffness)))
    middle = 2 * np.pi * float(np.exp(np.mean(np.log(truth.rig.modes))))
    d = largest_elongation(truth)
    c = truth.rig.stiffness[i] / (middle**2 * d) * float(np.exp(rng.uniform(*np.log([0.01, 0.1]))))
    law = Law(i, lambda d, state: np.zeros_like(d), damping=lambda v: c * np.abs(v) * v)
    return beside(truth, law, f"quadratic-damping@c{i + 1}", {"c2": c})


def free_play(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A stop beside a cell that is reached at large motions only."""
    i, gap = int(rng.integers(0, len(truth.rig.stiffness))), largest_elongation(truth) * rng.uniform(0.1, 0.3)
    k = 0.2 * truth.rig.stiffness[i]
    law = Law(i, lambda d, state: k * (np.maximum(d - gap, 0) + np.minimum(d + gap, 0)))
    return beside(truth, law, f"free-play@c{i + 1}", {"stiffness": k, "gap": gap})


def beside(truth: Truth, law: Law, label: str, parameters: dict[str, float]) -> Hidden:
    mechanics = replace(truth.mechanics, laws=(*truth.mechanics.laws, law))
    return Hidden(label, parameters, replace(truth, mechanics=mechanics))


def drifting_stiffness(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: two cells soften from run to run."""
    pair = rng.choice(len(truth.rig.stiffness), 2, replace=False)
    share = rng.uniform(0.01, 0.05)

    def per_run(mechanics: Mechanics, record: Record) -> Mechanics:
        k = mechanics.stiffness.copy()
        position = sum(map(ord, record.name)) % 11 / 10 if record.kind == "sweep" else 1.0
        k[pair] *= 1 - share * position
        return replace(mechanics, stiffness=k)

    return Hidden("", {}, replace(truth, per_run=per_run))


def exciter_mass(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A stinger's mass beyond the force cell, another in each set-up."""
    masses = truth.rig.mass * rng.uniform(0.002, 0.02, 6)

    def per_run(mechanics: Mechanics, record: Record) -> Mechanics:
        if record.kind != "sweep":
            return mechanics
        B = mechanics.B
        added = sum(masses[i] * np.outer(B[:6, i % 3], B[:6, i % 3]) for i in record.excited)
        return replace(mechanics, M=mechanics.M + padded(np.asarray(added), mechanics.size))

    return Hidden("exciter-mass", {}, replace(truth, per_run=per_run))


def bending_stingers(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Each stinger holds the hub across the axis of its exciter by its bending stiffness."""
    across = np.mean(truth.rig.stiffness) * rng.uniform(0.0005, 0.005, 6)

    def per_run(mechanics: Mechanics, record: Record) -> Mechanics:
        if record.kind != "sweep":
            return mechanics
        B = mechanics.B[:6, :3]
        added = np.zeros((6, 6))
        for i in record.excited:
            lateral = np.delete(B, i % 3, axis=1)
            added += across[i] * lateral @ lateral.T
        return replace(mechanics, K=mechanics.K + padded(added, mechanics.size))

    return Hidden("exciter-stiffness", {}, replace(truth, per_run=per_run))


def drifting_gain(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: the gain of a channel changes within each record."""
    i = draw_channel(truth, rng)
    return Hidden("", {}, replace(truth, drift={i: rng.uniform(0.01, 0.04)}))


def late_clock(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: half of the channels run on another clock."""
    ppm = rng.uniform(5e-6, 5e-5)
    half = range(len(truth.rig.channels) // 2)
    return Hidden("", {}, replace(truth, late_clock=dict.fromkeys(half, ppm)))


def saturation(truth: Truth, rng: np.random.Generator) -> Hidden:
    """A channel saturates softly."""
    i = draw_channel(truth, rng)
    limit = truth.rig.channels[i].sensitivity * 0.1 * truth.rig.mass * 9.81 * rng.uniform(1, 3)
    label = f"saturation@{truth.rig.channels[i].name}"
    return Hidden(label, {"compression": limit**-2}, replace(truth, saturation={i: limit}))


def nonlinear_bridges(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Every strain gauge bridge curves, by a share of its reading under half of the weight on its cell."""
    volts = np.array([channel.sensitivity for channel in truth.rig.channels]) * 0.5 * truth.rig.mass * 9.81
    bridges = [i for i, c in enumerate(truth.rig.channels) if c.time_constant is None and "torque" not in c.name]
    share = rng.uniform(5e-4, 5e-3) * rng.choice([-1, 1], len(volts)) * rng.uniform(0.3, 1, len(volts))
    curvature = {i: float(share[i] / volts[i]) for i in bridges}
    names = {f"quadratic_{truth.rig.channels[i].name}": value for i, value in curvature.items()}
    return Hidden("channel-nonlinearity@strain", names, replace(truth, curvature=curvature))


LINEAR: tuple[Cause, ...] = (
    channel_gain,
    time_delay,
    low_pass,
    crosstalk,
    channel_offset,
    exciter_misalignment,
    added_mass,
    parallel_stiffness,
    transverse_stiffness,
    structural_damping,
    gyroscopic_coupling,
    support_flexibility,
    tuned_mass,
    mains_pickup,
)
NONLINEAR: tuple[Cause, ...] = (cubic_stiffness, dry_friction)
# Most of them no effect describes.
MORE: tuple[Cause, ...] = (
    cell_dashpot,
    viscous_cell,
    parallel_dashpot,
    exciter_low_pass,
    gravity_stiffness,
    bending_stingers,
    exciter_low_passes,
    nonlinear_bridges,
)
"""Effects that the first sixty campaigns did not draw."""
OTHERS: tuple[Cause, ...] = (drifting_stiffness, free_play, saturation, exciter_mass, late_clock, drifting_gain)
