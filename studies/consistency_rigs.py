"""Five rigs of different size, layout and speed, and a campaign that suits each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, load_geometry
from balance_cli.simulation import CampaignPlan, RotorPlan, StaticPlan, SweepPlan
from balance_cli.simulation.preset_plans import (
    FIRST_HARMONIC_AMPLITUDES,
    HIGH_SWEEP_LEVELS,
    STATIC_LOAD_LIMITS,
    blade_loads,
)

SAMPLE_GEOMETRY = Path(__file__).parents[1] / "configs" / "rts-6.yaml"
TOLERANCES = {
    "stiffness": 0.05,
    "mass": 0.02,
    "centre_of_gravity": 0.005,
    "inertia": 0.1,
    "damping_ratio": 0.5,
}


def _content(name: str, hub: float, mass: float, size: float, speed: float, **changes: Any) -> dict[str, Any]:
    """A rig of a plate and a mast, without its cells and channels."""
    inertia = {"xx": 0.3 * mass * size**2, "yy": 0.35 * mass * size**2, "zz": 0.4 * mass * size**2}
    upper = {"xx": 0.05 * mass * size**2, "yy": 0.05 * mass * size**2, "zz": 0.02 * mass * size**2}
    return {
        "format": "balance-geometry/1",
        "name": name,
        "rig": name,
        "hub": [0.0, 0.0, hub],
        "bodies": [
            {"name": "plate", "mass": 0.7 * mass, "position": [0.0, 0.0, 0.0], "inertia": inertia},
            {"name": "mast", "mass": 0.3 * mass, "position": [0.01 * size, 0.0, 0.4 * hub], "inertia": upper},
        ],
        "damping_ratio": 0.01,
        "tolerances": TOLERANCES,
        "rotor": {"blades": 4, "speed": speed},
        **changes,
    }


def _cell(name: str, position: tuple[float, ...], axis: tuple[float, ...], stiffness: float) -> dict[str, Any]:
    return {
        "name": name,
        "position": [float(x) for x in position],
        "axis": [float(x) for x in axis],
        "stiffness": stiffness,
        "full_range": 5000.0,
    }


def _channels(cells: list[dict[str, Any]], strain: bool, piezo: bool, torque: bool, per_newton: float) -> list[Any]:
    kinds = [{"suffix": "strain", "sensitivity": per_newton}] if strain else []
    kinds += [{"suffix": "piezo", "sensitivity": 5 * per_newton, "time_constant": 3.0}] if piezo else []
    channels: list[dict[str, Any]] = [
        {"name": f"{cell['name']}.{kind['suffix']}", "cell": cell["name"]}
        | {key: value for key, value in kind.items() if key != "suffix"}
        for kind in kinds
        for cell in cells
    ]
    return [*channels, {"name": "torque", "torque_meter": True, "sensitivity": 10 * per_newton}] if torque else channels


def inclined_rig() -> Geometry:
    """Six inclined cells as a hexapod, strain channels alone, no torque meter: no redundancy at all."""
    cells = []
    for index in range(6):
        corner = np.deg2rad(120.0 * (index // 2) + (20.0 if index % 2 else -20.0))
        foot = np.deg2rad(120.0 * ((index + 1) // 2) - 60.0 + (-15.0 if index % 2 else 15.0))
        top = np.array([0.25 * np.cos(corner), 0.25 * np.sin(corner), -0.05])
        axis = top - np.array([0.35 * np.cos(foot), 0.35 * np.sin(foot), -0.35])
        cells.append(_cell(f"c{index + 1}", tuple(top), tuple(axis / np.linalg.norm(axis)), 2.5e6))
    content = _content("HEX", 0.3, 40.0, 0.25, 22.0, cells=cells)
    return geometry_from_dict({**content, "channels": _channels(cells, True, False, False, 0.002)})


def _corner_rig(name: str, hub: float, mass: float, size: float, speed: float, stiffness: float) -> Geometry:
    """Four cells of three components each, strain and piezo channels, torque meter: 25 channels."""
    cells = []
    corners = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    for index, (x, y) in enumerate(corners, 1):
        for axis, unit, factor in (("x", (1, 0, 0), 0.7), ("y", (0, 1, 0), 0.8), ("z", (0, 0, 1), 1.5)):
            cells.append(_cell(f"{axis}{index}", (size * x, 0.8 * size * y, -0.1 * size), unit, factor * stiffness))
    meter = {"stiffness": 0.05 * stiffness * size**2, "inertia": 0.003 * mass * size**2}
    content = _content(name, hub, mass, size, speed, cells=cells, torque_meter=meter)
    return geometry_from_dict({**content, "channels": _channels(cells, True, True, True, 0.002)})


def piezo_rig() -> Geometry:
    """The sample rig with its piezo channels alone."""
    sample = load_geometry(SAMPLE_GEOMETRY)
    channels = tuple(channel for channel in sample.channels if not channel.measures_dc)
    return sample.model_copy(update={"channels": channels, "torque_meter": None, "freedom": sample.freedom})


def rigs() -> dict[str, Geometry]:
    """The rigs by a short name."""
    return {
        "sample": load_geometry(SAMPLE_GEOMETRY),
        "inclined": inclined_rig(),
        "stiff": _corner_rig("THREE", 0.5, 100.0, 0.4, 40.0, 3e7),
        "large": _corner_rig("LARGE", 1.5, 2000.0, 1.0, 4.2, 4e5),
        "piezo": piezo_rig(),
    }


TIME_SCALES = {"sample": 1.0, "inclined": 0.7, "stiff": 0.3, "large": 4.0, "piezo": 1.0}
"""Periods of the rigs' motions relative to those of the sample rig."""


def campaign_of(name: str, geometry: Geometry) -> CampaignPlan:
    """Two static runs where a channel measures them, seven sweeps (Fx at two levels) and two check runs."""
    slow = TIME_SCALES[name]
    rate = 800.0 / slow
    sweeps = [
        SweepPlan(
            run=f"sweep-{component}",
            excited=(component,),
            level=(level,),
            sample_rate=rate,
            period=4.0 * slow,
            periods=5,
            band=(2.0 / slow, 150.0 / slow),
        )
        for component, level in HIGH_SWEEP_LEVELS.items()
    ]
    low = sweeps[0].model_copy(update={"run": "sweep-Fx-low", "level": (0.4 * HIGH_SWEEP_LEVELS["Fx"],)})
    speed = geometry.rotor.speed if geometry.rotor else 17.5
    checks = [
        RotorPlan(
            run=f"check-{i}", rotor_speed=speed, sample_rate=rate, duration=20.0 * slow, harmonics=blade_loads(*pair)
        )
        for i, pair in enumerate((("Fz", "My"), ("Fx", "Mx")), 1)
    ]
    statics = [
        StaticPlan(run="static-bare", largest=STATIC_LOAD_LIMITS, steps=3),
        StaticPlan(
            run="static-trim", trim="trim", trim_loads={"Fz": 1500.0}, largest=_half(STATIC_LOAD_LIMITS), steps=3
        ),
    ]
    measures_statics = any(channel.measures_dc for channel in geometry.channels)
    return CampaignPlan(runs=(*(statics if measures_statics else []), *sweeps, low, *checks))


def _half(loads: dict[Any, float]) -> dict[Any, float]:
    return {name: 0.5 * load for name, load in loads.items()}


assert set(FIRST_HARMONIC_AMPLITUDES) == set(HIGH_SWEEP_LEVELS)
