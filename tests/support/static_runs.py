"""Static runs of a small rig with known matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from tests.support.rigs import rotor_balance

AMPLITUDE = np.array([800.0, 800.0, 3500.0, 400.0, 400.0, 450.0])


def loading(trim_load=(0, 0, 0, 0, 0, 0), components=COMPONENTS, scale=1.0):
    """Loads (m, 6): each component up, down, to the other side and back, about a trim."""
    rows = [np.zeros(6)]
    for name in components:
        j = COMPONENTS.index(name)
        rows += [scale * step * AMPLITUDE[j] * np.eye(6)[j] for step in STEPS]
    return np.array(rows) + np.asarray(trim_load, float)


def static_run(geometry, C0, loads, rng=None, name="s1", trim="bare", offset=0.0, noise=2e-4, load_noise=0.05):
    """A static run; the loads are read with noise where they are applied, as an exciter's force cell does."""
    names = tuple(c.name for c in geometry.channels if c.measures_dc)
    # A computed channel needs some noise, or it would be dead while other components are loaded.
    channels = offset + loads @ C0.T + 1e-11 * np.random.default_rng(0).normal(size=(len(loads), len(C0)))
    read = loads.copy()
    if rng is not None:
        channels = channels + noise * rng.normal(size=channels.shape)
        read = loads + np.where(loads != 0, load_noise, 0.0) * rng.normal(size=loads.shape)
    return Run(name, geometry.rig, "static", names, len(loads), MemorySource(channels, read), trim=trim)


def without(run, *channels):
    keep = [j for j, name in enumerate(run.channel_names) if name not in channels]
    block = run.read()
    source = MemorySource(block.channels[:, keep], block.loads)
    return replace(run, channel_names=tuple(run.channel_names[j] for j in keep), source=source)


RIG = rotor_balance()


STEPS = np.concatenate([np.arange(1, 6), np.arange(4, -6, -1), np.arange(-4, 1)]) / 5


def rigid_matrix(geometry, on_plate=False):
    """C0 (dc channels, 6) by equilibrium of wrenches about the rig's origin, the cells' forces by their stiffness.

    The moment of the hub about a shaft goes through its torque meter; loads `on_plate` go beside it.
    """
    cells = geometry.cells
    wrench = np.array([np.r_[c.direction, np.cross(c.position, c.direction)] for c in cells]).T
    k = np.array([c.effective_stiffness for c in cells])
    load = np.zeros((6, 6))
    for j in range(3):
        load[:, j] = np.r_[np.eye(3)[j], np.cross(geometry.hub, np.eye(3)[j])]
        load[3 + j, 3 + j] = 1.0
    meter = geometry.torque_meter
    through = None if meter is None or on_plate else 3 + "xyz".index(meter.axis)
    if through is not None and meter.carried_by == "ground":
        load[:, through] = 0.0
    motion = np.linalg.lstsq(wrench * k @ wrench.T, load, rcond=None)[0]
    force = dict(zip(geometry.cell_names, k[:, None] * wrench.T @ motion, strict=True))
    torque = np.zeros(6) if through is None else np.eye(6)[through]
    channels = [c for c in geometry.channels if c.measures_dc]
    return np.array([c.sensitivity * (torque if c.cell is None else force[c.cell]) for c in channels])


C0 = rigid_matrix(RIG)
