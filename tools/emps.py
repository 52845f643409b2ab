"""The EMPS positioning axis as a balance: geometry and run files from its MAT files.

    python tools/emps.py DATA_EMPS.mat DATA_EMPS_PULSES.mat OUTDIR [TIME_FACTOR]

A carriage on a ball screw that obeys M q'' + Fv q' + Fc sign(q') + offset = force (Janot, Gautier and Brunot, Workshop
on Nonlinear System Identification Benchmarks, 2019), measured in closed loop at 1 kHz. A free body has no cell: a
virtual spring of STIFFNESS is added to both sides, so that the load Fx is force + K q and the cell reads K q, q counted
from the middle of the travel. Mass and damping have tolerances so wide that the data decide.

TIME_FACTOR calls the same samples faster by this factor: masses shrink by its square, damping by itself, and forces
stay.

Written: `geometry.yaml`; `train.h5`; `pulses.h5`, the record with force pulses that no fit may see.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, save_geometry

RATE = 1000.0
# With the mass of some 95 kg a resonance at 0.28 Hz: as fast as the motion, so that the spring takes part in it.
STIFFNESS = 300.0
MIDDLE = 0.123
DECLARED_MASS = 80.0


def geometry_content(time_factor: float = 1.0) -> dict[str, Any]:
    """Return the content of the geometry file."""
    mass = DECLARED_MASS / time_factor**2
    inertia = dict.fromkeys(("xx", "yy", "zz"), 0.01 * mass)
    return {
        "format": "balance-geometry/1",
        "name": "emps",
        "rig": "EMPS",
        "hub": [0.0, 0.0, 0.0],
        "bodies": [{"name": "carriage", "mass": mass, "position": [0.0, 0.0, 0.0], "inertia": inertia}],
        "cells": [
            {
                "name": "x",
                "position": [0.0, 0.0, 0.0],
                "axis": [1.0, 0.0, 0.0],
                "stiffness": STIFFNESS,
                "full_range": 40.0,
            }
        ],
        "channels": [{"name": "x", "cell": "x", "sensitivity": 1.0}],
        "damping_ratio": 0.5,
        "tolerances": {"mass": 0.5, "damping_ratio": 1.0},
        "freedom": ["x"],
    }


def emps_run(name: str, path: Path, time_factor: float = 1.0) -> Run:
    """Return the run of one MAT file: its drive force and the virtual spring as load Fx, the spring as channel."""
    content = loadmat(path)
    spring = STIFFNESS * (content["qm"].ravel() - MIDDLE)
    loads = np.zeros((len(spring), 6))
    loads[:, 0] = float(content["gtau"].item()) * content["vir"].ravel() + spring
    return Run(
        name=name,
        rig="EMPS",
        kind="sweep",
        channel_names=("x",),
        samples=len(spring),
        source=MemorySource(spring[:, None], loads),
        has_loads=True,
        sample_rate=RATE * time_factor,
        excited=("Fx",),
        excitation="random",
        level=(float(loads[:, 0].std()),),
    )


def write_emps(train: Path, pulses: Path, folder: Path, time_factor: float) -> None:
    """Write the geometry and the run files into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    save_geometry(folder / "geometry.yaml", geometry_from_dict(geometry_content(time_factor)))
    for name, path in (("train", train), ("pulses", pulses)):
        write_run(folder / f"{name}.h5", emps_run(name, path, time_factor))


def main() -> None:
    """Write the files that the command line names."""
    train, pulses, folder = map(Path, sys.argv[1:4])
    write_emps(train, pulses, folder, float(sys.argv[4]) if len(sys.argv) > 4 else 1.0)


if __name__ == "__main__":
    main()
