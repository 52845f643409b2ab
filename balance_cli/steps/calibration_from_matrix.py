"""Calibration from a matrix file instead of runs: one trim, the model of the matrix, no rows."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import read_load_points
from balance_cli.calibration.all_trims_result import AllTrimsCalibration, Drift
from balance_cli.calibration.check_loads import CheckModels, evaluate_check_loads
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.matrix import model_from_matrix
from balance_cli.calibration.matrix_reader import ParsedMatrix
from balance_cli.calibration.matrix_text import CHANNEL, COMPONENT, RIG, ZERO
from balance_cli.calibration.noise import CalibrationNoise
from balance_cli.calibration.result import Calibration, Hysteresis, TrimCalibration, with_rated_loads
from balance_cli.calibration.static_matrices import inverse_matrix
from balance_cli.calibration.weight_covariance import weight_covariance
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import LoadComponents, load_components
from balance_cli.io.errors import UserError
from balance_cli.steps.calibrate import channel_full_range

Array = NDArray[np.float64]

MATRIX_TRIM = "matrix"
"""Label of the one trim of such a calibration."""
NOT_IN_MATRIX = "absent from the matrix"


def calibration_from_matrix(
    parsed_matrix: ParsedMatrix, geometry: Geometry, hold_out: Sequence[Run] = ()
) -> Calibration:
    """Convert a matrix to a calibration: C0 and T0 are its linear part at zero load, the model has all its terms.

    Standard errors of the coefficients are unknown: they are NaN and not included in any sigma. The static runs of
    `hold_out` check the calibration.

    Raises UserError where the matrix is of another rig, or of other components or channels, than the geometry.
    """
    _check_rig(parsed_matrix, geometry)
    _check_components(parsed_matrix, geometry)
    _check_channels(parsed_matrix, geometry)
    model = model_from_matrix(parsed_matrix.matrix)
    k = len(model.components)
    return Calibration(
        geometry,
        {MATRIX_TRIM: with_rated_loads(linear_trim(model, geometry), geometry)},
        model_without_rows(
            model, CalibrationNoise(model.residual_covariance, np.zeros(k)), load_components(geometry), hold_out
        ),
    )


def _check_rig(parsed_matrix: ParsedMatrix, geometry: Geometry) -> None:
    rig = parsed_matrix.matrix.rig
    if rig and rig != geometry.rig:
        fault = f"is of rig `{rig[:60]}`, but the geometry `{geometry.name}` is of rig `{geometry.rig}`"
        raise _row_error(parsed_matrix, RIG, fault, "Give the geometry of that rig, or a matrix of this one")


def _check_components(parsed_matrix: ParsedMatrix, geometry: Geometry) -> None:
    carried = load_components(geometry).names
    if parsed_matrix.matrix.components != carried:
        fault = f"has {', '.join(parsed_matrix.matrix.components)}, but the rig carries {', '.join(carried)}"
        raise _row_error(parsed_matrix, COMPONENT, fault, "Write the matrix for these, in this order")


def _check_channels(parsed_matrix: ParsedMatrix, geometry: Geometry) -> None:
    constant = [channel.name for channel in geometry.channels if channel.measures_dc]
    matrix = parsed_matrix.matrix
    units = {channel.name: channel.reading_unit for channel in geometry.channels}
    for name in matrix.channel_names:
        if name in constant and units[name] != matrix.reading_unit:
            fault = f"has readings in {matrix.reading_unit}, but the geometry declares `{name}` in {units[name]}"
            remedy = "Declare the `unit` of the channels as the matrix has it, or convert the matrix"
            raise _row_error(parsed_matrix, ZERO, fault, remedy)
        if name in constant:
            continue
        fault = f"`{name[:60]}` is not a strain or torque channel of the geometry `{geometry.name}`"
        near = difflib.get_close_matches(name[:60], constant, n=1)
        remedy = f"Did you mean `{near[0]}`?" if near else f"It has {', '.join(constant)}"
        raise _row_error(parsed_matrix, CHANNEL, fault, remedy)


def _row_error(parsed_matrix: ParsedMatrix, name: str, fault: str, remedy: str) -> UserError:
    return UserError(fault, place=f"line {parsed_matrix.line[name]}, `{name}`", remedy=remedy)


def linear_trim(model: CalibrationModel, geometry: Geometry) -> TrimCalibration:
    """Trim of the linear part at zero load, relative to the zeros."""
    k, c = len(model.components), len(model.channel_names)
    C0 = model.coefficients[:k].T / model.calibrated_range
    S = model.residual_covariance
    T0 = inverse_matrix(C0, weight_covariance(S, float(model.dof.min())))[0]
    unit = 1.0 / np.sqrt(np.diagonal(S))
    constant = [channel.name for channel in geometry.channels if channel.measures_dc]
    return TrimCalibration(
        trim=MATRIX_TRIM,
        runs=(),
        rows=0,
        channel_names=model.channel_names,
        components=model.components,
        C0=C0,
        C0_sigma=np.full((c, k), np.nan),
        C0_covariance=np.zeros((c, k, c, k)),
        T0=T0,
        T0_sigma=np.full((k, c), np.nan),
        offsets=model.zeros,
        mean_load=np.zeros(k),
        mean_channels=model.zeros[0],
        residual_covariance=S,
        dof=int(model.dof.min()),
        noise_covariance=S,
        lack_of_fit=float("nan"),
        calibrated_range=model.calibrated_range,
        channel_rated_range=channel_full_range(geometry, model.channel_names, C0 * model.calibrated_range),
        residual=np.sqrt(np.diagonal(T0 @ S @ T0.T)),
        channel_residual=np.sqrt(np.diagonal(S)),
        hysteresis=Hysteresis(*(np.full(shape, np.nan) for shape in ((c, k), (c, k), (k,), (k,)))),
        condition=float(np.linalg.cond(unit[:, None] * C0 * model.calibrated_range)),
        excluded_channels={name: NOT_IN_MATRIX for name in constant if name not in model.channel_names},
    )


def model_without_rows(
    model: CalibrationModel, noise: CalibrationNoise, components: LoadComponents, hold_out: Sequence[Run]
) -> AllTrimsCalibration:
    """Calibration of all trims without rows; the noise of load readings is not known, `noise` has none."""
    k, c = len(model.components), len(model.channel_names)
    checks = [(run.name, *read_load_points(run, model.channel_names, components)) for run in hold_out]
    return AllTrimsCalibration(
        model=model,
        runs=(),
        run=np.zeros(0, np.intp),
        loads=np.zeros((0, k)),
        residuals=np.zeros((0, c)),
        cross_validation_errors=np.zeros((0, c)),
        drift=Drift(*(np.full(c, np.nan) for _ in range(3))),
        noise=noise,
        outliers=(),
        suspect_series=(),
        checks=tuple(evaluate_check_loads(CheckModels(model, noise), *check)[0] for check in checks),
    )
