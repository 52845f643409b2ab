"""The gage model of a calibration: terms that the loads support, those that each channel has, and what it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import LeastSquares, regression
from balance_cli.calibration.load_series import describe_load_series, find_load_series
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.selection import select_terms
from balance_cli.calibration.term_support import find_supported_terms
from balance_cli.calibration.terms import Term, all_terms, columns, linear_terms
from balance_cli.campaign.rig.attitude import attitude_segments

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class CalibrationPoints:
    """Rows of all runs in the order of loading: channels (m, c) [V] and loads (m, k) [N, N m], which `full_range` (k,)

    makes numbers near one; `run` (m,) counts `run_names`; `weight` (m,) by the noise of the run; `gravity` (m, 3) unit
    vectors in rig axes, NaN for runs that do not state their attitude, None where no run does.
    """

    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    run_names: tuple[str, ...]
    channels: Array
    loads: Array
    run: Index
    weight: Array
    full_range: Array
    gravity: Array | None = None

    @property
    def x(self) -> Array:
        """Loads (m, k) over full range."""
        return self.loads / self.full_range

    @cached_property
    def sequence(self) -> Index:
        """The loading sequence (m,) of each row."""
        return find_load_series(self.x, self.stretch)

    @cached_property
    def stretch(self) -> Index:
        """The stretch (m,) of rows of one run in one attitude."""
        return attitude_segments(self.run, self.gravity)

    def exclude_rows(self, rows: NDArray[np.bool_]) -> CalibrationPoints:
        """With the weight of some rows taken away: they keep their place in the order, and say nothing."""
        return replace(self, weight=np.where(rows, 0.0, self.weight))


@dataclass(frozen=True)
class CalibrationModelFit:
    """The model, and of all rows the residuals (m, c), errors of rows and of sequences that took no part (m, c) [V].

    NaN where a row has no weight, and where the other sequences do not determine a term. `zero_covariance` (c, s, s):
    that of each channel's zeros, which share the errors of the coefficients.
    """

    model: CalibrationModel
    residuals: Array
    press: Array
    left_out: Array
    zero_covariance: Array


def fit_calibration_model(
    points: CalibrationPoints, search: bool = True, schedule: Array | None = None
) -> CalibrationModelFit:
    """Fit the terms that `search` finds, or the loads alone.

    `schedule` (m, k) are the loads over full range that were applied, where `points` hold others: they say which terms
    are supported. Raises least_squares.CollinearError where the loads were never applied by themselves.
    """
    used = points.weight > 0
    x, sequence = points.x[used], points.sequence[used]
    k = len(points.components)
    terms, refused = linear_terms(k), {}
    if search:
        support = find_supported_terms(
            all_terms(k), x if schedule is None else schedule[used], sequence, points.components
        )
        terms, refused = support.terms, support.refused
    X, Y, w = columns(terms, x), points.channels[used], points.weight[used]
    regression(X[:, :k], Y, sequence, w)
    channel_terms = [tuple(range(k))] * Y.shape[1]
    if search and len(X) > k + len(np.unique(sequence)) + 1:
        channel_terms = select_terms(X, Y, sequence, sequence, k, w)
    return _fit_terms(points, terms, refused, channel_terms)


def refit_terms(points: CalibrationPoints, model: CalibrationModel) -> CalibrationModelFit:
    """The terms that a model has, fitted to other points."""
    channel_terms = [tuple(np.flatnonzero(np.isfinite(column)).tolist()) for column in model.t.T]
    return _fit_terms(points, model.parsed_terms, {}, channel_terms)


def _fit_terms(
    points: CalibrationPoints, terms: Sequence[Term], refused: dict[Term, str], channel_terms: Sequence[tuple[int, ...]]
) -> CalibrationModelFit:
    """Every channel fitted with its chosen ones of these terms."""
    used = points.weight > 0
    X, sequence, w = columns(terms, points.x[used]), points.sequence[used], points.weight[used]
    fits = [
        regression(X[:, list(one)], points.channels[used][:, [c]], sequence, w) for c, one in enumerate(channel_terms)
    ]
    return _assemble_fit(points, used, sequence, terms, refused, channel_terms, fits, X)


def _assemble_fit(
    points: CalibrationPoints,
    used: NDArray[np.bool_],
    sequence: Index,
    terms: Sequence[Term],
    refused: dict[Term, str],
    channel_terms: Sequence[tuple[int, ...]],
    fits: Sequence[LeastSquares],
    X: Array,
) -> CalibrationModelFit:
    names = points.components
    kept = sorted(set().union(*channel_terms))
    place = {term: i for i, term in enumerate(kept)}
    p, c = len(kept), len(fits)
    table = {name: np.full((p, c), np.nan) for name in ("t", "p_value", "variance_inflation")}
    coefficients, covariance = np.zeros((p, c)), np.zeros((c, p, p))
    for channel, (one, fit) in enumerate(zip(channel_terms, fits, strict=True)):
        at = [place[term] for term in one]
        coefficients[at, channel] = fit.coefficients[:, 0]
        covariance[channel][np.ix_(at, at)] = fit.inverse * fit.variance[0]
        for name, values in (("t", fit.t), ("p_value", fit.p_value)):
            table[name][at, channel] = values[:, 0]
        table["variance_inflation"][at, channel] = fit.variance_inflation
    errors = {
        "residuals": np.column_stack([fit.residuals[:, 0] for fit in fits]),
        "press": np.column_stack([fit.press_residuals[:, 0] for fit in fits]),
        "left_out": np.column_stack([fit.left_out(sequence)[:, 0] for fit in fits]),
    }
    w, dof = points.weight[used], np.array([fit.dof for fit in fits], float)
    residual_covariance = (errors["residuals"].T * w) @ errors["residuals"] / np.sqrt(dof[:, None] * dof)
    zeros, zero_covariance = _series_zeros(channel_terms, fits, X, sequence, w)
    model = CalibrationModel(
        channel_names=points.channel_names,
        components=names,
        full_range=points.full_range,
        terms=tuple(terms[i].name(names) for i in kept),
        coefficients=coefficients,
        covariance=covariance,
        **table,
        residual_covariance=residual_covariance,
        dof=dof,
        press=_weighted_rms(errors["press"], w),
        left_out=_weighted_rms(errors["left_out"], w),
        sequences=_series_descriptions(points),
        zeros=zeros,
        zero_sigma=np.sqrt(np.diagonal(zero_covariance, axis1=1, axis2=2)).T,
        largest=points.loads[used].max(axis=0),
        smallest=points.loads[used].min(axis=0),
        refused={term.name(names): reason for term, reason in refused.items()},
    )
    everywhere = {name: _expand_to_all_rows(values, used) for name, values in errors.items()}
    return CalibrationModelFit(model, **everywhere, zero_covariance=zero_covariance)


def _series_zeros(
    channel_terms: Sequence[tuple[int, ...]], fits: Sequence[LeastSquares], X: Array, sequence: Index, weight: Array
) -> tuple[Array, Array]:
    """Zeros (s, c) of the sequences, and the covariance (c, s, s) of each channel's.

    With M (s, p) the means of the terms: s^2 (diag(1/n) + M (R'R)^-1 M').
    """
    names = np.unique(sequence)
    M = np.array([np.average(X[sequence == name], axis=0, weights=weight[sequence == name]) for name in names])
    share = np.diag([1.0 / weight[sequence == name].sum() for name in names])
    zeros = np.column_stack([fit.zeros[:, 0] for fit in fits])
    covariance = [
        fit.variance[0] * (share + M[:, list(one)] @ fit.inverse @ M[:, list(one)].T)
        for one, fit in zip(channel_terms, fits, strict=True)
    ]
    return zeros, np.stack(covariance)


def _series_descriptions(points: CalibrationPoints) -> tuple[str, ...]:
    """The sequences in words, those without any weight left out."""
    sequence, found = points.sequence, []
    for name in np.unique(sequence[points.weight > 0]):
        rows = np.flatnonzero(sequence == name)
        run = int(points.run[rows[0]])
        first = int(np.flatnonzero(points.run == run)[0])
        run_loads = points.x[points.run == run]
        found.append(describe_load_series(rows - first, points.run_names[run], points.components, run_loads))
    return tuple(found)


def _weighted_rms(errors: Array, weight: Array) -> Array:
    """Weighted rms (c,) over the rows that have an error."""
    known = np.isfinite(errors)
    total = np.sum(np.where(known, weight[:, None], 0.0), axis=0)
    squares = np.sum(np.where(known, errors, 0.0) ** 2 * weight[:, None], axis=0)
    return np.asarray(np.sqrt(squares / np.where(total > 0, total, np.nan)))


def _expand_to_all_rows(values: Array, used: NDArray[np.bool_]) -> Array:
    found = np.full((len(used), values.shape[1]), np.nan)
    found[used] = values
    return found
