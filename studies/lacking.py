"""Errors of each reduction method when the model lacks effects of the rig: before and after model updating.

The study uses the check runs of the sample campaign, whose loads are known, and the artefacts of `make run`.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import load_artefact
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.result import RunLoads
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduce_in_time import TimeOptions, reduce_run_in_time

MODELS = {"rigid": "model-rigid.h5", "closed": "model-closed.h5"}
METHODS = {
    "harmonic": None,
    "kalman, harmonics": TimeOptions(smooth=False),
    "smoother, harmonics": TimeOptions(),
    "smoother, random": TimeOptions(load_model="random"),
    "smoother, free": TimeOptions(load_model="free"),
}


def lacking_table(results: Path, data: Path) -> pd.DataFrame:
    """Return the error of every applied component and the NIS, one row per model and method."""
    calibration = load_artefact(results / "calibration.h5", {"balance-calibration/1": Calibration}).content
    rows = []
    for model, name in MODELS.items():
        source = ModelSource(load_artefact(results / name, {"balance-model/1": IdentifiedModel}).content)
        for path in sorted(data.glob("check-*.h5")):
            run = open_run(path)
            for method, options in METHODS.items():
                loads, nis = _reduce(run, calibration, source, options)
                assert loads.check is not None
                errors = {f"{key} %": 100 * value for key, value in loads.check.load_error.items()}
                rows.append({"model": model, "method": method, "nis": nis, **errors})
    table = pd.DataFrame(rows).groupby(["model", "method"], sort=False).first().reset_index()
    return table[["model", "method", "nis", *(f"{name} %" for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz"))]]


def _reduce(
    run: Run, calibration: Calibration, source: ModelSource, options: TimeOptions | None
) -> tuple[RunLoads, float]:
    geometry = calibration.geometry
    if options is None:
        return reduce_run(run, geometry, calibration, source), float("nan")
    result = reduce_run_in_time(run, geometry, calibration, source, None, options)
    return result.loads, result.innovations.nis if result.innovations else float("nan")
