"""Two load series that contradict each other in sign or unit, and no third one that decides which is wrong.

Whichever is excluded, the load may come out with the wrong sign: a guess is no calibration. The response of the
declared rig may tell; otherwise the calibration is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_mean
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.series_causes import factor_words
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]

PLAUSIBLE_FACTORS = (0.5, 2.0)
"""Factors between the loads of two series that a warning suffices for: beyond are other signs and units (lbf: 4.4)."""
LARGEST_DECLARED_ERROR = 0.5
"""Share of the readings of a load series, as amplitude, by which the declared response may miss the right one: another
sign misses by 2, lbf for N by 0.8 or 3.4, and declared sensitivities err by some per cent."""


@dataclass(frozen=True)
class LoadSeriesRows:
    """A load series: its rows (m,) and its name in messages."""

    rows: NDArray[np.bool_]
    words: str


def contradicts(points: CalibrationPoints, rows: NDArray[np.bool_]) -> bool:
    """Whether the loads of some rows (m,) have another sign or size than a linear fit of the other rows tells."""
    return not PLAUSIBLE_FACTORS[0] <= _factor_by_others(points, rows) <= PLAUSIBLE_FACTORS[1]


def _factor_by_others(points: CalibrationPoints, rows: NDArray[np.bool_]) -> float:
    """How many times the stated loads of some rows (m,) are what a linear fit of the other rows tells of them."""
    scale = _channel_scale(points)
    model = fit_calibration_model(points.exclude_rows(rows), LINEAR_TERMS).model
    predicted = subtract_mean(model.readings(points.loads[rows])) / scale
    power = float(np.sum(predicted**2))
    return float(np.sum(predicted * subtract_mean(points.channels[rows]) / scale)) / power if power > 0.0 else 1.0


def decide_by_declared(points: CalibrationPoints, rivals: Sequence[LoadSeriesRows]) -> int | None:
    """The number of the one of `rivals` that the response of the declared rig does not fit, while it fits the others.

    None where no response is declared, or it does not tell.
    """
    if points.declared_response is None:
        return None
    wrong = [i for i, each in enumerate(rivals) if _declared_error(points, each.rows) > LARGEST_DECLARED_ERROR]
    return wrong[0] if len(wrong) == 1 else None


def undecided_error(points: CalibrationPoints, rivals: Sequence[LoadSeriesRows]) -> UserError:
    """The error to raise where load series contradict each other and nothing decides between them."""
    names = " and ".join(each.words for each in rivals)
    loaded = np.any([np.ptp(points.x[each.rows], axis=0) > 0.0 for each in rivals], axis=0)
    loads = ", ".join(name for name, is_loaded in zip(points.components, loaded, strict=True) if is_loaded)
    words = factor_words(_factor_by_others(points, rivals[-1].rows))
    return UserError(
        f"contradict each other in the sign or the size of {loads}, and no other load series shows which is wrong. Of "
        f"the latter {words}, or the reverse",
        names,
        remedy="Correct the loads or the readings of the wrong one, leave it out, or declare the mechanics of the rig",
    )


def _declared_error(points: CalibrationPoints, rows: NDArray[np.bool_]) -> float:
    """Rms of what the declared response misses of the readings in some rows (m,), over their rms."""
    assert points.declared_response is not None
    scale = _channel_scale(points)
    change = subtract_mean(points.channels[rows]) / scale
    missed = change - subtract_mean(points.loads[rows] @ points.declared_response.T) / scale
    return float(np.linalg.norm(missed) / max(float(np.linalg.norm(change)), np.finfo(float).tiny))


def _channel_scale(points: CalibrationPoints) -> Array:
    """Standard deviation (c,) of the readings of each channel in all rows."""
    scale = points.channels[points.weight > 0].std(axis=0)
    return np.where(scale > 0.0, scale, 1.0)
