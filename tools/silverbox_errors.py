"""Errors of models of the Silverbox: their output, simulated in time from the input alone, against the measured one.

    python tools/silverbox_errors.py OUTDIR MODEL.h5...

OUTDIR is that of `tools/silverbox.py`. Printed: RMSE [mV] on the test part of the multisines (simulated from the last
of those before it on), on the arrow head, and on its first 32 000 samples, whose amplitudes the training part reached;
the first 50 samples of each are left out (Wigren and Schoukens, ECC 2013). The simulation shares no code with the
model.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import load_artefact
from balance_cli.simulation import TrueRig, true_rig
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.motion import RigDynamics, nonlinear_forces
from balance_cli.simulation.rig import apply_effects

Array = NDArray[np.float64]

OVERSAMPLING = 4
TRANSIENT_SAMPLES = 50
WARM_UP_SAMPLES = 8192
"""Samples of the training part that are simulated before the test part: one multisine, in which what the simulation
begins with decays by exp(-200) (4 % of damping at 68 Hz for 13 s)."""
TRAINED_AMPLITUDE_SAMPLES = 32000
CELL_FORCES = ("cubic-stiffness", "quadratic-stiffness", "dry-friction")
CONSTANTS = ("load-offset", "channel-offset", "channel-gain")


def silverbox_rig(model: IdentifiedModel) -> tuple[TrueRig, dict[str, float]]:
    """Return the rig that a model describes, with its nonlinear forces along the cell, and its parameters by name.

    Raises ValueError for an effect that is neither such a force nor a gain or offset.
    """
    value = dict(zip(model.parameters.names, model.parameters.value.tolist(), strict=True))
    for effect in model.geometry.effects:
        if effect.name not in CELL_FORCES + CONSTANTS:
            raise ValueError(f"no simulation of the Silverbox with {effect.name}")
    rig = true_rig(
        model.geometry,
        mass=value["mass"],
        stiffness=[value["stiffness.z"]],
        damping_ratios=[value["damping_ratio.1"]],
        sensitivities=[value["sensitivity.z"] * value.get("channel-gain@z.gain", 1.0)],
    )
    return apply_effects(rig, [effect for effect in model.geometry.effects if effect.name in CELL_FORCES]), value


def simulate_output(model: IdentifiedModel, loads: Array, rate: float) -> Array:
    """Return the channel (n,) [V] under recorded loads (n,) [N], band-limited between samples, integrated from rest."""
    rig, value = silverbox_rig(model)
    motion, step, n = RigDynamics.from_mechanics(equations_of_motion(rig)), 1.0 / (rate * OVERSAMPLING), len(loads)
    spectrum = np.zeros(OVERSAMPLING * n // 2 + 1, complex)
    spectrum[: n // 2 + 1] = np.fft.rfft(loads)
    fine = np.zeros((OVERSAMPLING * n, 6))
    fine[:, 2] = np.fft.irfft(spectrum, OVERSAMPLING * n) * OVERSAMPLING - value.get("load-offset@Fz.offset", 0.0)
    extra = nonlinear_forces(motion, [fine], step)[0] if motion.mechanics.forces else np.zeros((len(fine), 0))
    force = motion.forces(np.hstack([fine, extra]), step)[::OVERSAMPLING, 0]
    return np.asarray(force * rig.sensitivities[0] + value.get("channel-offset@z.offset", 0.0))


def errors(model: IdentifiedModel, runs: Mapping[str, Run]) -> tuple[float, float, float]:
    """Return the RMSE [mV] on the test part, on the arrow head, and on its part without extrapolation."""
    train, test, arrow = (runs[name].read() for name in ("train", "test", "arrow"))
    rate = runs["train"].sample_rate
    multisines = simulate_output(model, np.concatenate([train.loads[-WARM_UP_SAMPLES:, 2], test.loads[:, 2]]), rate)
    noise = simulate_output(model, arrow.loads[:, 2], rate) - arrow.channels[:, 0]
    output_error = multisines[WARM_UP_SAMPLES:] - test.channels[:, 0]
    return (
        rmse(output_error[TRANSIENT_SAMPLES:]),
        rmse(noise[TRANSIENT_SAMPLES:]),
        rmse(noise[TRANSIENT_SAMPLES:TRAINED_AMPLITUDE_SAMPLES]),
    )


def rmse(output_error: Array) -> float:
    """Return the root mean square [mV] of an error [V]."""
    return 1e3 * float(np.sqrt(np.mean(output_error**2)))


def main() -> None:
    """Print the errors of every model."""
    folder = Path(sys.argv[1])
    runs = {name: open_run(folder / f"{name}.h5") for name in ("train", "test", "arrow")}
    print(f"{'RMSE [mV]':<24}{'test':>10}{'arrow':>10}{'inside':>10}")
    for path in sys.argv[2:]:
        model = load_artefact(Path(path), {"balance-model/1": IdentifiedModel}).content
        print(f"{path:<24}" + "".join(f"{error:10.3f}" for error in errors(model, runs)))


if __name__ == "__main__":
    main()
