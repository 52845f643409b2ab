"""Causes that no effect of the library describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from studies.blind.hidden import Cause, Hidden, beside, draw_channel, largest_elongation, padded, point_rows
from studies.blind.physics import Law, Mechanics, add_coordinate
from studies.blind.records import Record, Truth

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def relaxing_hose(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: a rubber hose, three springs beside springs in series with dashpots."""
    N = point_rows(truth.rig.radius * rng.uniform(-1, 1, 3))
    k = np.mean(truth.rig.stiffness) * rng.uniform(0.005, 0.03, 3)
    K = padded(N.T @ np.diag(k) @ N, truth.mechanics.size)
    time = 1 / (2 * np.pi * float(np.exp(np.mean(np.log(truth.rig.modes)))) * rng.uniform(0.3, 3))
    mechanics = replace(truth.mechanics, K=truth.mechanics.K + K, relaxing=((rng.uniform(0.3, 1.5) * K, time),))
    return Hidden("", {}, replace(truth, mechanics=mechanics))


def bilinear_cell(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: a spring beside a cell that acts in compression only."""
    i = int(rng.integers(0, len(truth.rig.stiffness)))
    k = truth.rig.stiffness[i] * rng.uniform(0.01, 0.05)
    law = Law(i, lambda d, state: k * np.minimum(d, 0))
    return beside(truth, law, "", {})


def close_tuned_masses(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: two cables that swing at frequencies within 4 % of each other."""
    f = float(np.exp(rng.uniform(*np.log(truth.rig.modes[[0, -1]]))))
    mechanics, size = truth.mechanics, truth.mechanics.size
    for factor in (1.0, 1 + rng.uniform(0.01, 0.04)):
        m = truth.rig.mass * rng.uniform(0.003, 0.01)
        row = point_rows(truth.rig.radius * rng.uniform(-1, 1, 3))[int(rng.integers(0, 3))]
        k, d = m * (2 * np.pi * factor * f) ** 2, 2 * 0.02 * m * 2 * np.pi * factor * f
        mechanics = add_coordinate(mechanics, m, 0.0, 0.0)
        across = np.zeros(mechanics.size)
        across[:6], across[-1] = row, -1
        mechanics = replace(
            mechanics, K=mechanics.K + k * np.outer(across, across), D=mechanics.D + d * np.outer(across, across)
        )
    assert mechanics.size == size + 2
    return Hidden("", {}, replace(truth, mechanics=mechanics))


def two_seals(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: two seals beside a cell, one of which slips ten times as late as the other."""
    i, d = int(rng.integers(0, len(truth.rig.stiffness))), largest_elongation(truth)
    force, kappa = truth.rig.stiffness[i] * d * rng.uniform(0.005, 0.02), 0.1 * truth.rig.stiffness[i]
    for limit in (force, 10 * force):
        law = Law(
            i,
            lambda x, slider, limit=limit: np.clip(kappa * (x - slider), -limit, limit),  # type: ignore[misc]
            lambda x, slider, limit=limit: np.clip(slider, x - limit / kappa, x + limit / kappa),  # type: ignore[misc]
        )
        truth = beside(truth, law, "", {}).truth
    return Hidden("", {}, truth)


def warming_cells(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: two cells soften in the course of each record, and are cold again at the start of the next."""
    pair, share = rng.choice(len(truth.rig.stiffness), 2, replace=False), rng.uniform(0.01, 0.05)

    def warm(mechanics: Mechanics) -> Mechanics:
        k = mechanics.stiffness.copy()
        k[pair] *= 1 - share
        return replace(mechanics, stiffness=k)

    return Hidden("", {}, replace(truth, at_the_end=warm))


def spinning_mode(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: a part of the rotor swings along one axis, the faster the stiffer."""
    axis, m = int(rng.integers(0, 2)), truth.rig.mass * rng.uniform(0.01, 0.03)
    f = float(np.exp(rng.uniform(*np.log(truth.rig.modes[[0, -1]]))))
    row, growth = point_rows(truth.rig.hub)[axis], rng.uniform(1.5, 3.0)
    bare = add_coordinate(truth.mechanics, m, 0.0, 0.0)
    across = np.zeros(bare.size)
    across[:6], across[-1] = row, -1

    def per_run(mechanics: Mechanics, record: Record) -> Mechanics:
        w2 = (2 * np.pi * f) ** 2 + growth * record.spin**2
        spring = m * w2 * np.outer(across, across)
        damper = 2 * 0.02 * m * np.sqrt(w2) * np.outer(across, across)
        return replace(mechanics, K=bare.K + spring, D=bare.D + damper)

    rest = Record("", "static", 0.0, lambda time: np.zeros((len(time), 6)), {})
    return Hidden("", {}, replace(truth, mechanics=per_run(bare, rest), per_run=per_run))


def loosened_bolt(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: one cell loses stiffness half-way through the sweeps, and stays so in all later records."""
    cell, share = int(rng.integers(0, len(truth.rig.stiffness))), rng.uniform(0.02, 0.2)

    def per_run(mechanics: Mechanics, record: Record) -> Mechanics:
        before = record.kind == "zero" or (record.kind == "sweep" and min(record.excited) < 2)
        k = mechanics.stiffness.copy()
        k[cell] *= 1 if before else 1 - share
        return replace(mechanics, stiffness=k)

    return Hidden("", {}, replace(truth, per_run=per_run))


def common_supply(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: all channels share the impedance of a supply: each reads a share of the sum of all."""
    share, count = rng.uniform(0.001, 0.005), len(truth.rig.channels)
    mix = {(a, b): share for a in range(count) for b in range(count)}
    return Hidden("", {}, replace(truth, mix=mix))


def missing_codes(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: the converter of a channel lacks a quarter of its codes."""
    i = draw_channel(truth, rng)
    step = truth.rig.channels[i].sensitivity * 0.2 * truth.rig.mass * 9.81 * 2.0 ** -rng.integers(10, 13)

    def converted(volts: Array) -> Array:
        code = np.round(volts / step)
        place = np.mod(code, 64)
        return np.asarray(step * np.where(place < 16, code - place + 16, code))

    return Hidden("", {}, replace(truth, converter={i: converted}))


def stribeck_seal(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: a seal beside a cell whose friction falls with the velocity."""
    i, d = int(rng.integers(0, len(truth.rig.stiffness))), largest_elongation(truth)
    force, kappa = truth.rig.stiffness[i] * d * rng.uniform(0.01, 0.04), 0.1 * truth.rig.stiffness[i]
    speed = 2 * np.pi * truth.rig.modes[0] * d * rng.uniform(0.05, 0.2)
    law = Law(
        i,
        lambda x, slider: np.clip(kappa * (x - slider), -force, force),
        lambda x, slider: np.clip(slider, x - force / kappa, x + force / kappa),
        lambda v: 0.5 * force * np.tanh(v / (0.1 * speed)) * np.exp(-((v / speed) ** 2)),
    )
    return beside(truth, law, "", {})


def hardening_support(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: the floor under the cells yields along one axis, and hardens."""
    axis, cells, m = int(rng.integers(0, 3)), len(truth.rig.stiffness), truth.rig.mass * rng.uniform(1, 4)
    k = m * (2 * np.pi * truth.rig.modes[-1] * rng.uniform(0.6, 1.5)) ** 2
    mechanics = add_coordinate(truth.mechanics, m, 2 * 0.02 * np.sqrt(k * m), k)
    E = mechanics.E.copy()
    E[:cells, -1] = -truth.rig.axis[:, axis]
    floor = np.eye(mechanics.size)[-1]
    mechanics = replace(
        mechanics, E=np.insert(E, cells, floor, 0), stiffness=np.insert(mechanics.stiffness, cells, 0.0)
    )
    deflection = 0.06 * truth.rig.mass * 9.81 / k
    k3 = k / deflection**2 * rng.uniform(0.01, 0.05)
    law = Law(cells, lambda x, state: k3 * x**3)
    return beside(replace(truth, mechanics=mechanics), law, "", {})


def exciter_suspensions(truth: Truth, rng: np.random.Generator) -> Hidden:
    """Unknown: commands are recorded as loads, and each exciter moves on a suspension of its own."""
    dynamics: dict[int, Callable[[Array], ComplexArray]] = {}
    band = np.log([0.5 * truth.rig.modes[0], 4 * truth.rig.modes[-1]])
    for i in range(6):
        low = float(np.exp(rng.uniform(*band)))
        high = low * rng.uniform(1.05, 1.3)
        d, e = rng.uniform(0.03, 0.1, 2)
        dynamics[i] = partial(_suspended, low=low, high=high, ratios=(d, e))
    return Hidden("", {}, replace(truth, load_dynamics=dynamics))


def _suspended(f: Array, low: float, high: float, ratios: tuple[float, float]) -> ComplexArray:
    """Force per command: none at the lower frequency, much at the higher one."""
    zero, pole = (1 + 2j * d * f / f0 - (f / f0) ** 2 for d, f0 in zip(ratios, (low, high), strict=True))
    return np.asarray(zero / pole)


UNKNOWN: tuple[Cause, ...] = (
    relaxing_hose,
    bilinear_cell,
    close_tuned_masses,
    two_seals,
    warming_cells,
    spinning_mode,
    loosened_bolt,
    common_supply,
    missing_codes,
    stribeck_seal,
    hardening_support,
    exciter_suspensions,
)
