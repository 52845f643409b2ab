"""What changed since an earlier calibration: each coefficient with its significance, and its worth in loads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.terms import term_from_name, term_values
from balance_cli.io.errors import UserError
from balance_cli.io.units import VOLTAGE

Array = NDArray[np.float64]

SIGNIFICANCE_LEVEL = 0.01
"""Probability that any coefficient of an unchanged balance is called changed (Bonferroni over all of them)."""


SHARES_OF_RANGE = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Steps of a load series, in units of the calibrated range, at which responses by different terms are compared."""


@dataclass(frozen=True)
class TermChange:
    """One coefficient of a channel in two calibrations, both as reading [`unit`] at the newer calibrated range.

    `sigma` of the difference; `t` and `p_value` are NaN where neither calibration states its errors. Where one of them
    has the term and the other has not, `t` is that of the response by all terms of the same loads.
    """

    channel: str
    term: str
    old: float
    new: float
    sigma: float
    t: float
    p_value: float
    is_significant: bool
    unit: str = VOLTAGE


@dataclass(frozen=True)
class CalibrationComparison:
    """All coefficients of both calibrations, by falling |t|.

    `load_change` {component: largest error of this load, percent of full scale, where any one load is at its calibrated
    range and the older calibration is used}; `channels_left_out`: in one of the two calibrations only.
    """

    changes: tuple[TermChange, ...]
    load_change: dict[str, float]
    channels_left_out: tuple[str, ...]

    @property
    def significant(self) -> tuple[TermChange, ...]:
        """The coefficients that changed significantly."""
        return tuple(change for change in self.changes if change.is_significant)


def compare_calibrations(new: Calibration, old: Calibration) -> CalibrationComparison:
    """Compare the calibration models of two calibrations of one balance.

    Raises UserError where one has no model of all trims, or they have other components or no channel in common.
    """
    a, b = calibration_model(new), model_at_temperature(old, new)
    require_same_balance(a, b)
    names = tuple(name for name in a.channel_names if name in b.channel_names)
    terms = tuple(dict.fromkeys((*a.terms, *b.terms)))
    tables = [coefficients_at_range(model, terms, names, a.calibrated_range) for model in (a, b)]
    (new_value, new_variance), (old_value, old_variance) = tables
    sigma = np.sqrt(new_variance + old_variance)
    dof = float(min(np.min(a.dof), np.min(b.dof)))
    units = {channel.name: channel.reading_unit for channel in new.geometry.channels}
    changes = tuple(
        replace(change, unit=units[change.channel])
        for change in _term_changes(names, terms, (old_value, new_value, sigma), dof, _selection_t(a, b, names, terms))
    )
    difference = (new_value - old_value)[: len(a.components)].T
    at = [b.channel_names.index(name) for name in names]
    return CalibrationComparison(
        changes=changes,
        load_change=_load_change(new, b, difference, np.array(at, np.intp)),
        channels_left_out=tuple(name for name in (*a.channel_names, *b.channel_names) if name not in names),
    )


def require_same_balance(new: CalibrationModel, old: CalibrationModel) -> None:
    """Raise UserError where an older model has other components, or no channel of the newer one."""
    if new.components != old.components:
        fault = f"has the components {', '.join(old.components)}, not {', '.join(new.components)}"
        raise UserError(fault, "--against", remedy="Give a calibration of the same balance")
    if not set(new.channel_names) & set(old.channel_names):
        raise UserError("has none of the channels", "--against", remedy="Give a calibration of the same balance")


def calibration_model(calibration: Calibration) -> CalibrationModel:
    """The model of all trims of a calibration; raises UserError where it has none."""
    if calibration.all_trims is None:
        fault = f"the calibration of {calibration.geometry.name} has no calibration model of all trims"
        raise UserError(fault, "--against", remedy="Give calibrations whose channels determine the loads in all trims")
    return calibration.all_trims.model


def model_at_temperature(calibration: Calibration, other: Calibration) -> CalibrationModel:
    """The model of a calibration, its sensitivities referred to the reference temperature of another one.

    As it is where one of the two states no temperature.
    """
    model = calibration_model(calibration)
    terms, target = calibration.temperature, other.temperature
    if terms is None or target is None or terms.components != model.components:
        return model
    k, difference = len(model.components), target.reference - terms.reference
    away = terms.under_load - terms.reference
    # The error of referring them to their own reference is in their covariance, and counts once.
    further = np.sqrt(np.maximum((difference - away) ** 2 - away**2, 0.0)) * model.calibrated_range
    coefficients, covariance = model.coefficients.copy(), model.covariance.copy()
    for at, name in enumerate(model.channel_names):
        if name in terms.channel_names:
            c = terms.channel_names.index(name)
            coefficients[:k, at] += difference * terms.coefficients[1:, c] * model.calibrated_range
            covariance[at, :k, :k] += terms.covariance[c, 1:, 1:] * further[:, None] * further
    return replace(model, coefficients=coefficients, covariance=covariance)


def coefficients_at_range(
    model: CalibrationModel, terms: tuple[str, ...], names: tuple[str, ...], calibrated_range: Array
) -> tuple[Array, Array]:
    """Contributions (p, c) [V] of all terms at a calibrated range, and their variances; zero where a term is absent."""
    parsed = tuple(term_from_name(name, model.components) for name in terms)
    ratio = term_values(parsed, (calibrated_range / model.calibrated_range)[None])[0]
    value, variance = np.zeros((len(terms), len(names))), np.zeros((len(terms), len(names)))
    for i, term in enumerate(terms):
        if term in model.terms:
            row = model.terms.index(term)
            for c, name in enumerate(names):
                at = model.channel_names.index(name)
                value[i, c] = model.coefficients[row, at] * ratio[i]
                variance[i, c] = model.covariance[at, row, row] * ratio[i] ** 2
    return value, variance


def _term_changes(
    names: tuple[str, ...],
    terms: tuple[str, ...],
    tables: tuple[Array, Array, Array],
    dof: float,
    selection_t: dict[tuple[str, str], float],
) -> tuple[TermChange, ...]:
    from scipy import stats

    old, new, sigma = tables
    present = (old != 0.0) | (new != 0.0)
    known = sigma > 0
    t = np.where(known, (new - old) / np.where(known, sigma, 1.0), np.nan)
    for (channel, term), response_t in selection_t.items():
        t[terms.index(term), names.index(channel)] = response_t
    p_value = np.where(known, 2.0 * stats.t.sf(np.abs(np.nan_to_num(t)), dof), np.nan)
    limit = SIGNIFICANCE_LEVEL / max(int(np.count_nonzero(present)), 1)
    changes = [
        TermChange(
            channel=names[c],
            term=terms[i],
            old=float(old[i, c]),
            new=float(new[i, c]),
            sigma=float(sigma[i, c]),
            t=float(t[i, c]),
            p_value=float(p_value[i, c]),
            is_significant=bool(p_value[i, c] < limit),
        )
        for i, c in zip(*np.nonzero(present), strict=True)
    ]
    return tuple(sorted(changes, key=lambda change: -abs(np.nan_to_num(change.t))))


def _selection_t(
    new: CalibrationModel, old: CalibrationModel, names: tuple[str, ...], terms: tuple[str, ...]
) -> dict[tuple[str, str], float]:
    """T of the coefficients {(channel, term)} that only one of two models has: of the response by terms of its loads.

    Which of several similar terms (`Fx^2`, `|Fx|`) a search selects, and whether it selects a weak one, is certain only
    as far as their responses differ by more than the noise of a reading, which the standard deviation contains.
    """
    t_values = {}
    for channel in names:
        for name in terms:
            selected = [name in model.channel_coefficients(channel) for model in (new, old)]
            if selected[0] == selected[1]:
                continue
            series = _series_of_term(new, name)
            values, variances = zip(*(_response(model, channel, name, series) for model in (new, old)), strict=True)
            noise = [
                model.residual_covariance[c, c] for model in (new, old) for c in [model.channel_names.index(channel)]
            ]
            variance = np.sum(variances, axis=0) + np.sum(noise)
            ratio = (values[0] - values[1]) / np.sqrt(np.maximum(variance, np.finfo(float).tiny))
            t_values[channel, name] = float(ratio[np.argmax(np.abs(ratio))]) if np.any(variances) else float("nan")
    return t_values


def _series_of_term(model: CalibrationModel, name: str) -> Array:
    """Load series (s, q, k) that show a term: its first load in steps in either direction, the second one beside it."""
    term, unit = term_from_name(name, model.components), np.eye(len(model.components)) * model.calibrated_range
    return np.array(
        [
            [sum(sign * (share if i == term.i else 1.0) * unit[i] for sign, i in signed) for share in SHARES_OF_RANGE]
            for signs in product((1.0, -1.0), repeat=len(term.loads))
            for signed in [tuple(zip(signs, term.loads, strict=True))]
        ]
    )


def _response(model: CalibrationModel, channel: str, name: str, series: Array) -> tuple[Array, Array]:
    """Response (n,) of a channel to load series (s, q, k) by its nonlinear terms of the loads of a term; its variance.

    The mean of each series, which its zero contains, is subtracted.
    """
    term, c = term_from_name(name, model.components), model.channel_names.index(channel)
    rows = [
        row for row, each in enumerate(model.parsed_terms) if not each.linear and set(each.loads) == set(term.loads)
    ]
    loads = series.reshape(-1, series.shape[-1]) / model.calibrated_range
    values = term_values(model.parsed_terms, loads)[:, rows].reshape(*series.shape[:2], len(rows))
    values = (values - values.mean(axis=1, keepdims=True)).reshape(-1, len(rows))
    covariance = model.covariance[c][np.ix_(rows, rows)]
    return values @ model.coefficients[rows, c], np.einsum("qp,pr,qr->q", values, covariance, values)


def _load_change(
    new: Calibration, old: CalibrationModel, difference: Array, rows: NDArray[np.intp]
) -> dict[str, float]:
    """Largest error {component: percent of full scale} of the older matrix, one load at a time at its range.

    `difference` (c, k) [V]: readings at the newer calibrated range less those by the older calibration.
    """
    if len(rows) < len(old.components):
        return {}
    change = old.inverse(rows) @ difference * old.calibrated_range[:, None]
    full = next(iter(new.trims.values())).full_scale
    largest = change[np.arange(len(full)), np.argmax(np.abs(change), axis=1)]
    return dict(zip(old.components, (100.0 * largest / full).tolist(), strict=True))
