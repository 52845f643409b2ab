"""The linear calibration model that the matrix of one trim stands for."""

from __future__ import annotations

import numpy as np

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.result import TrimCalibration

WITHOUT_ZEROS = "a matrix without zeros"
"""Description of the one load series of a model from a linear matrix; stored in artefacts."""


def model_of_trim(trim: TrimCalibration) -> CalibrationModel:
    """Convert the straight line of a trim to a calibration model with linear terms.

    Its one zero is the line at zero load. Its limits are the calibrated range in both directions. Statistics of a
    search for terms are NaN.
    """
    k, c = len(trim.components), len(trim.channel_names)
    coefficients = (trim.C0 * trim.calibrated_range).T
    scale = trim.calibrated_range[:, None] * trim.calibrated_range
    covariance = np.einsum("iaib->iab", trim.C0_covariance) * scale
    unknown = np.full((k, c), np.nan)
    return CalibrationModel(
        channel_names=trim.channel_names,
        components=trim.components,
        calibrated_range=trim.calibrated_range,
        terms=trim.components,
        coefficients=coefficients,
        covariance=covariance,
        t=unknown,
        p_value=unknown,
        variance_inflation=unknown,
        residual_covariance=trim.residual_covariance,
        dof=np.full(c, float(trim.dof)),
        press=np.full(c, np.nan),
        cross_validation_rms=np.full(c, np.nan),
        load_series=(f"trim {trim.trim}",),
        zeros=(trim.mean_channels - trim.C0 @ trim.mean_load)[None],
        zero_sigma=np.full((1, c), np.nan),
        largest_load=trim.calibrated_range,
        smallest_load=-trim.calibrated_range,
        unsupported_terms={},
    )
