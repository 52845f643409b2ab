"""Calibration of all trims together: calibration model, zeros, outliers, and loads held out to check it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration, CheckLoads, Drift
from balance_cli.calibration.attitude_contradiction import undetermined_weight_notes
from balance_cli.calibration.check_loads import CheckModels, HeldOutRun, evaluate_check_loads, evaluate_check_points
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, refit_terms
from balance_cli.calibration.load_directions import check_load_directions
from balance_cli.calibration.noise import CalibrationNoise, estimate_calibration_noise
from balance_cli.calibration.noniterative import fit_noniterative_model
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.outliers import ScreenedFit
from balance_cli.calibration.own_products import own_product_notes
from balance_cli.calibration.random_terms import fit_random_terms
from balance_cli.calibration.series_alarm import unpredicted_series
from balance_cli.calibration.series_zeros import series_zero_notes
from balance_cli.calibration.swapped_channels import find_swapped_channels
from balance_cli.calibration.systematic_residuals import systematic_residual_notes
from balance_cli.calibration.tare_result import Tares
from balance_cli.calibration.tares import screen_outliers_with_tares
from balance_cli.calibration.term_choice import SEARCHED, TermChoice
from balance_cli.calibration.untested_products import find_untested_products
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.load_components import LoadComponents

Array = NDArray[np.float64]
Index = NDArray[np.intp]
SAME_RANGE = 0.01
"""Relative difference of two calibrated ranges that needs no remark: above load noise, below any load step."""
MIN_ZEROS = 3
"""Zeros that a drift rate with a residual needs: a line through two of them leaves no degree of freedom."""


def calibrate_all_trims(
    points: CalibrationPoints,
    held_out: Sequence[HeldOutRun] = (),
    choice: TermChoice = SEARCHED,
    non_iterative: bool = False,
) -> AllTrimsCalibration:
    """Fit one calibration model to the points of all trims.

    With a declared response of the points swapped channels are identified. With `non_iterative` the loads are also
    fitted as functions of the readings. `choice`: the terms that the model may have.

    Raises CollinearError where a load was never applied without the others, UserError where rows contradict each other.
    """
    points = scheduled = _with_check_points(points)
    points, total, screened, tares = _with_final_range(points, *screen_outliers_with_tares(points, choice))
    check_load_directions(points, scheduled.weight > 0, _fitted_rows(screened.fit))
    fit, model, used = screened.fit, screened.fit.model, _fitted_rows(screened.fit)
    by = _fit_for_loads(total, fit, choice)
    direct = fit_noniterative_model(total, model, used, choice) if non_iterative else None
    models = _check_models(points, total, by, used, direct)
    checks = (*_held_out_checks(models, held_out, tares), *_check_points_by_run(total, by, models))
    return AllTrimsCalibration(
        model=model,
        runs=points.run_names,
        run=points.run,
        loads=total.loads,
        residuals=fit.residuals,
        cross_validation_errors=fit.cross_validation_errors,
        drift=fit_drift(model.zeros, fit.zero_covariance),
        noise=models.noise,
        outliers=screened.outliers,
        suspect_series=screened.suspect_series,
        swapped_channels=_swapped_channels(points),
        screening_notes=_screening_notes(points, screened, tares),
        non_iterative=direct,
        checks=checks,
        tares=tares,
        attitude_segment=None if points.gravity is None else points.attitude_segment,
        load_series=points.load_series,
        series_notes=scheduled.series_reading.notes or None,
        term_choice=choice,
        random_terms=None if by is fit else by.model,
    )


def _check_models(
    points: CalibrationPoints,
    total: CalibrationPoints,
    fit: CalibrationModelFit,
    used: NDArray[np.bool_],
    direct: NonIterativeModel | None,
) -> CheckModels:
    """The models that compute loads, with the noise of a reading and what the rows could not show."""
    model = fit.model
    untested = find_untested_products(model, total.loads[used], points.channels[used], points.load_series[used])
    return CheckModels(model, _estimate_noise(points, fit, used), direct, untested)


def _with_check_points(points: CalibrationPoints) -> CalibrationPoints:
    """The points with those that check the model in their schedule; unloaded ones stand for the tare points there."""
    if points.check_points is None or points.tare_points is None:
        return points
    return replace(points, tare_points=points.tare_points | (points.check_points & ~np.any(points.loads, axis=1)))


def _swapped_channels(points: CalibrationPoints) -> tuple[str, ...]:
    """The channels that are swapped, where the declared response tells."""
    declared = points.declared_response
    return () if declared is None else find_swapped_channels(points, declared * points.calibrated_range)


def _fitted_rows(fit: CalibrationModelFit) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(fit.residuals).all(axis=1))


def _fit_for_loads(points: CalibrationPoints, fit: CalibrationModelFit, choice: TermChoice) -> CalibrationModelFit:
    """The fit that computes loads: that with random terms, where terms were searched for and it has more evidence."""
    return (fit_random_terms(points, fit) if choice.is_search else None) or fit


def _held_out_checks(models: CheckModels, held_out: Sequence[HeldOutRun], tares: Tares | None) -> Iterator[CheckLoads]:
    for run in held_out:
        weight, channels = None, run.channels
        if tares is not None and run.gravity is not None:
            weight = tares.loads(run.gravity, models.model.components)
            channels = channels - tares.readings_beside_shaft(run.gravity, models.model.components)
        yield from evaluate_check_loads(models, run.name, channels, run.loads, weight)


def _screening_notes(points: CalibrationPoints, screened: ScreenedFit, tares: Tares | None) -> tuple[str, ...]:
    alarms = unpredicted_series(points, screened.fit)
    own_products = own_product_notes(points, screened.fit)
    zeros = series_zero_notes(points, screened.fit) if tares is None else ()
    weight = undetermined_weight_notes(points, screened.fit) if tares is None else ()
    systematic = systematic_residual_notes(points, screened.fit)
    return (*screened.screening_notes, *alarms, *own_products, *zeros, *weight, *systematic)


def _estimate_noise(points: CalibrationPoints, fit: CalibrationModelFit, used: NDArray[np.bool_]) -> CalibrationNoise:
    """Noise of one reading: that of a row, which may be a mean of several, and what each scatters beyond it."""
    C = fit.model.coefficients[: len(fit.model.components)].T
    noise = estimate_calibration_noise(fit.residuals[used], points.x[used], C, fit.model.residual_covariance)
    if points.repeat_scatter is None:
        return noise
    return replace(noise, reading_covariance=noise.reading_covariance + points.repeat_scatter)


def _with_final_range(
    points: CalibrationPoints, total: CalibrationPoints, screened: ScreenedFit, tares: Tares | None
) -> tuple[CalibrationPoints, CalibrationPoints, ScreenedFit, Tares | None]:
    """Refer everything to the range of the rows that were fitted, with a note where excluded rows made it smaller."""
    used = _fitted_rows(screened.fit)
    final = np.max(np.abs(points.loads[used]), axis=0)
    if np.array_equal(final, points.calibrated_range):
        return points, total, screened, tares
    notes = tuple(
        f"{name}: the calibrated range is {new:.5g}, not {old:.5g}, because the rows with larger loads were excluded"
        for name, new, old in zip(points.components, final, points.calibrated_range, strict=True)
        if new < (1.0 - SAME_RANGE) * old
    )
    points, total = (
        replace(each, calibrated_range=final, series=each.load_series, weight=np.where(used, each.weight, 0.0))
        for each in (points, total)
    )
    fit = refit_terms(total, screened.fit.model)
    model = replace(fit.model, unsupported_terms=screened.fit.model.unsupported_terms)
    fit = replace(fit, model=model)
    return points, total, replace(screened, fit=fit, screening_notes=screened.screening_notes + notes), tares


def _check_points_by_run(
    total: CalibrationPoints, fit: CalibrationModelFit, models: CheckModels
) -> Iterator[CheckLoads]:
    """Check points of each run whose load series were fitted."""
    if total.check_points is None:
        return
    fitted = np.unique(total.load_series[np.isfinite(fit.residuals).all(axis=1)])
    known = total.check_points & np.isin(total.load_series, fitted)
    for run in np.unique(total.run[known]).tolist():
        rows = known & (total.run == run)
        series = np.searchsorted(fitted, total.load_series[rows])
        name = f"{total.run_names[run]}, check points"
        yield from evaluate_check_points(models, name, total.channels[rows], total.loads[rows], series)


def fit_drift(zeros: Array, covariance: Array) -> Drift:
    """Fit a straight line through the zeros (s, c) of the load series in their order.

    Generalized least squares with the covariance (c, s, s) of each channel's zeros (Aitken, 1935).
    """
    s, c = zeros.shape
    if s < MIN_ZEROS:
        return Drift(*(np.full(c, np.nan) for _ in range(3)))
    line = np.column_stack([np.ones(s), np.arange(s) - 0.5 * (s - 1)])
    slope, sigma, chi2_per_dof = np.zeros(c), np.zeros(c), np.zeros(c)
    for channel in range(c):
        weighted = np.linalg.solve(covariance[channel], np.column_stack([line, zeros[:, channel]]))
        inverse = np.linalg.inv(line.T @ weighted[:, :2])
        coefficients = inverse @ (line.T @ weighted[:, 2])
        residual = zeros[:, channel] - line @ coefficients
        slope[channel], sigma[channel] = coefficients[1], np.sqrt(inverse[1, 1])
        chi2_per_dof[channel] = residual @ np.linalg.solve(covariance[channel], residual) / (s - 2)
    return Drift(slope, sigma, chi2_per_dof)


def read_load_points(run: Run, channel_names: Sequence[str], components: LoadComponents) -> tuple[Array, Array]:
    """Read the readings (m, c) [V] and loads (m, k) [N, N m] of a static run."""
    loads = run.read().loads
    assert loads is not None
    return read_channels(run, channel_names), components.from_hub_loads(loads)
