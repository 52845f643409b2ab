"""Text and JSON of `balance calibrate` on back-calculated load residuals and check loads, point by point."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from balance_cli.calibration.load_residuals import LoadResiduals, load_residuals
from balance_cli.campaign.rig.load_components import component_units

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration


def load_residual_text(calibration: Calibration) -> Iterator[str]:
    """Standard deviation, two sigma and largest residual of each component; nothing without rows."""
    residuals = load_residuals(calibration)
    if residuals is None:
        return
    units = component_units(calibration.geometry)
    yield f"Back-calculated less applied loads in % of {residuals.full_scale.meaning}, by the {residuals.method}:"
    yield "  component      full scale     std dev   two sigma    largest"
    sizes = zip(residuals.full_scale.values, residuals.standard_deviation, *residuals.largest, strict=True)
    for name, (full, sigma, largest, at) in zip(residuals.components, sizes, strict=True):
        place = f"({residuals.runs[residuals.run[at]]} row {residuals.row[at]})"
        scale = f"{full:.5g} {units[name]}"
        yield f"  {name:9s} {scale:>15s} {sigma:11.4f} {2 * sigma:11.4f} {largest:+10.4f} {place}"


def load_residual_summary(calibration: Calibration) -> dict[str, Any] | None:
    """Load residuals for JSON: statistics by component, and every point."""
    residuals = load_residuals(calibration)
    if residuals is None:
        return None
    names = residuals.components
    largest, at = residuals.largest
    return {
        "method": residuals.method,
        "full_scale": dict(zip(names, residuals.full_scale.values, strict=True)),
        "is_rated_load": dict(zip(names, residuals.full_scale.is_rated, strict=True)),
        "standard_deviation_percent_fs": dict(zip(names, residuals.standard_deviation, strict=True)),
        "two_sigma_percent_fs": dict(zip(names, 2.0 * residuals.standard_deviation, strict=True)),
        "largest_percent_fs": dict(zip(names, largest, strict=True)),
        "largest_at": {name: _point_name(residuals, int(row)) for name, row in zip(names, at, strict=True)},
        "points": [
            {"point": _point_name(residuals, i), "percent_fs": residuals.percent[i].tolist()}
            for i in np.flatnonzero(residuals.used).tolist()
        ],
    }


def check_point_summary(calibration: Calibration) -> dict[str, list[dict[str, Any]]]:
    """Check loads for JSON, point by point: applied, computed, half the prediction interval, validity."""
    if calibration.all_trims is None:
        return {}
    return {
        check.label: [
            {"row": i + 1, "applied": applied, "computed": computed, "interval": interval, "valid": bool(valid)}
            for i, (applied, computed, interval, valid) in enumerate(
                zip(
                    check.applied.tolist(),
                    check.computed.tolist(),
                    check.prediction_interval.tolist(),
                    check.is_valid,
                    strict=True,
                )
            )
        ]
        for check in calibration.all_trims.checks
    }


def _point_name(residuals: LoadResiduals, i: int) -> str:
    return f"{residuals.runs[residuals.run[i]]} row {residuals.row[i]}"
