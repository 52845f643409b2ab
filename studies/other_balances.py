"""Coverage of the loads of three balances that lack something: strain, redundancy, a rotor.

    python -m studies.other_balances [SEEDS]

Simulates each campaign with the rig drawn from its tolerances, identifies the model, reduces the check runs by the
commands, and counts the cosines and sines that lie within 1.96 standard deviations of the true loads. The truth is a
regression of the simulated loads, before any filter, on the azimuth or at the frequencies.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
from click.testing import CliRunner

from balance_cli.api.artefacts import load_artefact
from balance_cli.cli import balance

ROOT = Path(__file__).parents[1]
RIGS = ("piezo-12", "hexapod", "dynamometer")
TONES = "66.7,133.4,200.1,266.8"
TWO_SIDED = 1.96
"""Standard deviations within which 95 % of normal errors lie."""


def call(*words: object) -> None:
    """Run a command; RuntimeError where it fails."""
    result = CliRunner().invoke(balance, [str(word) for word in words])
    if result.exit_code:
        raise RuntimeError(result.output)


def errors(rig: str, seed: int, folder: Path) -> np.ndarray:
    """Errors of all cosines and sines of the check runs, over their sigma."""
    geometry, runs = ROOT / "configs" / f"{rig}.yaml", folder / "runs"
    plan = ROOT / "studies" / "plans" / f"{rig}.yaml"
    call("simulate", "-g", geometry, "--plan", plan, "--sample-tolerances", "--seed", seed, "-o", runs)
    named = {kind: sorted(runs.glob(f"{kind}-*.h5")) for kind in ("static", "sweep", "check", "cut")}
    model, words = folder / "model.h5", []
    call("identify", "-g", geometry, *named["static"], *named["sweep"], "-o", model)
    if named["static"]:
        call("calibrate", "-g", geometry, *named["static"], "-o", folder / "cal.h5")
        words = ["--calibration", folder / "cal.h5"]
    if rig == "dynamometer":
        words = ["--frequencies", TONES]
    # The second cut has random loads beside its tones, which no regression on the truth removes.
    call("reduce", *words, "--model", model, *named["check"], *named["cut"][:1], "-o", folder / "loads.h5")
    with h5py.File(runs / "truth.hdf5") as truth:
        loads = load_artefact(folder / "loads.h5").runs
        return np.concatenate([_errors_of_run(run, truth[name], rig == "dynamometer") for name, run in loads.items()])


def _errors_of_run(run, truth, tones: bool) -> np.ndarray:
    time, loads = np.asarray(truth["time"]), np.asarray(truth["loads"])
    keep = (time >= run.interval[0]) & (time <= run.interval[1])
    n = len(run.frequency_hz) - 1
    turning = None if tones else np.asarray(truth["azimuth"])[keep]
    angle = (
        2.0 * np.pi * np.outer(time[keep], run.frequency_hz[1:])
        if turning is None
        else np.outer(turning, np.arange(1, n + 1))
    )
    basis = np.hstack([np.ones((len(angle), 1)), np.cos(angle), np.sin(angle)])
    found = np.linalg.lstsq(basis, loads[keep], rcond=None)[0]
    error = run.amplitude[1:] - (found[1 : n + 1] - 1j * found[n + 1 :])
    return np.concatenate([(error.real / run.sigma_cosine[1:]).ravel(), (error.imag / run.sigma_sine[1:]).ravel()])


def main(seeds: int) -> None:
    """Print the coverage of each rig; its standard error is that over the campaigns."""
    for rig in RIGS:
        campaigns = []
        for seed in range(1, seeds + 1):
            with tempfile.TemporaryDirectory() as folder:
                campaigns.append(errors(rig, seed, Path(folder)))
        shares = [100.0 * np.mean(np.abs(campaign) < TWO_SIDED) for campaign in campaigns]
        error = np.std(shares, ddof=1) / np.sqrt(seeds) if seeds > 1 else np.nan
        rms = np.sqrt(np.mean(np.concatenate(campaigns) ** 2))
        print(
            f"{rig}: {seeds} campaigns, {sum(map(len, campaigns))} numbers, {np.mean(shares):.1f} % +- {error:.1f} % "
            f"within 1.96 sigma ({min(shares):.0f} to {max(shares):.0f} %), rms error {rms:.2f} sigma",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
