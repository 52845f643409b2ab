"""Calibration from a linear matrix of a vendor or another laboratory, which states neither zeros nor noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.linear_matrix import LinearMatrix
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.noise import CalibrationNoise
from balance_cli.calibration.result import Calibration, with_rated_loads
from balance_cli.calibration.trim_model import WITHOUT_ZEROS
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.errors import UserError
from balance_cli.steps.calibration_from_matrix import MATRIX_TRIM, linear_trim, model_without_rows

Array = NDArray[np.float64]


def calibration_from_linear_matrix(matrix: LinearMatrix, geometry: Geometry, hold_out: Sequence[Run]) -> Calibration:
    """Convert a linear matrix to a calibration of one trim with a linear model; its noise is not known (NaN).

    Sigma of loads by such a calibration is therefore not known either. The full range is that of the matrix, else the
    rated loads of the geometry. Raises UserError where neither is known, or the channels are not those of the geometry.
    """
    names = _channel_names(matrix, geometry)
    scale = _full_range(matrix, geometry)
    model = _linear_model(matrix, names, scale)
    trim = linear_trim(model, geometry)
    unknown = np.full_like(trim.residual_covariance, np.nan)
    k, c = len(model.components), len(names)
    trim = replace(trim, residual_covariance=unknown, residual=np.full(k, np.nan), channel_residual=np.full(c, np.nan))
    noise = CalibrationNoise(unknown, np.zeros(k))
    all_trims = model_without_rows(model, noise, load_components(geometry), hold_out)
    return Calibration(geometry, {MATRIX_TRIM: with_rated_loads(trim, geometry)}, all_trims)


def _channel_names(matrix: LinearMatrix, geometry: Geometry) -> tuple[str, ...]:
    """Names of the channels; a file that only orders them takes the first channels of the geometry."""
    constant = [channel for channel in geometry.channels if channel.measures_dc]
    names = matrix.channel_names
    if names is None:
        if len(constant) != len(matrix.reading_units):
            fault = f"has {len(matrix.reading_units)} columns, but the geometry {len(constant)} channels"
            raise UserError(fault, remedy="Declare one channel for each column, in the order of the file")
        names = tuple(channel.name for channel in constant)
    units = {channel.name: channel.reading_unit for channel in constant}
    for name, unit in zip(names, matrix.reading_units, strict=True):
        if units.get(name) != unit:
            fault = f"states channel `{name}` in {unit}, but the geometry declares {units.get(name, 'no such channel')}"
            raise UserError(fault, remedy="Correct `unit` of the channel, or the matrix")
    return names


def _full_range(matrix: LinearMatrix, geometry: Geometry) -> Array:
    rated = geometry.rated_loads or {}
    known = [
        size if np.isfinite(size) else rated.get(name, float("nan"))
        for name, size in zip(matrix.components, matrix.full_range, strict=True)
    ]
    for name, size in zip(matrix.components, known, strict=True):
        if not size > 0:
            fault = f"states no range of `{name}`"
            raise UserError(fault, remedy="Declare `rated_loads` in the geometry, or add a column `range`")
    return np.array(known)


def _linear_model(matrix: LinearMatrix, names: tuple[str, ...], scale: Array) -> CalibrationModel:
    """The model whose inverse is T0: equal weights of the channels make the pseudo-inverse of its C0 just that."""
    k, c = matrix.T0.shape
    unknown = np.full((k, c), np.nan)
    return CalibrationModel(
        channel_names=names,
        components=matrix.components,
        calibrated_range=scale,
        terms=matrix.components,
        coefficients=(np.linalg.pinv(matrix.T0) * scale).T,
        covariance=np.zeros((c, k, k)),
        t=unknown,
        p_value=unknown,
        variance_inflation=unknown,
        residual_covariance=np.eye(c),
        dof=np.ones(c),
        press=np.full(c, np.nan),
        cross_validation_rms=np.full(c, np.nan),
        load_series=(WITHOUT_ZEROS,),
        zeros=np.zeros((1, c)),
        zero_sigma=np.full((1, c), np.nan),
        largest_load=scale,
        smallest_load=-scale,
        unsupported_terms={},
    )
