"""Coverage of the densities of hub loads (`reduce --band`): random loads of known density on the dynamometer.

    python -m studies.spectra_coverage [SEEDS [SECONDS]]

All six loads are independent stationary noise of a flat density. The rig is drawn from its tolerances and identified
from sweeps. Printed are the densities within 1.96 standard deviations of the true one plus the stated noise of the
channels, the scatter of the densities over the frequencies of a load beside the stated random error, and the same
coverage of the rms within the band.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from balance_cli.api.artefacts import load_artefact
from balance_cli.reduction.spectra_result import RunSpectra
from studies.other_balances import ROOT, TWO_SIDED, call

GEOMETRY = ROOT / "configs" / "dynamometer.yaml"
SWEEPS = ROOT / "studies" / "plans" / "dynamometer.yaml"
LEVELS = {"Fx": 20.0, "Fy": 10.0, "Fz": 40.0, "Mx": 1.0, "My": 1.5, "Mz": 1.0}
"""Standard deviations of the loads [N, N m]."""
BAND = (50.0, 900.0)
"""Of the loads [Hz]."""
REDUCED = (70.0, 880.0)
"""Inside BAND by more than half the main lobe of the window, 16 Hz in a record of 6 s."""
ROTOR_AT_REST = {"rotor_speed": 80.0, "pulses": False}
"""Of the plan of a record without a rotor; the speed has no effect without harmonics."""


def random_record(duration: float) -> dict[str, Any]:
    """Return the plan of a record of random loads."""
    loads = {"turbulence": LEVELS, "turbulence_band": list(BAND)}
    return {"run": "random", "kind": "wind", "duration": duration, "sample_rate": 4096.0, **ROTOR_AT_REST, **loads}


def reduced_spectra(seed: int, duration: float, folder: Path) -> RunSpectra:
    """Return the spectra of the random record of one campaign."""
    runs = [run for run in yaml.safe_load(SWEEPS.read_text())["runs"] if run["kind"] == "sweep"]
    plan, data, model = folder / "plan.yaml", folder / "runs", folder / "model.h5"
    plan.write_text(yaml.safe_dump({"runs": [*runs, random_record(duration)]}))
    call("simulate", "-g", GEOMETRY, "--plan", plan, "--sample-tolerances", "--seed", seed, "-o", data)
    call("identify", "-g", GEOMETRY, *sorted(data.glob("sweep-*.h5")), "-o", model)
    call("reduce", "--model", model, data / "random.h5", "--band", *REDUCED, "-o", folder / "spectra.h5")
    spectra: RunSpectra = load_artefact(folder / "spectra.h5").runs["random"]
    return spectra


def true_densities(spectra: RunSpectra) -> np.ndarray:
    """Return the densities (k, m) of the loads and of the noise of the channels in them."""
    levels = np.array([LEVELS[name] for name in spectra.components])
    return levels**2 / (BAND[1] - BAND[0]) + spectra.noise


def scatter(spectra: RunSpectra) -> float:
    """Return the standard deviation of the densities over the frequencies, over their random error."""
    relative = spectra.density / true_densities(spectra)
    return float(np.sqrt(np.mean(relative.var(axis=0))) * np.sqrt(spectra.averages))


def errors_of_rms(spectra: RunSpectra) -> list[float]:
    """Return the errors of the rms within the band over their sigma."""
    step = float(np.mean(np.diff(spectra.frequency_hz)))
    true = np.sqrt(step * true_densities(spectra).sum(axis=0))
    return [(value - true[i]) / sigma for i, (value, sigma) in enumerate(spectra.band_rms.values())]


def main(seeds: int, duration: float) -> None:
    """Print the coverage over all campaigns; its standard error is that over the campaigns."""
    shares, scatters, rms, flagged = [], [], [], []
    for seed in range(1, seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            spectra = reduced_spectra(seed, duration, Path(folder))
        error = (spectra.density - true_densities(spectra)) / spectra.sigma
        shares.append(100.0 * np.mean(np.abs(error) < TWO_SIDED))
        scatters.append(scatter(spectra))
        rms += errors_of_rms(spectra)
        flagged.append(100.0 * np.mean([bool(flag) for flag in spectra.flags]))
    error_of_share = np.std(shares, ddof=1) / np.sqrt(seeds) if seeds > 1 else np.nan
    print(
        f"{seeds} records of {duration:g} s, {spectra.density.size} densities each, {spectra.averages:.0f} averages: "
        f"{np.mean(shares):.1f} % +- {error_of_share:.1f} % within 1.96 sigma, scatter {np.mean(scatters):.2f} of the "
        f"random error, {np.mean(flagged):.1f} % flagged; {len(rms)} rms within the band: "
        f"error {np.sqrt(np.mean(np.square(rms))):.2f} sigma, {100 * np.mean(np.abs(rms) < TWO_SIDED):.0f} % within"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8, float(sys.argv[2]) if len(sys.argv) > 2 else 6.0)
