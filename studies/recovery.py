"""Simulated campaigns without hidden effects: responses and hub loads against the truth.

Each campaign has a rig drawn from the tolerances, simulated in time, recorded with the noise of the measured campaign,
and goes through the chain as files would: spectra, maximum likelihood, reduction of its check runs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.result import RunLoads
from balance_cli.simulation import draw_rig, simulate_campaign
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import identify
from balance_cli.steps.reduce import reduce_run
from tests.support.truth import response_errors
from tests.support.truth_source import TruthSource

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# The lowest damping ratio in the measured campaign. With less, a mode still rings at the end of the record, and its
# transient, not the noise, dominates the error.
MIN_DAMPING_RATIO = 0.005


def recovery_chunk(geometry: Geometry, seed: int) -> pd.DataFrame:
    """Errors of one simulated campaign, one row per component."""
    rig = draw_rig(geometry, np.random.default_rng([seed, 7]))
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, MIN_DAMPING_RATIO))
    runs, _ = simulate_campaign(rig, "standard", seed=seed)
    model = identify(measured_spectra(runs, geometry), geometry)
    error, predicted = response_errors(rig, model)
    calibration = calibrate(runs, geometry)
    checks = [run for run in runs if run.kind == "check"]
    known = TruthSource(rig, model_source(model).slowest_decay)
    reduced = [reduce_run(run, geometry, calibration, model_source(model)) for run in checks]
    best = [reduce_run(run, geometry, calibration, known) for run in checks]
    return pd.DataFrame(
        {
            "seed": seed,
            "component": COMPONENTS,
            "chi2_per_dof": model.quality.chi2_per_dof,
            "frf_error_p95": np.percentile(error, 95, axis=0),
            "cramer_rao_p95": np.percentile(predicted, 95, axis=0),
            "load_error": _load_error(reduced),
            "load_error_true_response": _load_error(best),
        }
    )


def _load_error(runs: list[RunLoads]) -> Array:
    """Root mean square over the check runs of the hub-load error or interaction of each component."""
    values = [{**run.check.load_error, **run.check.interaction} for run in runs if run.check is not None]
    return np.array([np.sqrt(np.mean([value[name] ** 2 for value in values])) for name in COMPONENTS])


def recovery_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Median and maximum over the campaigns, by component, with the ratios to the bounds."""
    rows = rows.assign(
        frf_over_bound=rows["frf_error_p95"] / rows["cramer_rao_p95"],
        load_over_best=rows["load_error"] / rows["load_error_true_response"],
    )
    columns = ["chi2_per_dof", "frf_error_p95", "cramer_rao_p95", "frf_over_bound", "load_error", "load_over_best"]
    grouped = rows.groupby("component", sort=False)[columns]
    table = grouped.agg(["median", "max"])
    table.columns = [f"{name}_{statistic}" for name, statistic in table.columns]
    squares = (rows.set_index("component")[columns[1:3]] ** 2).groupby(level=0, sort=False).mean()
    table["frf_over_bound_rms"] = np.sqrt(squares["frf_error_p95"] / squares["cramer_rao_p95"])
    return table.reset_index()
