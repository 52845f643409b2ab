"""Five balances that have little in common, and a short campaign for each: what holds for all of them is no accident.

A: six inclined cells, as many as loads. B: four three-component cells, stiff. C: twelve cells under two tonnes, slow.
D: the sample campaign's. E: twelve cells under half a kilogram, in milliseconds where the others have seconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.simulation import CampaignPlan, RotorPlan, StaticPlan, SweepPlan
from balance_cli.simulation.plans import ZeroPlan
from balance_cli.simulation.preset_plans import HARMONIC_SHAPE
from tests.support.rigs import rotor_balance

RIGS = ("A", "B", "C", "D", "E")


def other_rig(letter: str) -> Geometry:
    """Return the geometry of one of RIGS."""
    return {"A": _hexapod, "B": _four_triaxial_cells, "C": _twelve_cells, "D": rotor_balance, "E": _small}[letter]()


def short_campaign(
    letter: str, sweeps: float = 60.0, revolutions: int = 200, harmonics: tuple[float, ...] = HARMONIC_SHAPE
) -> CampaignPlan:
    """Return a campaign of one of RIGS: statics, zero, a sweep of each component, two check runs and a wind run.

    Each sweep lasts `sweeps` periods of the lowest mode or so, in six periods; check and wind runs last `revolutions`.
    """
    rig = other_rig(letter)
    assert rig.rotor is not None
    lowest, highest, rate = _TIME[letter]
    size = dict(zip(COMPONENTS, _SIZES[letter], strict=True))
    speed = rig.rotor.speed
    static = [
        StaticPlan(run="static-bare", largest={name: 10.0 * value for name, value in size.items()}, steps=4),
        StaticPlan(
            run="static-trim",
            trim="trim",
            trim_loads={"Fz": 20.0 * size["Fz"]},
            largest={name: 5.0 * value for name, value in size.items()},
            steps=4,
        ),
    ]
    period = round(sweeps / lowest / 6 * rate) / rate
    swept = [
        SweepPlan(
            run=f"sweep-{name}",
            excited=(name,),
            level=(value,),
            period=period,
            periods=6,
            band=(0.1 * lowest, highest),
            sample_rate=rate,
        )
        for name, value in size.items()
    ]
    record = {"sample_rate": rate, "rotor_speed": speed, "duration": (revolutions + 0.5) / speed}
    loads = {name: tuple(value * h for h in harmonics) for name, value in size.items()}
    rotor = [
        RotorPlan(run="check-1", harmonics={name: loads[name] for name in ("Fx", "Mz")}, **record),
        RotorPlan(run="check-2", harmonics={name: loads[name] for name in ("Fz", "My")}, **record),
        RotorPlan(
            run="wind-1",
            kind="wind",
            harmonics=loads,
            steady={"Fz": 18.0 * size["Fz"], "Mx": size["Mx"]},
            turbulence={name: 0.1 * value for name, value in size.items()},
            turbulence_band=(0.1 * lowest, highest),
            **record,
        ),
    ]
    zero = ZeroPlan(run="zero", sample_rate=rate, duration=20.0 / speed)
    return CampaignPlan(runs=(*static, zero, *swept, *rotor))


_TIME = {
    "A": (34.0, 260.0, 2000.0),
    "B": (123.0, 800.0, 4096.0),
    "C": (3.4, 50.0, 250.0),
    "D": (20.0, 150.0, 800.0),
    "E": (300.0, 5000.0, 25000.0),
}
"""Lowest mode, end of the band of the sweeps and sample rate [Hz]."""
_SIZES = {
    "A": (20.0, 20.0, 40.0, 4.0, 4.0, 4.0),
    "B": (40.0, 40.0, 80.0, 12.0, 12.0, 10.0),
    "C": (200.0, 200.0, 500.0, 200.0, 200.0, 150.0),
    "D": (40.0, 40.0, 80.0, 15.0, 15.0, 12.0),
    "E": (20.0, 20.0, 40.0, 2.0, 2.0, 2.0),
}
"""Amplitude of 1/rev and rms of a sweep of each component [N, N m]."""


def _geometry(letter: str, **content: Any) -> Geometry:
    fixed = {
        "format": "balance-geometry/1",
        "name": f"rig-{letter.lower()}",
        "rig": f"RIG-{letter}",
        "damping_ratio": 0.015,
        "tolerances": {
            "stiffness": 0.05,
            "mass": 0.02,
            "centre_of_gravity": 0.005,
            "inertia": 0.1,
            "damping_ratio": 0.5,
        },
    }
    return geometry_from_dict({**fixed, **content})


def _channels(cells: list[dict[str, Any]], strain: dict[str, Any], piezo: dict[str, Any]) -> list[dict[str, Any]]:
    """One strain and one piezo channel of each cell."""
    kinds = (("strain", strain), ("piezo", piezo))
    return [{"name": f"{c['name']}.{kind}", "cell": c["name"], **own} for kind, own in kinds for c in cells]


def _cell(name: str, position: Any, axis: Any, stiffness: float, full_range: float) -> dict[str, Any]:
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    place = [float(x) for x in position]
    return {
        "name": name,
        "position": place,
        "axis": unit.tolist(),
        "stiffness": stiffness,
        "full_range": full_range,
    }


def _body(name: str, mass: float, position: tuple[float, ...], inertia: tuple[float, ...]) -> dict[str, Any]:
    return {
        "name": name,
        "mass": mass,
        "position": list(position),
        "inertia": dict(zip(("xx", "yy", "zz"), inertia, strict=True)),
    }


def _hexapod() -> Geometry:
    """Six inclined legs between two rings; modes 34 to 75 Hz."""
    cells = []
    for i in range(6):
        foot, head = np.radians(60 * i + (8 if i % 2 else -8)), np.radians(60 * i + (-22 if i % 2 else 22))
        low = np.array([0.42 * np.cos(foot), 0.42 * np.sin(foot), -0.36])
        high = np.array([0.26 * np.cos(head), 0.26 * np.sin(head), -0.05])
        cells.append(_cell(f"l{i + 1}", high, high - low, 1.75e6 * (1 + 0.02 * i), 3000.0))
    return _geometry(
        "A",
        hub=[0.0, 0.0, 0.35],
        bodies=[
            _body("plate", 22.0, (0.0, 0.0, 0.0), (0.7, 0.75, 1.3)),
            _body("rotor drive", 18.0, (0.02, -0.01, 0.2), (0.45, 0.5, 0.2)),
        ],
        cells=cells,
        channels=_channels(
            cells, {"sensitivity": 0.004, "lowpass": 300.0}, {"sensitivity": 0.02, "time_constant": 2.0}
        ),
        acquisition={"filter": {"type": "butterworth", "order": 6, "cutoff": 500.0}},
        rotor={"blades": 3, "speed": 22.0},
    )


def _four_triaxial_cells() -> Geometry:
    """A plate on four three-component cells, and a torque meter; modes 123 to 324 Hz."""
    corners = {"a": (0.3, 0.25), "b": (0.3, -0.25), "c": (-0.3, -0.25), "d": (-0.3, 0.25)}
    axes = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    stiffness = {"x": 1.8e7, "y": 1.6e7, "z": 4.8e7}
    cells = [
        _cell(name + axis, (*place, -0.04), axes[axis], stiffness[axis], 8000.0)
        for name, place in corners.items()
        for axis in axes
    ]
    return _geometry(
        "B",
        hub=[0.0, 0.0, 0.4],
        bodies=[
            _body("plate", 60.0, (0.0, 0.0, 0.0), (1.6, 2.2, 3.4)),
            _body("gearbox", 40.0, (0.01, 0.02, 0.15), (0.8, 0.9, 0.6)),
        ],
        cells=cells,
        torque_meter={"stiffness": 2.0e5, "inertia": 0.12},
        channels=[
            *_channels(cells, {"sensitivity": 0.003, "lowpass": 600.0}, {"sensitivity": 0.015, "time_constant": 1.0}),
            {"name": "torque", "torque_meter": True, "sensitivity": 0.02},
        ],
        acquisition={"filter": {"type": "butterworth", "order": 6, "cutoff": 1200.0}},
        rotor={"blades": 4, "speed": 40.0},
    )


def _around(radius: float, height: float, vertical: float, sideways: float, full_range: float) -> list[dict[str, Any]]:
    """Twelve cells on a circle: six vertical ones, six along it."""
    cells = []
    for i in range(6):
        angle = np.radians(60 * i + 15)
        place = (radius * np.cos(angle), radius * np.sin(angle), height)
        cells.append(_cell(f"v{i + 1}", place, (0, 0, 1), vertical * (1 + 0.01 * i), full_range))
        tangent = (-np.sin(angle), np.cos(angle), 0)
        cells.append(_cell(f"t{i + 1}", place, tangent, sideways * (1 - 0.01 * i), full_range))
    return cells


def _twelve_cells() -> Geometry:
    """Two tonnes on twelve cells, and a torque meter; modes 3.4 to 21 Hz, the rotor at 4.2 Hz."""
    cells = _around(1.3, -0.2, 1.35e6, 3.4e5, 30000.0)
    return _geometry(
        "C",
        hub=[0.0, 0.0, 1.9],
        bodies=[
            _body("platform", 1300.0, (0.0, 0.0, 0.0), (420.0, 450.0, 800.0)),
            _body("nacelle", 700.0, (0.1, -0.05, 1.1), (160.0, 180.0, 120.0)),
        ],
        cells=cells,
        torque_meter={"stiffness": 9.0e5, "inertia": 150.0},
        channels=[
            *_channels(cells, {"sensitivity": 0.0004, "lowpass": 40.0}, {"sensitivity": 0.002, "time_constant": 10.0}),
            {"name": "torque", "torque_meter": True, "sensitivity": 0.002},
        ],
        acquisition={"filter": {"type": "butterworth", "order": 6, "cutoff": 62.0}},
        rotor={"blades": 5, "speed": 4.2},
    )


def _small() -> Geometry:
    """Half a kilogram on twelve cells; modes from 300 Hz up, the rotor at 170 Hz."""
    cells = _around(0.08, -0.01, 2.5e6, 8.0e5, 2000.0)
    return _geometry(
        "E",
        hub=[0.0, 0.0, 0.06],
        bodies=[
            _body("plate", 0.32, (0.0, 0.0, 0.0), (5e-4, 5.5e-4, 1e-3)),
            _body("motor", 0.18, (0.002, -0.001, 0.03), (1e-4, 1.2e-4, 8e-5)),
        ],
        cells=cells,
        channels=_channels(cells, {"sensitivity": 0.04, "lowpass": 4000.0}, {"sensitivity": 0.2, "time_constant": 0.2}),
        acquisition={"filter": {"type": "butterworth", "order": 6, "cutoff": 8000.0}},
        tolerances={"stiffness": 0.05, "mass": 0.02, "centre_of_gravity": 0.0005, "inertia": 0.1, "damping_ratio": 0.5},
        rotor={"blades": 2, "speed": 170.0},
    )
