"""Load series that the others do not predict although they are fitted: the model rests on them alone, or is wrong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints

MIN_ERROR_SHARE = 0.05
"""Share of a channel's range: no balance is used to this error, and terms of single series cause far more."""
MIN_ERROR_RATIO = 10.0
"""Error over the residual of the fit: extrapolation from the other series alone explains a few times the residual."""
MAX_NOTES = 3
"""Load series that are named one by one; with more of them the model as a whole is at fault."""


def unpredicted_series(points: CalibrationPoints, fit: CalibrationModelFit) -> Iterator[str]:
    """Notes on the load series whose prediction by the others is far worse than their fit."""
    used = np.asarray(np.isfinite(fit.residuals).all(axis=1))
    spread = np.maximum(np.ptp(points.channels[used], axis=0), np.finfo(float).tiny)
    sigma = np.sqrt(np.diag(fit.model.residual_covariance))
    notes = []
    for name, description in zip(np.unique(points.load_series[used]), fit.model.load_series, strict=True):
        errors = fit.cross_validation_errors[(points.load_series == name) & used]
        if not np.isfinite(errors).any():
            continue
        rms = np.sqrt(np.nanmean(np.where(np.isfinite(errors), errors, 0.0) ** 2, axis=0))
        share = np.where(rms > MIN_ERROR_RATIO * sigma, rms / spread, 0.0)
        c = int(np.argmax(share))
        if share[c] > MIN_ERROR_SHARE:
            predicted, fitted = 100.0 * share[c], 100.0 * sigma[c] / spread[c]
            notes.append(
                f"{description}: the other load series predict {points.channel_names[c]} to {predicted:.2g} % of its "
                f"range only, where the fit leaves {fitted:.2g} %: the model rests on this series alone, or is wrong"
            )
    yield from notes[:MAX_NOTES]
    if len(notes) > MAX_NOTES:
        yield f"{len(notes) - MAX_NOTES} more load series are not predicted by the others either"
