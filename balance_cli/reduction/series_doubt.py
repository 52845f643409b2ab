"""Error of mean loads whose calibration rests on which of two load series is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.calibration.result import Calibration
from balance_cli.reduction.flags import MODEL_CONTRADICTED, join_flags
from balance_cli.reduction.mean_loads import MeanLoads


def add_series_doubt(loads: MeanLoads, calibration: Calibration) -> MeanLoads:
    """Return mean loads with half of what they depend on excluded load series in sigma, flagged where that matters."""
    all_trims = calibration.all_trims
    if all_trims is None or not all_trims.suspect_series:
        return loads
    from balance_cli.calibration.doubted_loads import add_doubted_change, describe_doubt

    total = np.zeros(len(all_trims.model.components))
    at = [all_trims.model.components.index(name) for name in loads.components]
    total[at] = np.nan_to_num(loads.loads)
    variance = np.zeros((1, len(total), len(total)))
    variance[0, at, at] = loads.sigma**2
    wide, all_doubted = add_doubted_change(all_trims, total[None], variance)
    doubted = all_doubted[0, at]
    if not doubted.any():
        return loads
    flags = (
        join_flags((flag, MODEL_CONTRADICTED if is_doubted else ""))
        for flag, is_doubted in zip(loads.flags, doubted.tolist(), strict=True)
    )
    note = "; ".join(filter(None, [loads.note, describe_doubt(all_trims)]))
    return replace(loads, sigma=np.sqrt(np.diag(wide[0])[at]), flags=tuple(flags), note=note)
