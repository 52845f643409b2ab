"""Fit of the calibration model: supported terms, term selection by channel, coefficients and residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import BlockZeros
from balance_cli.calibration.least_squares import LeastSquares, solve_least_squares, weighted_rms
from balance_cli.calibration.load_series import describe_all_series
from balance_cli.calibration.load_series_reading import SeriesReading, read_load_series
from balance_cli.calibration.load_series_score import ScheduleRows
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.repeated_tares import lack_of_fit_model
from balance_cli.calibration.term_choice import SEARCHED, TermChoice
from balance_cli.calibration.term_search import search_terms
from balance_cli.calibration.term_support import find_supported_terms
from balance_cli.calibration.terms import Term, linear_terms, term_values
from balance_cli.campaign.rig.attitude import attitude_segments
from balance_cli.io.errors import UserError
from balance_cli.io.units import VOLTAGE

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class CalibrationPoints:
    """Rows of all runs in the order of loading: `channels` (m, c) [V] and `loads` (m, k) [N, N m].

    `calibrated_range` (k,) [N, N m] scales the loads; `run` (m,) is an index into `run_names`; `weight` (m,) follows
    from the noise of the run, 0 excludes a row. `gravity` (m, 3): unit vectors in rig axes, NaN for runs without an
    attitude, or None. `stated_series` (m,): labels of the load series, or empty; `series` (m,): numbers where known.
    `tare_points`, `check_points` (m,): rows stated to be that, the latter of weight 0. `reading_units` (c,), default V;
    `declared_response` (c, k) [V/N, V/(N m)], of the geometry, and `plate_response` to moments beside a shaft with a
    torque meter, NaN elsewhere. `repeat_scatter` (c, c) [V2]: what one reading scatters more than a mean of repeats.
    """

    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    run_names: tuple[str, ...]
    channels: Array
    loads: Array
    run: Index
    weight: Array
    calibrated_range: Array
    gravity: Array | None = None
    stated_series: tuple[str, ...] = ()
    tare_points: NDArray[np.bool_] | None = None
    check_points: NDArray[np.bool_] | None = None
    series: Index | None = None
    reading_units: tuple[str, ...] = ()
    declared_response: Array | None = None
    plate_response: Array | None = None
    repeat_scatter: Array | None = None

    def reading_unit(self, channel: int) -> str:
        """Base unit of the readings of a channel."""
        return self.reading_units[channel] if self.reading_units else VOLTAGE

    @property
    def x(self) -> Array:
        """Loads (m, k) in units of the calibrated range."""
        return self.loads / self.calibrated_range

    @cached_property
    def load_series(self) -> Index:
        """Number (m,) of the load series of each row."""
        return self.series_reading.load_series

    @cached_property
    def series_reading(self) -> SeriesReading:
        """The load series of the rows, and how they were found."""
        if self.series is not None:
            return SeriesReading(self.series, ())
        m = len(self.loads)
        return read_load_series(
            ScheduleRows(
                x=self.x,
                channels=self.channels,
                used=(self.weight > 0) | (np.zeros(m, bool) if self.check_points is None else self.check_points),
                segment=self.attitude_segment,
                run=self.run,
                run_names=self.run_names,
                stated=self.stated_series or ("",) * m,
                tare=np.zeros(m, bool) if self.tare_points is None else self.tare_points,
            )
        )

    @cached_property
    def attitude_segment(self) -> Index:
        """Number (m,) of the segment of each row: consecutive rows of one run in one attitude."""
        return attitude_segments(self.run, self.gravity)

    def exclude_rows(self, rows: NDArray[np.bool_]) -> CalibrationPoints:
        """Copy with zero weight for some rows (m,), which keep their place in the order of loading."""
        return replace(self, weight=np.where(rows, 0.0, self.weight), series=self.load_series)


@dataclass(frozen=True)
class CalibrationModelFit:
    """The model with its errors in all rows (m, c) [V].

    `residuals`; `press`: errors where all other rows predict the row; `cross_validation_errors`: errors where the other
    load series predict it. NaN where a row has no weight or the other series do not determine a term.
    `zero_covariance` (c, s, s) [V2]: covariance of each channel's zeros, which share the errors of the coefficients.
    """

    model: CalibrationModel
    residuals: Array
    press: Array
    cross_validation_errors: Array
    zero_covariance: Array


def fit_calibration_model(
    points: CalibrationPoints, choice: TermChoice = SEARCHED, schedule: Array | None = None
) -> CalibrationModelFit:
    """Fit the calibration model with the terms of a `choice`: by default those that a search selects for each channel.

    `schedule` (m, k): the loads that were applied, in units of the calibrated range, where `points` hold other
    regressors; they decide which terms are supported.

    Raises least_squares.CollinearError where a load was never applied without the others.
    """
    k, used = len(points.components), points.weight > 0
    x, load_series = points.x[used], points.load_series[used]
    terms, unsupported = linear_terms(k), {}
    if not choice.is_linear:
        applied = points.x if schedule is None else schedule
        candidates, jointly = choice.candidates(points.components), not choice.is_search
        support = find_supported_terms(
            candidates, applied[used], load_series, points.components, jointly, applied[~used]
        )
        terms, unsupported = support.terms, support.unsupported
    X, Y, w = term_values(terms, x), points.channels[used], points.weight[used]
    solve_least_squares(X[:, :k], Y, load_series, w)  # raises where the loads are collinear
    channel_terms = [tuple(range(k))] * Y.shape[1]
    if not choice.is_search:
        channel_terms = _fixed_terms(points, choice, terms)
    elif len(X) > k + len(np.unique(load_series)) + 1:
        quadratic = [place for place, term in enumerate(terms) if term.is_quadratic]
        channel_terms = search_terms(X, Y, x, load_series, w, quadratic, choice.significance)
    return _fit_terms(points, terms, unsupported, channel_terms)


def _fixed_terms(points: CalibrationPoints, choice: TermChoice, terms: Sequence[Term]) -> list[tuple[int, ...]]:
    """Indices into `terms` of those of each channel, where they are not searched for.

    Raises UserError where the rows do not determine so many coefficients.
    """
    terms_by_channel = []
    # A list can name terms by channel; else all have the same, found once.
    of_all = None if choice.by_channel else choice.of_channel("", points.components)
    for channel in points.channel_names:
        own = choice.of_channel(channel, points.components) if of_all is None else of_all
        terms_by_channel.append(tuple(place for place, term in enumerate(terms) if term in own))
    rows, zeros = int(np.count_nonzero(points.weight > 0)), len(np.unique(points.load_series[points.weight > 0]))
    most = max(map(len, terms_by_channel))
    if rows - zeros <= most:
        fault = f"{rows} load points in {zeros} load series do not determine {most} terms of a channel"
        raise UserError(fault, place="--terms", remedy="Apply more load points, or give fewer terms")
    return terms_by_channel


def refit_terms(points: CalibrationPoints, model: CalibrationModel) -> CalibrationModelFit:
    """Fit the terms that a model has to other points."""
    channel_terms = [tuple(np.flatnonzero(np.isfinite(column)).tolist()) for column in model.t.T]
    return _fit_terms(points, model.parsed_terms, {}, channel_terms)


@dataclass(frozen=True)
class ChannelFits:
    """Fits of all channels, each with its selected columns of X (m, p), to the m rows `used` of the points.

    `groups`: the channels of each of the `fits`, which have the same columns.
    """

    points: CalibrationPoints
    used: NDArray[np.bool_]
    X: Array
    selected: tuple[tuple[int, ...], ...]
    groups: tuple[tuple[int, ...], ...]
    fits: tuple[LeastSquares, ...]

    @cached_property
    def load_series(self) -> Index:
        """Load series (m,) of each row used."""
        return np.asarray(self.points.load_series[self.used])

    @cached_property
    def weight(self) -> Array:
        """Weight (m,) of each row used."""
        return np.asarray(self.points.weight[self.used])

    def stack(self, values: Callable[[LeastSquares], Array]) -> Array:
        """One column (m, c) per channel of what `values` takes (m, g) from the fit of its group."""
        return np.hstack([values(fit) for fit in self.fits])[:, np.argsort(np.concatenate(self.groups))]


def _fit_terms(
    points: CalibrationPoints,
    terms: Sequence[Term],
    unsupported: dict[Term, str],
    channel_terms: Sequence[tuple[int, ...]],
) -> CalibrationModelFit:
    """Fit each channel with its selected terms, given as indices into `terms`."""
    used = points.weight > 0
    X, load_series, w = term_values(terms, points.x[used]), points.load_series[used], points.weight[used]
    by_terms = {terms: tuple(c for c, own in enumerate(channel_terms) if own == terms) for terms in channel_terms}
    fits = tuple(
        solve_least_squares(X[:, list(selected)], points.channels[used][:, list(group)], load_series, w)
        for selected, group in by_terms.items()
    )
    channels = ChannelFits(points, used, X, tuple(channel_terms), tuple(by_terms.values()), fits)
    fit = assemble_fit(channels, terms, unsupported)
    model, growth = lack_of_fit_model(fit.model, fit.residuals[used], w, points.x[used], load_series)
    return replace(fit, model=model, zero_covariance=fit.zero_covariance * growth[:, None, None])


def assemble_fit(channels: ChannelFits, terms: Sequence[Term], unsupported: dict[Term, str]) -> CalibrationModelFit:
    """The model of all channels, and its errors in all rows, from the fits of the channels."""
    points, w, names = channels.points, channels.weight, channels.points.components
    residuals, press = channels.stack(lambda fit: fit.residuals), channels.stack(lambda fit: fit.press_residuals)
    left_out = channels.stack(lambda fit: fit.cross_validation_errors(channels.load_series))
    dof = channels.stack(lambda fit: np.full((1, fit.residuals.shape[1]), float(fit.dof)))[0]
    zeros, zero_covariance = _series_zeros(channels)
    model = CalibrationModel(
        channel_names=points.channel_names,
        components=names,
        calibrated_range=points.calibrated_range,
        terms=tuple(terms[i].name(names) for i in _terms_in_model(channels)),
        **_coefficient_tables(channels),
        residual_covariance=(residuals.T * w) @ residuals / np.sqrt(dof[:, None] * dof),
        dof=dof,
        press=weighted_rms(press, w),
        cross_validation_rms=weighted_rms(left_out, w),
        load_series=describe_all_series(
            points.load_series, points.weight > 0, points.run, points.run_names, names, points.x
        ),
        zeros=zeros,
        zero_sigma=np.sqrt(np.diagonal(zero_covariance, axis1=1, axis2=2)).T,
        largest_load=points.loads[channels.used].max(axis=0),
        smallest_load=points.loads[channels.used].min(axis=0),
        unsupported_terms={term.name(names): reason for term, reason in unsupported.items()},
    )
    residuals, press, left_out = (_expand_to_all_rows(errors, channels.used) for errors in (residuals, press, left_out))
    return CalibrationModelFit(model, residuals, press, left_out, zero_covariance)


def _terms_in_model(channels: ChannelFits) -> list[int]:
    """Indices of the terms that at least one channel has."""
    return sorted(set().union(*channels.selected))


def _coefficient_tables(channels: ChannelFits) -> dict[str, Array]:
    """Coefficients and what is known of them, by the field of CalibrationModel, for the p terms of the model."""
    place = {term: i for i, term in enumerate(_terms_in_model(channels))}
    p, c = len(place), len(channels.selected)
    tables = {name: np.full((p, c), np.nan) for name in ("t", "p_value", "variance_inflation")}
    coefficients, covariance = np.zeros((p, c)), np.zeros((c, p, p))
    for group, fit in zip(channels.groups, channels.fits, strict=True):
        at = np.array([place[term] for term in channels.selected[group[0]]], np.intp)
        own = np.array(group, np.intp)
        cells = np.ix_(at, own)
        coefficients[cells], tables["t"][cells], tables["p_value"][cells] = fit.coefficients, fit.t, fit.p_value
        tables["variance_inflation"][cells] = fit.variance_inflation[:, None]
        covariance[np.ix_(own, at, at)] = fit.variance[:, None, None] * fit.inverse
    return {"coefficients": coefficients, "covariance": covariance, **tables}


def _series_zeros(channels: ChannelFits) -> tuple[Array, Array]:
    """Zeros (s, c) of the load series [V], and the covariance (c, s, s) of each channel's zeros.

    With M (s, p) the means of the terms in each series: s^2 (diag(1/n) + M (R'R)^-1 M').
    """
    blocks = BlockZeros.from_blocks(channels.load_series, channels.weight)
    M = blocks.means(channels.X * blocks.root[:, None])
    share = np.diag(1.0 / blocks.total)
    covariance = np.zeros((len(channels.selected), *share.shape))
    for group, fit in zip(channels.groups, channels.fits, strict=True):
        own = M[:, list(channels.selected[group[0]])]
        covariance[list(group)] = fit.variance[:, None, None] * (share + own @ fit.inverse @ own.T)
    return channels.stack(lambda fit: fit.zeros), covariance


def _expand_to_all_rows(values: Array, used: NDArray[np.bool_]) -> Array:
    """Values (m, c) of the rows used in the place of all rows, NaN in the others."""
    expanded = np.full((len(used), values.shape[1]), np.nan)
    expanded[used] = values
    return expanded
