"""A balance with two degrees of freedom, its rotor loads, and the errors of its model.

A plate with a mast, free to move along x and to pitch, on one horizontal and two vertical cells; a rotor harmonic lies
near each of its two resonances. The reduction always uses the declared rig; the true rig differs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.simulation import RotorPlan, StaticPlan, TrueRig, true_rig
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.extensions.signals import TimeDelay
from balance_cli.simulation.load_signals import OVERSAMPLING
from balance_cli.simulation.preset_plans import HARMONIC_SHAPE
from balance_cli.simulation.rotor import smooth_step

Array = NDArray[np.float64]

CARRIED = ("Fx", "My")
COLUMNS = [COMPONENTS.index(name) for name in CARRIED]
SAMPLE_RATE = 800.0
NOMINAL_SPEED = 17.5
OFF_NOMINAL = 1.02
DRIFT, DRIFT_PERIOD = 0.02, 9.0
STIFFNESS, DAMPING, SENSITIVITY = 0.04, 0.3, 0.03
"""Relative standard deviations of the errors of the declared rig."""
PIEZO_DELAY = 2.5e-4
"""Delay [s] of the piezo channels that the model lacks: 13 degrees at 8/rev."""
LOAD_GROWTH, RISE_TIME = 0.6, 0.3
"""Relative change of all loads in a maneuver, and the time [s] that it takes."""
FIRST_HARMONIC = {"Fx": 33.0, "My": 15.0}
STEADY = {"Fx": 100.0, "My": -20.0}
TURBULENCE = {"Fx": 3.0, "My": 1.5}
"""Random loads [N, N m], rms, within 0.5 to 100 Hz."""
TURBULENCE_CORNER = 100.0
"""Corner frequency [Hz] of turbulence without band limit."""
STEP = 1.0 / (OVERSAMPLING * SAMPLE_RATE)
"""Step [s] of the time grid of the loads."""


@dataclass(frozen=True)
class Maneuver(Extension):
    """The loads of a wind-on run grow by LOAD_GROWTH at the time `start` [s]."""

    name: ClassVar[str] = "maneuver"
    start: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """Return the loads (n, 6) that act."""
        if kind != "wind":
            return loads
        time = np.arange(len(loads)) * STEP
        return np.asarray(loads * (1.0 + LOAD_GROWTH * smooth_step(time, self.start, RISE_TIME))[:, None])


@dataclass(frozen=True)
class BroadTurbulence(Extension):
    """Turbulence of a wind-on run without band limit: exponentially correlated, with the rms of TURBULENCE."""

    name: ClassVar[str] = "broad turbulence"
    seed: int = 0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """Return the loads (n, 6) that act."""
        if kind != "wind":
            return loads
        rng, memory = np.random.default_rng(self.seed), np.exp(-2 * np.pi * TURBULENCE_CORNER * STEP)
        rms = np.array(list(TURBULENCE.values()))
        driven = np.sqrt(1 - memory**2) * rms * rng.standard_normal((len(loads), len(rms)))
        driven[0] /= np.sqrt(1 - memory**2)
        turbulent_loads = loads.copy()
        turbulent_loads[:, COLUMNS] += scipy.signal.lfilter([1.0], [1.0, -memory], driven, axis=0)
        return turbulent_loads


@dataclass(frozen=True)
class FilterCase:
    """One case of the study: the true rig, the rotor speed and the turbulence.

    `tolerances` are declared, so that the reduction knows which properties of the rig are uncertain, and by how much.
    """

    name: str
    rig: Callable[[Geometry, np.random.Generator, float], TrueRig]
    speed: float = NOMINAL_SPEED
    drift: float = 0.0
    turbulence: Mapping[str, float] = field(default_factory=lambda: TURBULENCE)
    tolerances: Mapping[str, float] = field(default_factory=dict)


def two_degree_geometry(tolerances: Mapping[str, float]) -> Geometry:
    """Return the declared rig, with modes near 2/rev and 4/rev and damping ratios of 1 %."""
    cells = {"x": ([0.0, 0.0, -0.05], [1, 0, 0], 6.2e6), "z1": ([0.36, 0.0, -0.05], [0, 0, 1], 8.4e6)}
    cells["z2"] = ([-0.36, 0.0, -0.05], [0, 0, 1], 8.4e6)
    strain = [{"name": f"{name}.strain", "cell": name, "sensitivity": 0.002, "lowpass": 90.0} for name in cells]
    piezo = [{"name": f"{name}.piezo", "cell": name, "sensitivity": 0.01, "time_constant": 3.0} for name in cells]
    plate = {"name": "plate", "mass": 80.0, "position": [0, 0, 0], "inertia": {"xx": 3.0, "yy": 5.0, "zz": 6.0}}
    mast = {"name": "mast", "mass": 40.0, "position": [0, 0, 0.45], "inertia": {"xx": 2.0, "yy": 2.0, "zz": 0.5}}
    return geometry_from_dict(
        {
            "format": "balance-geometry/1",
            "name": "two freedoms",
            "rig": "TWO",
            "hub": [0.0, 0.0, 0.78],
            "bodies": [plate, mast],
            "cells": [
                {"name": name, "position": position, "axis": axis, "stiffness": stiffness, "full_range": 5000.0}
                for name, (position, axis, stiffness) in cells.items()
            ],
            "channels": strain + piezo,
            "acquisition": {"filter": {"type": "butterworth", "order": 6, "cutoff": 200.0}},
            "damping_ratio": 0.01,
            "tolerances": dict(tolerances),
            "rotor": {"blades": 4, "speed": NOMINAL_SPEED},
            "freedom": ["x", "theta"],
        }
    )


def _declared_rig(geometry: Geometry, rng: np.random.Generator, duration: float) -> TrueRig:
    return true_rig(geometry)


def _rig_with_wrong_modes(geometry: Geometry, rng: np.random.Generator, duration: float) -> TrueRig:
    """Return a rig whose cell stiffness and modal damping are not as declared."""
    stiffness = np.array([cell.effective_stiffness for cell in geometry.cells])
    return true_rig(
        geometry,
        stiffness=stiffness * (1 + STIFFNESS * rng.standard_normal(len(stiffness))),
        damping_ratios=geometry.damping_ratio * np.exp(DAMPING * rng.standard_normal(len(geometry.freedom))),
    )


def _rig_with_wrong_channels(geometry: Geometry, rng: np.random.Generator, duration: float) -> TrueRig:
    """Return a rig whose sensitivities are not as declared and whose piezo channels are delayed."""
    sensitivity = np.array([channel.sensitivity for channel in geometry.channels])
    rig = true_rig(geometry, sensitivities=sensitivity * (1 + SENSITIVITY * rng.standard_normal(len(sensitivity))))
    piezo = tuple(channel.name for channel in geometry.channels if not channel.measures_dc)
    return rig.with_extensions(TimeDelay(where=piezo, delay=PIEZO_DELAY))


def _rig_in_maneuver(geometry: Geometry, rng: np.random.Generator, duration: float) -> TrueRig:
    return true_rig(geometry).with_extensions(Maneuver(start=0.55 * duration))


def _rig_in_broad_turbulence(geometry: Geometry, rng: np.random.Generator, duration: float) -> TrueRig:
    return true_rig(geometry).with_extensions(BroadTurbulence(seed=int(rng.integers(2**31))))


EXACT, BROAD, SYSTEM, CHANNELS = "exact model", "exact model, broad turbulence", "system matrix wrong", "T wrong"
OFF_SPEED, DRIFTING, MANEUVER = "speed 2 % off", "speed drifts by 2 %", "maneuver"
CASES = {
    case.name: case
    for case in (
        FilterCase(EXACT, _declared_rig),
        FilterCase(BROAD, _rig_in_broad_turbulence, turbulence={}),
        FilterCase(SYSTEM, _rig_with_wrong_modes, tolerances={"stiffness": STIFFNESS, "damping_ratio": DAMPING}),
        FilterCase(CHANNELS, _rig_with_wrong_channels, tolerances={"sensitivity": SENSITIVITY}),
        FilterCase(OFF_SPEED, _declared_rig, speed=OFF_NOMINAL * NOMINAL_SPEED),
        FilterCase(DRIFTING, _declared_rig, drift=DRIFT),
        FilterCase(MANEUVER, _rig_in_maneuver),
    )
}


def static_plan() -> StaticPlan:
    """Return the plan of the static calibration of a case."""
    return StaticPlan(run="static", largest={"Fx": 800.0, "My": 400.0})


def rotor_plan(case: FilterCase, duration: float) -> RotorPlan:
    """Return the plan of the wind-on run of a case."""
    plan = RotorPlan(
        run="wind",
        kind="wind",
        sample_rate=SAMPLE_RATE,
        rotor_speed=case.speed,
        duration=duration,
        harmonics={name: tuple(first * x for x in HARMONIC_SHAPE) for name, first in FIRST_HARMONIC.items()},
        steady=STEADY,
    )
    changes = {"turbulence": case.turbulence, "drift": case.drift, "drift_period": DRIFT_PERIOD}
    return plan.model_copy(update=changes)
