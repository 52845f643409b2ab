"""Geometries that several tests share."""

from pathlib import Path

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, load_geometry

CONFIGS = Path(__file__).parents[2] / "configs"


def rotor_balance() -> Geometry:
    """The sample campaign's balance: seven cells, torque meter, strain and piezo channels."""
    return load_geometry(CONFIGS / "rts-6.yaml")


def one_degree_of_freedom(stiffness: float = 4e5, mass: float = 10.0, **changes: object) -> Geometry:
    """One mass on one vertical cell, a channel that reads its force."""
    content = {
        "format": "balance-geometry/1",
        "name": "one",
        "rig": "ONE",
        "hub": [0.0, 0.0, 0.0],
        "bodies": [
            {"name": "mass", "mass": mass, "position": [0.0, 0.0, 0.0], "inertia": {"xx": 0.1, "yy": 0.1, "zz": 0.1}}
        ],
        "cells": [
            {"name": "z", "position": [0, 0, 0], "axis": [0, 0, 1], "stiffness": stiffness, "full_range": 1000.0}
        ],
        "channels": [{"name": "z.strain", "cell": "z", "sensitivity": 0.002}],
        "damping_ratio": 0.02,
        "tolerances": {"stiffness": 0.05, "mass": 0.02, "damping_ratio": 0.5},
        "freedom": ["z"],
    }
    return geometry_from_dict({**content, **changes})


def two_degrees_of_freedom() -> Geometry:
    """A plate that heaves and pitches on two vertical cells (closed-form eigenfrequencies)."""
    cell = {"axis": [0, 0, 1], "stiffness": 1e6, "full_range": 1000.0}
    return one_degree_of_freedom(
        mass=20.0,
        bodies=[{"name": "bar", "mass": 20.0, "position": [0, 0, 0], "inertia": {"xx": 0.5, "yy": 0.8, "zz": 0.9}}],
        cells=[{"name": "a", "position": [0.3, 0, 0], **cell}, {"name": "b", "position": [-0.3, 0, 0], **cell}],
        channels=[{"name": f"{n}.strain", "cell": n, "sensitivity": 0.002} for n in "ab"],
        freedom=["z", "theta"],
    )


def angular_frequency(frequency_hz: object) -> np.ndarray:
    """2 pi f."""
    return 2 * np.pi * np.asarray(frequency_hz, float)
