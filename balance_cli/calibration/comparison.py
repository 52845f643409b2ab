"""What changed since an earlier calibration: each coefficient with its significance, and its worth in loads."""

from __future__ import annotations

from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class TermChange:
    """One coefficient of a channel in two calibrations, both as reading [`unit`] at the newer calibrated range.

    `sigma` of the difference; `t` and `p_value` are NaN where neither calibration states its errors.
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
        for change in _term_changes(names, terms, (old_value, new_value, sigma), dof)
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
    names: tuple[str, ...], terms: tuple[str, ...], tables: tuple[Array, Array, Array], dof: float
) -> tuple[TermChange, ...]:
    from scipy import stats

    old, new, sigma = tables
    present = (old != 0.0) | (new != 0.0)
    known = sigma > 0
    t = np.where(known, (new - old) / np.where(known, sigma, 1.0), np.nan)
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
