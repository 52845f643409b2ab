"""Hammer against shaker: the same simulated dynamometer identified from taps beside the hub and from sweeps at it.

    python -m studies.hammer [SEED]

The true rig is drawn from the tolerances. A hammer taps seven points, three times each, in records of 4 s; a shaker
drives each hub load for six periods of 1 s (as in `studies/plans/dynamometer.yaml`). Printed are chi-square per degree
of freedom, the errors of the parameters over their sigma, and how much narrower than declared they became.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.signal

from balance_cli.campaign.recording.additions import FORCE, LoadPoints, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.simulation import CampaignPlan, SweepPlan, TrueRig, draw_rig, simulate_campaign
from balance_cli.simulation.replay import replay_loads
from balance_cli.steps.identify import identify
from tests.support.truth import true_parameters

ROOT = Path(__file__).parents[1]
RATE, DURATION, OVERSAMPLING = 4096.0, 4.0, 8
TAPS = (0.4, 1.6, 2.7)
"""Times of the taps [s]."""
CONTACT = 1.2e-3
"""Duration of a hit [s]: a steel tip."""
LARGEST_FORCES = (300.0, 600.0)
CHANNEL_NOISE, FORCE_NOISE = 1.5e-3, 0.2
"""Standard deviations of a sample [V, N]."""
LEAST_DAMPING = 0.005
POINTS = {
    "top": ((0.02, 0.01, 0.1), (0.0, 0.0, -1.0)),
    "corner": ((0.1, 0.07, 0.02), (0.0, 0.0, -1.0)),
    "other corner": ((-0.1, 0.07, 0.02), (0.0, 0.0, -1.0)),
    "front": ((0.11, 0.0, 0.05), (-1.0, 0.0, 0.0)),
    "front, off center": ((0.11, 0.06, 0.03), (-1.0, 0.0, 0.0)),
    "side": ((0.0, -0.08, 0.05), (0.0, 1.0, 0.0)),
    "side, off center": ((0.08, -0.08, 0.0), (0.0, 1.0, 0.0)),
}
"""Position [m] and direction of the taps."""


def hammer_run(rig: TrueRig, name: str, rng: np.random.Generator) -> Run:
    """Return the record of three taps at one of POINTS."""
    geometry, samples = rig.geometry, int(DURATION * RATE)
    position, direction = (np.array(item) for item in POINTS[name])
    force = _taps(samples, rng)
    loads = force[:, None] * np.hstack([direction, np.cross(position - np.array(geometry.hub), direction)])
    volts = replay_loads(rig, loads, "sweep", RATE)
    volts = volts + CHANNEL_NOISE * rng.standard_normal(volts.shape)
    measured = (force + FORCE_NOISE * rng.standard_normal(samples))[:, None]
    points = LoadPoints((name,), direction[None], position[None])
    run = Run(
        *(f"hammer-{name}", geometry.rig, "sweep", geometry.channel_names, samples, MemorySource(volts, None), False),
        sample_rate=RATE,
        excited=(COMPONENTS[int(np.argmax(np.abs(direction)))],),
        excitation="impact",
        level=(30.0,),
        additions=RunAdditions(points, source=MemoryAdditions({FORCE: measured})),
    )
    return with_hub_loads(run, geometry)


def _taps(samples: int, rng: np.random.Generator) -> np.ndarray:
    """Return half sines of random size (samples,) [N], band-limited."""
    time = np.arange(samples * OVERSAMPLING) / (RATE * OVERSAMPLING)
    force = np.zeros(len(time))
    for start in TAPS:
        inside = (time >= start) & (time < start + CONTACT)
        force[inside] = rng.uniform(*LARGEST_FORCES) * np.sin(np.pi * (time[inside] - start) / CONTACT)
    sections = scipy.signal.butter(10, 1300.0, fs=RATE * OVERSAMPLING, output="sos")
    return np.asarray(scipy.signal.sosfiltfilt(sections, force)[::OVERSAMPLING])


def shaker_plan() -> CampaignPlan:
    """Return a sweep of each hub load."""
    levels = {"Fx": 60.0, "Fy": 60.0, "Fz": 90.0, "Mx": 4.0, "My": 4.0, "Mz": 4.0}
    return CampaignPlan(
        runs=tuple(
            SweepPlan(
                run=f"sweep-{name}",
                excited=(name,),
                level=(level,),
                period=1.0,
                periods=6,
                band=(5.0, 1150.0),
                sample_rate=RATE,
            )
            for name, level in levels.items()
        )
    )


def describe(name: str, runs: list[Run], rig: TrueRig, geometry: Geometry) -> str:
    """Identify the rig from runs, and return the errors of its parameters in words."""
    model = identify(measured_spectra(runs, geometry), geometry)
    table = model.parameters
    free = table.sigma > 0
    z = (table.value - true_parameters(rig, table))[free] / table.sigma[free]
    narrower = np.median(table.declared_sigma[free] / table.sigma[free])
    errors = f"errors {np.sqrt(np.mean(z**2)):.2f} sigma rms, {np.abs(z).max():.1f} largest"
    return f"{name}: chi2/dof {model.quality.chi2_per_dof:.3f}, {errors}; {narrower:.1f} times narrower than declared"


def main(seed: int) -> None:
    """Print both identifications."""
    geometry, rng = load_geometry(ROOT / "configs" / "dynamometer.yaml"), np.random.default_rng(seed)
    rig = draw_rig(geometry, rng)
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, LEAST_DAMPING))
    print(describe("shaker", list(simulate_campaign(rig, shaker_plan(), seed=seed).runs), rig, geometry), flush=True)
    print(describe("hammer", [hammer_run(rig, name, rng) for name in POINTS], rig, geometry))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
