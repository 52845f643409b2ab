"""Errors of models of the EMPS axis on the record with force pulses, which no fit may see.

    python tools/emps_errors.py DATA_EMPS_PULSES.mat OUTDIR MODEL.h5...

OUTDIR is that of `tools/emps.py`. Printed for each model, and for the published values: the force that it leaves
unexplained, M q'' + Fv q' + Fc sign(q') + offset against the measured force, both low-passed at 20 Hz, as a share of
the force; and the error of the position in a free simulation, from the recorded load alone, as a share of its rms.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.signal import butter, sosfiltfilt

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import load_artefact
from balance_cli.steps.free_simulation import simulation_error

Array = NDArray[np.float64]

RATE = 1000.0
POSITION_CUTOFF, FORCE_CUTOFF = 100.0, 20.0
"""Low-pass [Hz] of the position before it is differentiated, and of both forces."""
SETTLED = 200
"""Samples at both ends that the filters disturb."""


@dataclass(frozen=True)
class Axis:
    """Mass [kg], viscous friction [N s/m], dry friction [N] and offset [N] of the axis at its own time scale.

    `difference`: viscous friction of positive minus that of negative speeds [N s/m].
    """

    mass: float
    viscous: float
    friction: float
    offset: float
    difference: float = 0.0


PUBLISHED = Axis(95.1089, 203.5034, 20.3935, -3.1648)
"""Janot, Gautier and Brunot, Workshop on Nonlinear System Identification Benchmarks, 2019."""


def identified_axis(model: IdentifiedModel, time_factor: float) -> Axis:
    """Return what a model says of the axis, in the axis' own time."""
    value = dict(zip(model.parameters.names, model.parameters.value.tolist(), strict=True))
    mass = value["mass"] + value.get("added-mass.mass", 0.0)
    viscous = 2 * value["damping_ratio.1"] * np.sqrt(value["stiffness.x"] * value["mass"])
    friction = value.get("dry-friction@x.force", 0.0)
    # The channel reads K q in newtons: an offset of it is one of the load with the other sign.
    offset = value.get("load-offset@Fx.offset", 0.0) - value.get("channel-offset@x.offset", 0.0)
    difference = value.get("asymmetric-damping@x.difference", 0.0)
    return Axis(mass * time_factor**2, viscous * time_factor, friction, offset, difference * time_factor)


def force_residual(path: Path, axis: Axis) -> float:
    """Return the rms of the unexplained force over that of the force, of one MAT file."""
    content = loadmat(path)
    force = float(content["gtau"].item()) * content["vir"].ravel()
    position = sosfiltfilt(butter(4, POSITION_CUTOFF, fs=RATE, output="sos"), content["qm"].ravel())
    speed = np.gradient(position, 1 / RATE)
    model = axis.mass * np.gradient(speed, 1 / RATE) + axis.viscous * speed
    model = model + axis.friction * np.sign(speed) + axis.offset + 0.5 * axis.difference * np.abs(speed)
    low_pass = butter(4, FORCE_CUTOFF, fs=RATE, output="sos")
    kept = slice(SETTLED, -SETTLED)
    left, whole = (sosfiltfilt(low_pass, signal)[kept] for signal in (force - model, force))
    return float(np.linalg.norm(left) / np.linalg.norm(whole))


def main() -> None:
    """Print the errors of every model."""
    pulses, folder = Path(sys.argv[1]), Path(sys.argv[2])
    run = open_run(folder / "pulses.h5")
    settings = replace(DEFAULT_SETTINGS.free_simulation, max_samples=run.samples)
    print(f"{'':<16}{'mass':>9}{'viscous':>9}{'friction':>9}{'offset':>9}{'force %':>9}{'free %':>9}")
    rows = [("published", PUBLISHED, float("nan"))]
    for path in sys.argv[3:]:
        model = load_artefact(Path(path), {"balance-model/1": IdentifiedModel}).content
        axis = identified_axis(model, (run.sample_rate or RATE) / RATE)
        rows.append((Path(path).name, axis, 100 * simulation_error(run, model, settings)))
    for name, axis, free in rows:
        values = f"{axis.mass:9.2f}{axis.viscous:9.1f}{axis.friction:9.2f}{axis.offset:9.2f}"
        print(f"{name:<16}{values}{100 * force_residual(pulses, axis):9.2f}{free:9.1f}")


if __name__ == "__main__":
    main()
