"""Outliers of a calibration: rows and load series that the others do not predict.

Rows and load series are compared with predictions from the rest of the data, never with a fit that includes them, nor
with terms that were selected with them. The scale of the errors is a median, which outliers hardly affect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import Outlier, SuspectLoadSeries
from balance_cli.calibration.contradicted_block import contradicted_block, contradiction_note
from balance_cli.calibration.contradicted_series import contradicted_series, describe_contradicted_series
from balance_cli.calibration.exclusion_test import rows_of_chance
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, fit_calibration_model, refit_terms
from balance_cli.calibration.gross_outliers import gross_outlier_candidates, misplaced_rows
from balance_cli.calibration.outlier_causes import exchanged_rows, likely_cause
from balance_cli.calibration.row_errors import errors_without, have_load_errors, outlier_limit, row_sigma
from balance_cli.calibration.suspect_series import exclude_suspect_series
from balance_cli.calibration.term_choice import SEARCHED, TermChoice
from balance_cli.calibration.unloading_rows import include_unloading_rows
from balance_cli.io.units import VOLTAGE

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

MAX_OUTLIER_SHARE = 0.05
"""Share of the rows that may be outliers; more of them point to the model instead of the rows."""
MIN_OUTLIERS = 2
"""Rows that may be outliers in any calibration: two that are exchanged."""
MAX_SCREENINGS = 4
"""Rounds of selecting terms and excluding rows; without a further outlier the rounds end."""


@dataclass(frozen=True)
class ScreenedFit:
    """The fit without outliers and suspect load series, these, and notes where the screening stopped early."""

    fit: CalibrationModelFit
    outliers: tuple[Outlier, ...]
    suspect_series: tuple[SuspectLoadSeries, ...]
    screening_notes: tuple[str, ...]


def screen_outliers(points: CalibrationPoints, choice: TermChoice = SEARCHED) -> ScreenedFit:
    """Fit without suspect load series and outlying rows.

    Everything that is excluded is listed in the result.
    """
    contradicted, given = contradicted_series(points, choice), points
    block = contradicted_block(points, choice, contradicted)
    if block is not None:
        contradicted = (block.rows,) if block.is_minority else ()
    for rows in contradicted:
        points = points.exclude_rows(rows)
    gross = _gross_outliers(points, choice)
    included, fit, suspect_series, notes = exclude_suspect_series(points.exclude_rows(gross), choice)
    excluded, stopped = gross, False
    for _ in range(MAX_SCREENINGS):
        further, stopped = _outlying_rows(included, fit, _most_outliers(points) - int(np.count_nonzero(excluded)))
        if not further.any():
            break
        excluded, included = excluded | further, included.exclude_rows(further)
        fit = fit_calibration_model(included, choice)
    outlying = excluded
    excluded, fit = _include_predicted_rows(points, included, fit, outlying, choice)
    excluded, fit = _include_load_errors(points, included, fit, excluded, choice)
    included = replace(included, weight=np.where(outlying & ~excluded, points.weight, included.weight))
    excluded, fit, lags = include_unloading_rows(points, included, fit, excluded, choice)
    notes = (*notes, *lags)
    included = replace(included, weight=np.where(outlying & ~excluded, points.weight, included.weight))
    excluded, fit, notes = _include_rows_of_chance(points, included, fit, excluded, choice, notes)
    # Where some were included again, those that remained may have been like them.
    if stopped and excluded.any() and np.array_equal(excluded, outlying):
        number = int(np.count_nonzero(excluded))
        which = "1 row was" if number == 1 else f"{number} rows were"
        notes = (*notes, f"{which} excluded as outliers, and more remain")
    if block is not None and not block.is_minority:
        notes = (contradiction_note(given, fit.model, block.rows), *notes)
    suspect_series = (*describe_contradicted_series(fit.model, given, contradicted), *suspect_series)
    return ScreenedFit(fit, describe_outliers(points, fit, excluded), suspect_series, notes)


def _include_predicted_rows(
    points: CalibrationPoints, included: CalibrationPoints, fit: CalibrationModelFit, excluded: Mask, choice: TermChoice
) -> tuple[Mask, CalibrationModelFit]:
    """Include excluded rows (m,) that the final fit predicts: they stood out beside errors since excluded themselves.

    Returns the rows that stay excluded, and the fit. Nothing changes where the fit with them does not predict a row.
    """
    fitted = np.unique(points.load_series[np.isfinite(fit.residuals).all(axis=1)])
    candidates = excluded & np.isin(points.load_series, fitted) & ~misplaced_rows(points)
    with_candidates = replace(included, weight=np.where(candidates, points.weight, included.weight))
    ratio = _prediction_ratio(with_candidates, fit, candidates)
    predicted = candidates & (ratio <= outlier_limit(included, fit))
    if not predicted.any():
        return excluded, fit
    further = replace(included, weight=np.where(predicted, points.weight, included.weight))
    again = fit_calibration_model(further, choice)
    return (excluded, fit) if _largest_outlier(further, again) is not None else (excluded & ~predicted, again)


def _include_load_errors(
    points: CalibrationPoints, included: CalibrationPoints, fit: CalibrationModelFit, excluded: Mask, choice: TermChoice
) -> tuple[Mask, CalibrationModelFit]:
    """Include excluded rows (m,) whose loads are off by no more than weights are."""
    candidates = excluded & ~misplaced_rows(points)
    with_candidates = replace(included, weight=np.where(candidates, points.weight, included.weight))
    usual = have_load_errors(with_candidates, fit, candidates)
    if not usual.any():
        return excluded, fit
    further = replace(included, weight=np.where(usual, points.weight, included.weight))
    return excluded & ~usual, fit_calibration_model(further, choice)


def _include_rows_of_chance(
    points: CalibrationPoints,
    included: CalibrationPoints,
    fit: CalibrationModelFit,
    excluded: Mask,
    choice: TermChoice,
    notes: tuple[str, ...],
) -> tuple[Mask, CalibrationModelFit, tuple[str, ...]]:
    """Include the excluded rows (m,) where so few rows are left that these may fit well by chance alone."""
    standing_out = excluded & ~misplaced_rows(points)
    if standing_out.any():
        standing_out = rows_of_chance(points, included, fit, standing_out)
    if not standing_out.any():
        return excluded, fit, notes
    rows = np.flatnonzero(standing_out)
    names = ", ".join(f"{points.run_names[points.run[row]]} row {_row_in_run(points, row)}" for row in rows.tolist())
    is_one = len(rows) == 1
    note = f"{names} {'deviates' if is_one else 'deviate'} from the others, which may be chance with so few rows or so"
    note += f" uneven errors; {'it was' if is_one else 'they were'} not excluded"
    included = replace(included, weight=np.where(standing_out, points.weight, included.weight))
    return excluded & ~standing_out, fit_calibration_model(included, choice), (*notes, note)


def _row_in_run(points: CalibrationPoints, row: int) -> int:
    """Number from 1 of a row in its run."""
    return row - int(np.flatnonzero(points.run == points.run[row])[0]) + 1


def _most_outliers(points: CalibrationPoints) -> int:
    return max(MIN_OUTLIERS, int(np.ceil(MAX_OUTLIER_SHARE * np.count_nonzero(points.weight > 0))))


def _gross_outliers(points: CalibrationPoints, choice: TermChoice) -> Mask:
    """Rows (m,) that stand out from a robust fit and are not predicted by a model that was selected without them.

    Where the model that was selected with them leaves none of them an outlier, and the others no larger errors, they
    are evidence of a term and no mistake.
    """
    none, misplaced = np.zeros(len(points.weight), bool), misplaced_rows(points)
    gross = gross_outlier_candidates(points)
    if not gross.any() or not _is_testable(points, gross):
        return none
    for _ in range(MAX_SCREENINGS):
        fit = fit_calibration_model(points.exclude_rows(gross), choice)
        ratio = np.where(misplaced, np.inf, _prediction_ratio(points, fit, gross))
        agreeing = gross & (ratio <= outlier_limit(points, fit))
        gross = gross & ~agreeing
        if not agreeing.any() or not gross.any():
            break
    if not gross.any():
        return none
    gross = gross & (ratio >= np.sort(ratio[gross])[::-1][: _most_outliers(points)].min())
    if misplaced.any():
        return np.asarray(gross)
    alone = _single_outlier(points, choice, gross)
    if alone is not None:
        return alone
    without = points.exclude_rows(gross)
    fit, fit_to_all = fit_calibration_model(without, choice), fit_calibration_model(points, choice)
    outlying, _ = _outlying_rows(points, fit_to_all, int(np.count_nonzero(gross)))
    # In a short series a wrong row makes another one stand out: then all must agree without the wrong one.
    is_explained = (
        not (outlying & gross).any()
        and not (outlying.any() and _largest_outlier(without, fit) is None)
        and _agrees_unmasked(points, fit, fit_to_all, gross)
    )
    return (
        none
        if is_explained and _scale(points, fit_to_all, ~gross) <= SAME_SCALE * _scale(points, fit, ~gross)
        else gross
    )


def _is_testable(points: CalibrationPoints, rows: Mask) -> bool:
    """Whether the others than some rows (m,) have a degree of freedom beside the loads: else they pass them exactly."""
    used = (points.weight > 0) & ~rows
    return bool(np.count_nonzero(used) - len(np.unique(points.load_series[used])) > len(points.components))


def _agrees_unmasked(
    points: CalibrationPoints, fit: CalibrationModelFit, whole: CalibrationModelFit, rows: Mask
) -> bool:
    """Whether the others predict some rows (m,) by the terms of the fit to all, and by a scale that is made without."""
    sigma = row_sigma(points, fit, (points.weight > 0) & ~rows)
    errors = np.abs(whole.press * np.sqrt(points.weight)[:, None])
    return bool(np.max(errors[rows] / sigma[rows]) <= outlier_limit(points, whole))


def _single_outlier(points: CalibrationPoints, choice: TermChoice, gross: Mask) -> Mask | None:
    """The one row of several (m,) without which none of them stands out; None where none, or more than one, does that.

    In a short load series a wrong row can make all the others look wrong.
    """
    rows = np.flatnonzero(gross)
    if not 1 < len(rows) <= MOST_SINGLE_TRIALS:
        return None
    sufficient = []
    for row in rows.tolist():
        alone = np.arange(len(gross)) == row
        without = points.exclude_rows(alone)
        if _largest_outlier(without, fit_calibration_model(without, choice)) is None:
            sufficient.append(alone)
    return sufficient[0] if len(sufficient) == 1 else None


MOST_SINGLE_TRIALS = 5
"""Rows of which each is tried as the only outlier: the length of the shortest usual load series."""
SAME_SCALE = 1.2
"""Ratio of two robust scales that differ by chance in some dozens of rows."""


def _scale(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask) -> float:
    """Median size of the errors of rows (m,) predicted by all others, over the range of each channel."""
    at = rows & (points.weight > 0)
    spread = np.maximum(np.ptp(points.channels[at], axis=0), np.finfo(float).tiny)
    return float(np.mean(np.nanmedian(np.abs(fit.press[at]), axis=0) / spread))


def _prediction_ratio(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask) -> Array:
    """Largest error of some rows (m,) of which the fit knows nothing, over its sigma; 0 for the others."""
    errors = errors_without(points, fit, rows)
    used = (points.weight > 0) & ~rows
    sigma = row_sigma(points, fit, used)
    known = np.where(rows[:, None], np.sqrt(points.weight)[:, None] * errors, 0.0)
    extrapolated = np.sqrt(fit.model.model_covariance(points.loads).diagonal(axis1=1, axis2=2))
    return np.asarray(np.max(np.abs(known) / np.hypot(sigma, extrapolated), axis=1))


def _outlying_rows(points: CalibrationPoints, fit: CalibrationModelFit, most: int) -> tuple[Mask, bool]:
    """Rows (m,) that the others do not predict, at most `most` of them, and whether more remain.

    A degree of freedom remains, too: without any the others agree with each other whatever they are.
    """
    excluded = np.zeros(len(points.weight), bool)
    # One by one, refitted each time: an outlier biases the predictions of the rows near it.
    row = _largest_outlier(points, fit)
    while row is not None and np.count_nonzero(excluded) < most and np.min(fit.model.dof) > 1:
        excluded[row] = True
        points = points.exclude_rows(excluded)
        fit = refit_terms(points, fit.model)
        row = _largest_outlier(points, fit)
    return excluded, row is not None


def _largest_outlier(points: CalibrationPoints, fit: CalibrationModelFit) -> int | None:
    """The row with the largest error when predicted by all others; None if it is not significant."""
    used = points.weight > 0
    errors = np.abs(fit.press * np.sqrt(points.weight)[:, None])
    ratio = np.max(np.where(used[:, None], errors / row_sigma(points, fit, used), 0.0), axis=1)
    row = int(np.argmax(ratio))
    return row if ratio[row] > outlier_limit(points, fit) else None


def describe_outliers(points: CalibrationPoints, fit: CalibrationModelFit, excluded: Mask) -> tuple[Outlier, ...]:
    """The excluded rows (m,) with their errors by the final fit, and what seems to be wrong with them."""
    if not excluded.any():
        return ()
    errors = errors_without(points, fit, excluded)
    used = (points.weight > 0) & ~excluded
    sigma = row_sigma(points, fit, used)
    partner = exchanged_rows(points, fit, excluded)
    outliers = []
    for row in np.flatnonzero(excluded).tolist():
        ratio = np.abs(errors[row]) * np.sqrt(points.weight[row]) / sigma[row]
        c = int(np.argmax(ratio))
        outlier = Outlier(
            run=points.run_names[int(points.run[row])],
            row=_row_in_run(points, row),
            channel=points.channel_names[c],
            error=float(errors[row, c]),
            over_sigma=float(ratio[c]),
            unit=points.reading_unit(c) if points.reading_unit(c) != VOLTAGE else None,
        )
        other = partner.get(row)
        cause = None if other is not None else likely_cause(fit.model, points, row, errors[row])
        outliers.append(
            replace(outlier, exchanged_with=None if other is None else _row_in_run(points, other), cause=cause)
        )
    return tuple(outliers)
