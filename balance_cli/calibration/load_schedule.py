"""What a load schedule can tell: loads and their combinations, condition, variance inflation, and what it leaves open.

The review of a calibration design that AIAA R-091A-2020 recommends. All figures rest on the applied loads alone, in
units of the calibrated range, with one zero for each load series.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.noise import APPLIED_SHARE

Array = NDArray[np.float64]
Counts = NDArray[np.intp]

SAME_LEVEL = 0.02
"""Share of the calibrated range within which two loads are one level: above load noise, below the steps."""
HIGH_INFLATION = 10.0
"""Variance inflation above which a load is nearly collinear with others (rule of thumb: Marquardt, 1970)."""
HIGH_CORRELATION = 0.9
"""Correlation of two loads from which their effects are hardly told apart: inflation of 5 for two loads alone."""


@dataclass(frozen=True)
class LoadSchedule:
    """Statistics of the applied loads; counts of rows that were fitted, for k components.

    `applied`, `alone` and `levels` (k,): rows with the load, rows with this load only, distinct levels; `series` (k,):
    load series that vary it; `smallest`, `largest` (k,) [N, N m]. `together` (k, k): rows in which two loads are
    applied; `correlation` (k, k) of the loads within the series. `condition` of the linear design, columns of unit
    norm; `inflation` (k,): variance inflation. `combined`: most loads at a time; `load_sum`: largest sum of the loads
    of a row in units of their ranges.
    """

    components: tuple[str, ...]
    rows: int
    series_count: int
    applied: Counts
    alone: Counts
    levels: Counts
    series: Counts
    smallest: Array
    largest: Array
    together: Counts
    correlation: Array
    condition: float
    inflation: Array
    combined: int
    load_sum: float
    open_questions: tuple[str, ...]


def review_load_schedule(all_trims: AllTrimsCalibration, load_series: Counts) -> LoadSchedule:
    """Review the loads of the rows that were fitted; `load_series` (m,) numbers the series of all rows."""
    used = np.isfinite(all_trims.residuals).all(axis=1)
    x, series = (all_trims.loads / all_trims.model.calibrated_range)[used], load_series[used]
    is_on = np.abs(x) > APPLIED_SHARE
    correlation, condition, inflation = _design(x, series)
    schedule = LoadSchedule(
        components=all_trims.model.components,
        rows=len(x),
        series_count=len(np.unique(series)),
        applied=is_on.sum(axis=0),
        alone=(is_on & (is_on.sum(axis=1) == 1)[:, None]).sum(axis=0),
        levels=np.array([len(np.unique(np.round(column / SAME_LEVEL))) for column in x.T]),
        series=_series_that_vary(x, series),
        smallest=all_trims.model.smallest_load,
        largest=all_trims.model.largest_load,
        together=is_on.T.astype(np.intp) @ is_on.astype(np.intp),
        correlation=correlation,
        condition=condition,
        inflation=inflation,
        combined=int(is_on.sum(axis=1).max(initial=0)),
        load_sum=float(np.abs(x).sum(axis=1).max(initial=0.0)),
        open_questions=(),
    )
    questions = (*_open_questions(schedule), *_missing_validation(all_trims))
    return LoadSchedule(**{**vars(schedule), "open_questions": questions})


def components_of_one_series(all_trims: AllTrimsCalibration) -> tuple[str, ...]:
    """Return the loads that one load series alone varies, beside others: an error of its loads leaves no residual."""
    if all_trims.load_series is None:
        return ()
    used = np.isfinite(all_trims.residuals).all(axis=1)
    x, series = (all_trims.loads / all_trims.model.calibrated_range)[used], all_trims.load_series[used]
    if len(np.unique(series)) < 2:
        return ()
    counts = _series_that_vary(x, series)
    return tuple(name for name, count in zip(all_trims.model.components, counts, strict=True) if count == 1)


def _series_that_vary(x: Array, series: Counts) -> Counts:
    """Number (k,) of load series in which each load of the rows x (m, k) varies."""
    varied = [np.ptp(x[series == number], axis=0) > APPLIED_SHARE for number in np.unique(series)]
    return np.asarray(np.sum(varied, axis=0), np.intp)


def _design(x: Array, series: Counts) -> tuple[Array, float, Array]:
    """Correlation (k, k), condition and variance inflation (k,) of the loads, with one zero for each series."""
    centered = subtract_block_means(x, series)
    size = np.linalg.norm(centered, axis=0)
    scaled = centered / np.where(size > 0, size, 1.0)
    correlation = scaled.T @ scaled
    singular = np.linalg.svd(scaled, compute_uv=False)
    if singular[-1] <= np.finfo(float).eps * singular[0] * len(x):
        return correlation, float("inf"), np.full(x.shape[1], np.inf)
    return correlation, float(singular[0] / singular[-1]), np.diag(np.linalg.inv(correlation))


def _open_questions(schedule: LoadSchedule) -> Iterator[str]:
    names = schedule.components
    for j, name in enumerate(names):
        if schedule.smallest[j] >= 0 or schedule.largest[j] <= 0:
            direction = "upwards" if schedule.smallest[j] >= 0 else "downwards"
            yield f"{name} was loaded {direction} only: a difference between the two directions cannot be found."
        if not schedule.alone[j]:
            yield f"{name} was never applied alone: its effect rests on the separation from the loads beside it."
        if schedule.levels[j] < 4:
            yield f"{name} has {schedule.levels[j]} levels: its nonlinear terms cannot be separated or tested."
        if schedule.series[j] == 1 and schedule.series_count > 1:
            yield f"{name} is varied in one load series only: no other series can confirm its coefficients."
        if schedule.inflation[j] > HIGH_INFLATION:
            yield f"{name} is nearly a combination of the other loads (variance inflation {schedule.inflation[j]:.0f})."
    never_together = [
        f"{names[i]} {names[j]}"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if not schedule.together[i, j]
    ]
    if never_together:
        yield f"Never applied together, so that their interaction is not known: {', '.join(never_together)}."
    if schedule.series_count == 1:
        yield "There is one load series: its zero cannot be checked, and no series can be left out to test the model."


def _missing_validation(all_trims: AllTrimsCalibration) -> Iterator[str]:
    """What the calibration cannot confirm because nothing independent was measured."""
    known = np.isfinite(all_trims.cross_validation_errors).any(axis=1)
    used = np.isfinite(all_trims.residuals).all(axis=1)
    untested = int(np.count_nonzero(used & ~known))
    if untested:
        yield (
            f"{untested} of {int(used.sum())} rows cannot be predicted by the other load series, which do not "
            "determine all terms: there the residual is no validation."
        )
    if not all_trims.checks:
        yield "No check loads were held out: the prediction intervals are not confirmed by independent loads."
