"""Error of mean loads where all channels may have another gain than in the static runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.reduction.mean_loads import MeanLoads
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.response_sources import ResponseSource


def add_gain_error(loads: MeanLoads, source: ResponseSource) -> MeanLoads:
    """Return mean loads with the error of the gain of all channels that the diagnosis of the model has left open.

    Static runs have calibrated them, and the channels read them in the wind-on run.
    """
    if not isinstance(source, ModelSource) or not source.model.gain_error or np.isnan(loads.loads).all():
        return loads
    error = source.model.gain_error
    note = (
        f"the gain of all channels may differ by {100.0 * error:.2g} % from static runs, which is in sigma of all loads"
    )
    notes = "; ".join(filter(None, [loads.note, note]))
    return replace(loads, sigma=np.hypot(loads.sigma, error * loads.loads), note=notes)
