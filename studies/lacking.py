"""How far wrong each way to hub loads is when the model lacks what the rig has: before and after closing the loop.

On the check runs of the sample campaign, whose loads are known, by the artefacts that `make run` leaves.
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
    """Error of every component that was applied, and how well the innovations fit: rows by model, method and run."""
    calibration = load_artefact(results / "calibration.h5", {"balance-calibration/1": Calibration}).content
    rows = []
    for model, name in MODELS.items():
        source = ModelSource(load_artefact(results / name, {"balance-model/1": IdentifiedModel}).content)
        for path in sorted(data.glob("check-*.h5")):
            run = open_run(path)
            for method, options in METHODS.items():
                loads, nis = _reduced(run, calibration, source, options)
                assert loads.check is not None
                errors = {f"{key} %": 100 * value for key, value in loads.check.load_error.items()}
                rows.append({"model": model, "method": method, "nis": nis, **errors})
    table = pd.DataFrame(rows).groupby(["model", "method"], sort=False).first().reset_index()
    return table[["model", "method", "nis", *(f"{name} %" for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz"))]]


def _reduced(
    run: Run, calibration: Calibration, source: ModelSource, options: TimeOptions | None
) -> tuple[RunLoads, float]:
    geometry = calibration.geometry
    if options is None:
        return reduce_run(run, geometry, calibration, source), float("nan")
    found = reduce_run_in_time(run, geometry, calibration, source, None, options)
    return found.loads, found.innovations.nis if found.innovations else float("nan")
