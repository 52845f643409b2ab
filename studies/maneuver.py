"""Maneuvers with known loads: error of the smoother compared with the best linear one, and coverage of its intervals.

A rotor whose speed varies by 3 %, a step of collective, harmonics 1 to 8 of all loads and turbulence up to 100 Hz,
integrated in time by independent code. The best linear smoother is the same recursion (which the tests compare with
dense Gaussian conditioning) with the true model and the true statistics: constant amplitudes, turbulence of its size
and band, a step of its size at an unknown time, and the noise of every channel.
"""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.kalman.load_history import LoadHistory
from balance_cli.reduction.kalman.load_models import BandLimitedNoise, LowPassDrift, Oscillators
from balance_cli.reduction.model_sources import model_source
from balance_cli.simulation import simulate_campaign, simulate_run, true_rig
from balance_cli.simulation.plans import CampaignPlan, LoadStep, RotorPlan
from balance_cli.simulation.preset_plans import WIND_ON_LOADS, blade_loads, static_plans
from balance_cli.steps import reduce_in_time
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce_in_time import TimeOptions, reduce_run_in_time

Array = NDArray[np.float64]

DURATION = 12.0
STEP = {"Fz": 700.0, "Mz": 60.0}
TURBULENCE = {"Fx": 3.0, "Fy": 3.0, "Fz": 8.0, "Mx": 1.0, "My": 1.0, "Mz": 1.0}
BAND = 100.0
Z_95 = 1.959963984540054
END_DURATION = 1.0
"""Time [s] at either end, where a smoother has fewer samples; its coverage is reported separately."""


def maneuver_plan() -> RotorPlan:
    """Return the plan of the run; its name is the seed of its noise."""
    return RotorPlan(
        run="manoeuvre",
        kind="wind",
        rotor_speed=17.76,
        duration=DURATION,
        harmonics=blade_loads(*WIND_ON_LOADS),
        steady=WIND_ON_LOADS,
        drift=0.03,
        drift_period=9.0,
        step=LoadStep(time=6.0, loads=STEP),
        turbulence=TURBULENCE,
        turbulence_band=(0.5, BAND),
    )


def maneuver_chunk(geometry: Geometry, seed: int) -> pd.DataFrame:
    """Return the figures of one maneuver, one row per component and method."""
    rig = true_rig(geometry)
    static_runs, _ = simulate_campaign(rig, CampaignPlan(runs=static_plans()), seed=seed)
    calibration = calibrate(static_runs, geometry)
    source = model_source(identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed")))
    run, truth = simulate_run(rig, maneuver_plan(), seed=seed)
    size = np.abs(truth.cosine - 1j * truth.sine)[1:] if truth.cosine is not None and truth.sine is not None else None
    assert size is not None

    def reduced(options: TimeOptions) -> pd.DataFrame:
        parts: list[LoadHistory] = []
        result = reduce_run_in_time(run, geometry, calibration, source, None, options, parts.append)
        nis = result.innovations.nis if result.innovations else np.nan
        return _figures(parts, truth.loads, run.sample_rate or np.nan).assign(nis=nis)

    rows = [
        reduced(TimeOptions(smooth=smooth, load_model=loads)).assign(
            method="smoother" if smooth else "filter", loads=loads
        )
        for loads, smooth in (("harmonics", True), ("harmonics", False), ("random", True))
    ]
    with patch.multiple(
        reduce_in_time,
        fit_loads_between_harmonics=lambda *_: true_load_models(),
        fit_drifting_harmonics=lambda *_: Oscillators(1e-3 * size, 3.0 * size, tuple(range(1, 9))),
        INITIAL_STATE_TIME=DURATION,
    ):
        rows.append(reduced(TimeOptions()).assign(method="best linear smoother", loads="true statistics"))
    return pd.concat(rows).assign(seed=seed)


def true_load_models() -> tuple[LowPassDrift, BandLimitedNoise]:
    """Return the step as a random walk that changes by its size within the run, and turbulence of its size and band."""
    step = np.array([STEP.get(name, 1e-3) for name in COMPONENTS])
    slow = LowPassDrift(step, 0.01, 1.0 / 0.8)
    # A random walk of intensity step^2 / duration has that of `slow`: 2 a sigma^2.
    size = step / np.sqrt(2 * np.pi * 2 * slow.corner * DURATION)
    return replace(slow, sigma=size), BandLimitedNoise(np.array([TURBULENCE[name] for name in COMPONENTS]), 0.93 * BAND)


def _figures(parts: list[LoadHistory], true: Array, sample_rate: float) -> pd.DataFrame:
    """Return error, sigma and coverage of each component, and the coverage at the ends."""
    time, loads, sigma = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("time", "loads", "sigma")
    )
    error = loads - true[np.rint(time * sample_rate).astype(int)]
    inside = (time > time[0] + END_DURATION) & (time < time[-1] - END_DURATION)
    covered = np.abs(error) < Z_95 * sigma
    return pd.DataFrame(
        {
            "component": COMPONENTS,
            "error": np.sqrt(np.mean(error[inside] ** 2, axis=0)),
            "sigma": np.sqrt(np.mean(sigma[inside] ** 2, axis=0)),
            "coverage": covered[inside].mean(axis=0),
            "coverage_ends": covered[~inside].mean(axis=0),
            "size": np.sqrt(np.mean((true - true.mean(axis=0)) ** 2, axis=0)),
        }
    )


def maneuver_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return errors over those of the best linear smoother, and coverage, by method and component over all seeds."""
    squared = rows.assign(error=rows["error"] ** 2, sigma=rows["sigma"] ** 2)
    grouped = squared.groupby(["method", "loads", "component"], sort=False)
    table = grouped[["error", "sigma", "coverage", "coverage_ends", "size", "nis"]].mean().reset_index()
    table[["error", "sigma"]] = np.sqrt(table[["error", "sigma"]])
    best = table[table["method"] == "best linear smoother"].set_index("component")["error"]
    table["over_best"] = table["error"] / table["component"].map(best)
    return table
