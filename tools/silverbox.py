"""The Silverbox as a balance: geometry and run files from its CSV.

    python tools/silverbox.py SNLS80mV.csv OUTDIR

A circuit that obeys m y'' + d y' + a y + b y^3 = u (Wigren and Schoukens, ECC 2013), sampled at 1e7/2^14 Hz. Its input
[V] plays the load Fz [N], its output [V] the force of a cell. The stiffness of that cell is declared as 1 N/m exactly:
it defines the unit of length. Mass, damping and sensitivity have tolerances so wide that the data decide.

The commands that use the files are in docs/silverbox.md.

Written: `geometry.yaml`; `train.h5`, the first 75 % of the multisines; `test.h5`, their rest; `arrow.h5`, noise of
growing level.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, save_geometry

RATE = 1e7 / 2**14
MULTISINES = slice(40649, 127400)
ARROW = slice(99, 40575)
TRAINING_FRACTION = 0.75

GEOMETRY = {
    "format": "balance-geometry/1",
    "name": "silverbox",
    "rig": "SILVERBOX",
    "hub": [0.0, 0.0, 0.0],
    # Approximately what the resonance near 70 Hz requires; the tolerances leave the value to the data.
    "bodies": [
        {"name": "mass", "mass": 5e-6, "position": [0.0, 0.0, 0.0], "inertia": {"xx": 1e-6, "yy": 1e-6, "zz": 1e-6}}
    ],
    "cells": [{"name": "z", "position": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "stiffness": 1.0, "full_range": 0.3}],
    "channels": [{"name": "z", "cell": "z", "sensitivity": 1.0}],
    "damping_ratio": 0.05,
    "tolerances": {"mass": 0.5, "damping_ratio": 1.0, "sensitivity": 0.5},
    "freedom": ["z"],
}


def silverbox_run(name: str, rows: np.ndarray) -> Run:
    """Return the run with a record of input and output (n, 2) [V]."""
    loads = np.zeros((len(rows), 6))
    loads[:, 2] = rows[:, 0]
    return Run(
        name=name,
        rig="SILVERBOX",
        kind="sweep",
        channel_names=("z",),
        samples=len(rows),
        source=MemorySource(rows[:, 1:], loads),
        has_loads=True,
        sample_rate=RATE,
        excited=("Fz",),
        excitation="random",
        level=(float(rows[:, 0].std()),),
    )


def silverbox_runs(csv: Path) -> dict[str, Run]:
    """Return training and test part of the multisines, and the arrow head, by name."""
    rows = np.genfromtxt(csv, delimiter=",", skip_header=1)[:, :2]
    multisines = rows[MULTISINES]
    cut = round(TRAINING_FRACTION * len(multisines))
    parts = {"train": multisines[:cut], "test": multisines[cut:], "arrow": rows[ARROW]}
    return {name: silverbox_run(name, part) for name, part in parts.items()}


def write_silverbox(csv: Path, folder: Path) -> None:
    """Write the geometry and the run files into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    save_geometry(folder / "geometry.yaml", geometry_from_dict(GEOMETRY))
    for name, run in silverbox_runs(csv).items():
        write_run(folder / f"{name}.h5", run)


def main() -> None:
    """Write the files that the command line names."""
    write_silverbox(Path(sys.argv[1]), Path(sys.argv[2]))


if __name__ == "__main__":
    main()
