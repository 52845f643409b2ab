"""JSON summary of `balance calibrate`: matrices of each trim and the calibration model of all trims."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from balance_cli.cli.load_residual_summary import check_point_summary, load_residual_summary
from balance_cli.cli.temperature_summary import temperature_summary

if TYPE_CHECKING:
    from balance_cli.calibration.all_trims_result import AllTrimsCalibration, CheckLoads, SuspectLoadSeries
    from balance_cli.calibration.math_model import CalibrationModel
    from balance_cli.calibration.noniterative_model import NonIterativeModel
    from balance_cli.calibration.result import Calibration, TrimCalibration
    from balance_cli.calibration.tare_result import Tares
    from balance_cli.calibration.term_choice import TermChoice
    from balance_cli.campaign.rig.geometry import Geometry

FORMER_KEYS = {
    "calibrated_range": "full_range",
    "unsupported_terms": "terms_refused",
    "cross_validation": "left_out_sequences",
    "non_iterative": "direct",
    "swapped_channels": "exchanged",
    "screening_notes": "limits",
    "suspect_series": "bad_sequences",
    "load_series": "sequences",
    "drift_per_series": "drift_per_sequence",
    "center_of_gravity": "centre",
    "series_count": "sequences",
    "valid_rows": "solved",
}
"""Former names of keys under `gage`, by the present names under `all_trims`. Deprecated, kept for one release."""
FORMER_SUSPECT_KEYS = {"load_series": "sequence", "resembled_channel": "like", "alternatives": "or_else"}
"""Former names of the keys of a suspect load series."""


def calibration_summary(calibration: Calibration) -> dict[str, Any]:
    """The summary of a calibration, for JSON."""
    summary = math_model_summary(calibration.all_trims, calibration.geometry) if calibration.all_trims else None
    return {
        "geometry": calibration.geometry.name,
        "trims": {name: _trim_summary(trim) for name, trim in calibration.trims.items()},
        "all_trims": summary,
        "load_residuals": load_residual_summary(calibration),
        "check_points": check_point_summary(calibration),
        "temperature": temperature_summary(calibration),
        "gage": _with_former_keys(summary) if summary else None,
    }


# ---- trims -----------------------------------------------------------------------------------------------------------


def _trim_summary(trim: TrimCalibration) -> dict[str, Any]:
    components, channels, loops = trim.components, trim.channel_names, trim.hysteresis
    calibrated_range = dict(zip(components, trim.calibrated_range, strict=True))
    return {
        "residual_percent_fs": trim.residual_percent_fs,
        "condition": trim.condition,
        "runs": trim.runs,
        "rows": trim.rows,
        "dof": trim.dof,
        "lack_of_fit": trim.lack_of_fit,
        "calibrated_range": calibrated_range,
        "full_range": calibrated_range,
        "full_scale": dict(zip(components, trim.full_scale, strict=True)),
        "mean_load": dict(zip(components, trim.mean_load, strict=True)),
        "channel_residual_percent_fs": trim.channel_residual_percent_fs,
        "hysteresis_percent_fs": {
            name: {"value": 100 * value / full, "sigma": 100 * sigma / full}
            for name, value, sigma, full in zip(
                components, loops.loads, loops.loads_sigma, trim.full_scale, strict=True
            )
        },
        "channel_hysteresis": _matrix_summary(channels, components, loops.channels, loops.channels_sigma),
        "C0": _matrix_summary(channels, components, trim.C0, trim.C0_sigma),
        "T0": _matrix_summary(components, channels, trim.T0, trim.T0_sigma),
        "channels_left_out": trim.excluded_channels,
    }


def _matrix_summary(rows: tuple[str, ...], columns: tuple[str, ...], value: Any, sigma: Any) -> dict[str, Any]:
    """{row: {column: {value, sigma}}}."""
    return {
        row: {column: {"value": value[i, j], "sigma": sigma[i, j]} for j, column in enumerate(columns)}
        for i, row in enumerate(rows)
    }


# ---- calibration model -----------------------------------------------------------------------------------------------


def math_model_summary(all_trims: AllTrimsCalibration, geometry: Geometry) -> dict[str, Any]:
    """The summary of the calibration model, for JSON."""
    from balance_cli.campaign.rig.load_components import full_scale

    model, channels, drift = all_trims.model, all_trims.model.channel_names, all_trims.drift
    proof, scale = all_trims.loads_model.contraction(), full_scale(geometry, model.components, model.calibrated_range)
    return {
        "terms": {name: nonlinear_terms_summary(all_trims, c) for c, name in enumerate(channels)},
        "linear": {
            name: dict(zip(model.components, model.coefficients[:, c], strict=False)) for c, name in enumerate(channels)
        },
        "calibrated_range": dict(zip(model.components, model.calibrated_range, strict=True)),
        "unsupported_terms": model.unsupported_terms,
        "term_choice": _term_choice_summary(all_trims.term_choice),
        "residual": dict(zip(channels, np.sqrt(np.diag(model.residual_covariance)), strict=True)),
        "press": dict(zip(channels, model.press, strict=True)),
        "cross_validation": dict(zip(channels, model.cross_validation_rms, strict=True)),
        "iteration": {
            "contraction": proof.rho if proof.is_proved else None,
            "proved": proof.is_proved,
            "reach": dict(zip(model.components, proof.reach, strict=True)),
        },
        "zeros": {
            "load_series": model.load_series,
            "reading": all_trims.series_notes or (),
            "drift_per_series": _values_with_sigma(channels, drift.slope, drift.slope_sigma),
            "scatter_chi2_per_dof": dict(zip(channels, drift.chi2_per_dof, strict=True)),
        },
        "random_terms": None if all_trims.random_terms is None else _random_terms_summary(all_trims.random_terms),
        "non_iterative": _non_iterative_summary(all_trims.non_iterative) if all_trims.non_iterative else None,
        "tares": None if all_trims.tares is None else _tares_summary(all_trims.tares, channels),
        "outliers": [vars(outlier) for outlier in all_trims.outliers],
        "swapped_channels": all_trims.swapped_channels,
        "screening_notes": all_trims.screening_notes,
        "suspect_series": [_suspect_series_summary(suspect) for suspect in all_trims.suspect_series],
        "checks": {
            check.label: _check_load_summary(check, model.components, scale.values) for check in all_trims.checks
        },
    }


def _term_choice_summary(choice: TermChoice | None) -> dict[str, Any] | None:
    """Which terms the model could have; None where the artefact is older, or a matrix states its terms."""
    if choice is None:
        return None
    significance = choice.significance if choice.is_search else None
    return {"kind": choice.kind, "significance": significance, "all": choice.listed, "by_channel": choice.by_channel}


def nonlinear_terms_summary(all_trims: AllTrimsCalibration, channel: int) -> dict[str, Mapping[str, float]]:
    """Each nonlinear term of a channel, with its coefficient and statistics."""
    model = all_trims.model
    # A matrix from a file states no errors: its t is unknown, and so is sigma.
    sigma = np.where(np.isfinite(model.t[:, channel]), np.sqrt(np.diag(model.covariance[channel])), np.nan)
    columns = {
        "value": model.coefficients[:, channel],
        "sigma": sigma,
        "t": model.t[:, channel],
        "p": model.p_value[:, channel],
        "variance_inflation": model.variance_inflation[:, channel],
    }
    return {
        name: {key: float(values[i]) for key, values in columns.items()}
        for i, name in enumerate(model.terms)
        if i >= len(model.components) and (np.isfinite(model.t[i, channel]) or columns["value"][i] != 0.0)
    }


def _random_terms_summary(model: CalibrationModel) -> dict[str, Any]:
    """The model with random terms: coefficients with their standard deviations, and its errors, by channel."""
    names, k = model.channel_names, len(model.components)
    sigma = np.sqrt(np.diagonal(model.covariance, axis1=1, axis2=2)).T
    terms = {
        name: {
            term: {"value": float(model.coefficients[i, c]), "sigma": float(sigma[i, c])}
            for i, term in enumerate(model.terms)
            if i >= k
        }
        for c, name in enumerate(names)
    }
    return {
        "linear": {
            name: dict(zip(model.components, model.coefficients[:, c], strict=False)) for c, name in enumerate(names)
        },
        "terms": terms,
        "residual": dict(zip(names, np.sqrt(np.diag(model.residual_covariance)), strict=True)),
        "cross_validation": dict(zip(names, model.cross_validation_rms, strict=True)),
    }


def _non_iterative_summary(non_iterative: NonIterativeModel) -> dict[str, Any]:
    model, components = non_iterative.model, non_iterative.model.components
    return {
        "residual_percent_fs": dict(zip(components, non_iterative.residual_percent_fs, strict=True)),
        "terms": {name: model.channel_coefficients(name) for name in components},
    }


def _values_with_sigma(names: tuple[str, ...], value: Any, sigma: Any) -> dict[str, dict[str, float]]:
    return {name: {"value": value[i], "sigma": sigma[i]} for i, name in enumerate(names)}


def _tares_summary(tares: Tares, channels: tuple[str, ...]) -> dict[str, Any]:
    center, sigma = tares.center_of_gravity, tares.center_of_gravity_sigma
    return {
        "weight": {"value": tares.weight, "sigma": tares.weight_sigma},
        "center_of_gravity": _values_with_sigma(("x", "y", "z"), center, sigma),
        "natural_zeros": _values_with_sigma(channels, tares.natural_zeros, tares.natural_zeros_sigma),
        "chi2_per_dof": tares.chi2_per_dof,
        "series_count": tares.series_count,
    }


def _suspect_series_summary(suspect: SuspectLoadSeries) -> dict[str, Any]:
    return {
        "load_series": suspect.load_series,
        "channel": suspect.channel,
        "gain": suspect.gain,
        "gain_sigma": suspect.gain_sigma,
        "resembled_channel": suspect.resembled_channel,
        "alternatives": suspect.alternatives,
        "cause": suspect.cause,
    }


def _check_load_summary(check: CheckLoads, components: tuple[str, ...], full_scale: Any) -> dict[str, Any]:
    return {
        "method": check.method or "calibration model",
        **({} if check.zeros is None else {"zeros": check.zeros}),
        "rows": len(check.applied),
        "valid_rows": int(np.count_nonzero(check.is_valid)),
        "error_percent_fs": dict(zip(components, 100.0 * check.error / full_scale, strict=True)),
        "within_interval": dict(zip(components, check.interval_coverage, strict=True)),
    }


# ---- deprecated keys -------------------------------------------------------------------------------------------------


def _with_former_keys(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The summary of the calibration model under the keys that it had as `gage`."""
    former = _rename_keys(summary)
    for key in ("zeros", "tares"):
        former[key] = _rename_keys(summary[key]) if summary[key] else None
    former["checks"] = {run: _rename_keys(check) for run, check in summary["checks"].items()}
    former["bad_sequences"] = [_rename_keys(suspect, FORMER_SUSPECT_KEYS) for suspect in summary["suspect_series"]]
    return former


def _rename_keys(values: Mapping[str, Any], names: Mapping[str, str] = FORMER_KEYS) -> dict[str, Any]:
    return {names.get(key, key): value for key, value in values.items()}
