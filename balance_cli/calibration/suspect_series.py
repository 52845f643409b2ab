"""Load series in which a channel has a wrong gain.

A load series is compared with predictions from the other ones, never with a fit that includes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import SuspectLoadSeries
from balance_cli.calibration.combined_series import Exclusion, contradicting_series
from balance_cli.calibration.contradiction import LoadSeriesRows, contradicts, decide_by_declared, undecided_error
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, fit_calibration_model, refit_terms
from balance_cli.calibration.gain_scatter import MIN_GAIN_ERROR, gain_scatter, least_gain_errors
from balance_cli.calibration.least_squares import CollinearError, solve_least_squares
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.own_products import explaining_products, one_sided_note, usual_one_sided_terms
from balance_cli.calibration.robust_fit import OUTLIER_SIGNIFICANCE_LEVEL
from balance_cli.calibration.robust_scale import robust_sigma
from balance_cli.calibration.series_causes import series_cause
from balance_cli.calibration.term_choice import LINEAR_TERMS, SEARCHED, TermChoice
from balance_cli.calibration.terms import term_values
from balance_cli.signals import distributions as stats
from balance_cli.signals.distributions import student_widening

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_UNEXPLAINED_SHARE = 0.3
"""Share of a channel's signal, as amplitude, that its own prediction must leave for it to be held against others."""
MIN_PLAUSIBLE_GAIN = 0.5
"""Gain below which a channel is always held against the predictions of the others."""
MAX_SUSPECT_SERIES = 6
"""Suspect load series from which on the screening stops: with more of them the majority is not to be trusted."""
MAX_NOISE_TO_SIGNAL = 0.1
"""Noise over signal up to which the gain of a channel in a load series is tested: above it the gain is uncertain."""
AMBIGUITY_FACTOR = 1.5
"""Another series is named as an alternative where excluding it leaves at most this multiple of the least misfit."""
MAX_SCALED_SQUARE = 100.0
"""Squared error over noise at which errors are clipped (10 sigma), so that a second bad series does not decide."""


@dataclass(frozen=True)
class _SeriesCheck:
    """A load series against the others: its suspect channels, and those whose terms the others do not tell."""

    channels: list[SuspectLoadSeries]
    unpredicted: frozenset[str]


def exclude_suspect_series(
    points: CalibrationPoints, choice: TermChoice
) -> tuple[CalibrationPoints, CalibrationModelFit, tuple[SuspectLoadSeries, ...], tuple[str, ...]]:
    """Exclude load series until the rest agree; returns the remaining points, their fit, the series and notes.

    Raises UserError where two load series contradict each other in sign or size, and nothing tells which is wrong.
    """
    excluded: list[Exclusion] = []
    included, fit, worst = points, *_fit_and_find_worst(points, choice)
    while (
        worst is not None and len({each.load_series for one in excluded for each in one.channels}) < MAX_SUSPECT_SERIES
    ):
        included = included.exclude_rows(worst.rows)
        excluded.append(worst)
        fit, worst = _fit_and_find_worst(included, choice)
    # By the last fit: another wrong series, still fitted, hides what is wrong with one.
    suspect_series = [
        replace(suspect, cause=series_cause(fit.model, points, one.rows))
        for one in excluded
        for suspect in one.channels
    ]
    notes = [one.note for one in excluded if one.note]
    if worst is not None:
        notes.append(f"{MAX_SUSPECT_SERIES} load series were excluded, and more disagree")
    return included, fit, tuple(suspect_series), tuple(notes)


def _fit_and_find_worst(points: CalibrationPoints, choice: TermChoice) -> tuple[CalibrationModelFit, Exclusion | None]:
    """The fit, and the worst series: of loads alone the terms that the balance has are searched for here only."""
    fit = fit_calibration_model(points, choice)
    if not choice.is_linear:
        linear_fit = fit_calibration_model(points, LINEAR_TERMS)
        return fit, _worst_series(points, fit, linear_fit) or contradicting_series(points, fit, linear_fit)
    if not any(check.channels for check in _find_suspect_series(points, fit).values()):
        return fit, None
    return fit, _worst_series(points, fit_calibration_model(points, SEARCHED), fit)


def _worst_series(
    points: CalibrationPoints, fit: CalibrationModelFit, linear_fit: CalibrationModelFit
) -> Exclusion | None:
    """The load series without which the others agree best; None where none is suspected.

    A load series is suspected only if it deviates both from the model of the loads alone and from that with the
    selected terms, because nonlinearity explained by terms is not a fault. Where two series disagree and no third one
    decides, the second is named as an alternative.
    """
    load_series, used = points.load_series, points.weight > 0
    unexplained = _find_suspect_series(points, fit)
    if not unexplained:
        return None
    candidates = {
        name: suspect_channels
        for name, check in _find_suspect_series(points, linear_fit).items()
        if name in unexplained
        and (suspect_channels := _unexplained_channels(points, (load_series == name) & used, check, unexplained[name]))
        # Not known by the others, as a product of its loads, or a side of its load, is only told by itself.
        and (unexplained[name].channels or not _own_terms(points, fit, (load_series == name) & used, suspect_channels))
    }
    if not candidates:
        return None
    words = dict(zip(np.unique(load_series[used]).tolist(), fit.model.load_series, strict=True))
    misfit = {name: _cross_validation_misfit(points, (load_series == name) & used) for name in words}
    worst = min(candidates, key=lambda name: misfit[name])
    # One that predicts no change where there is one has no gain, and is no candidate.
    tied = [worst, *(name for name in misfit if name != worst and misfit[name] < AMBIGUITY_FACTOR * misfit[worst])]
    rivals = [LoadSeriesRows((load_series == name) & used, words[name]) for name in tied]
    if len(rivals) == 1 or not contradicts(points, rivals[0].rows):
        others = tuple(each.words for each in rivals[1:])
        channels = [replace(suspect, alternatives=others) for suspect in candidates[worst]]
        names = [suspect.channel for suspect in channels]
        note = one_sided_note(points, fit, rivals[0].rows, names, rivals[0].words)
        return Exclusion(rivals[0].rows, channels, note)
    wrong = decide_by_declared(points, rivals)
    if wrong is None:
        raise undecided_error(points, rivals)
    both = " and ".join(each.words for each in rivals)
    note = f"{both} contradict each other; the response of the declared geometry refutes {rivals[wrong].words}"
    return Exclusion(rivals[wrong].rows, candidates.get(tied[wrong], candidates[worst]), note)


def _unexplained_channels(
    points: CalibrationPoints, rows: NDArray[np.bool_], linear: _SeriesCheck, selected: _SeriesCheck
) -> list[SuspectLoadSeries]:
    """The suspect channels of the linear fit that the selected terms do not explain.

    Where the other load series do not tell the terms of a channel, what nonlinearity causes is not held against it.
    """
    deviating = {suspect.channel for suspect in selected.channels}
    used = points.load_series[points.weight > 0]
    series = [points.channels[(points.load_series == name) & (points.weight > 0)] for name in np.unique(used)]
    largest_change = np.max([np.ptp(readings, axis=0) for readings in series], axis=0)
    share = np.ptp(points.channels[rows], axis=0) / np.maximum(largest_change, np.finfo(float).tiny)
    held = []
    for suspect in linear.channels:
        is_beyond_terms = abs(suspect.gain - 1.0) * share[points.channel_names.index(suspect.channel)] > MIN_GAIN_ERROR
        if suspect.channel in deviating or (suspect.channel in selected.unpredicted and is_beyond_terms):
            held.append(suspect)
    return held


def _own_terms(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: NDArray[np.bool_], deviating: Sequence[SuspectLoadSeries]
) -> dict[str, float]:
    channels = [suspect.channel for suspect in deviating]
    return explaining_products(points, fit, rows, channels) or usual_one_sided_terms(points, fit, rows, channels)


def _find_suspect_series(points: CalibrationPoints, fit: CalibrationModelFit) -> dict[int, _SeriesCheck]:
    """Suspect and unpredicted channels of the load series that have any."""
    load_series, used = points.load_series, points.weight > 0
    by_series = {}
    for name, description in zip(np.unique(load_series[used]).tolist(), fit.model.load_series, strict=True):
        rows = (load_series == name) & used
        known = np.isfinite(fit.cross_validation_errors[rows]).all(axis=0)
        unpredicted = frozenset(np.array(points.channel_names)[~known].tolist())
        channels = _suspect_channels(points, fit, rows, description, known) if known.any() else []
        if channels or unpredicted:
            by_series[name] = _SeriesCheck(channels, unpredicted)
    if not any(check.channels for check in by_series.values()):
        return by_series
    scatter = gain_scatter(points, fit)
    return {
        name: replace(check, channels=_beyond_scatter(check.channels, scatter[name]))
        for name, check in by_series.items()
    }


def _beyond_scatter(channels: list[SuspectLoadSeries], scatter: float) -> list[SuspectLoadSeries]:
    """Those whose gain differs from one by more than the `scatter` of the gains of the other load series."""
    limit = float(stats.norm.isf(0.5 * OUTLIER_SIGNIFICANCE_LEVEL)) * scatter
    return [suspect for suspect in channels if abs(suspect.gain - 1.0) > limit]


def _cross_validation_misfit(points: CalibrationPoints, rows: NDArray[np.bool_]) -> float:
    """Mean square cross-validation error without these rows (m,), in units of the noise, large errors clipped."""
    others = (points.weight > 0) & ~rows
    load_series, weight = points.load_series[others], points.weight[others]
    try:
        linear = solve_least_squares(points.x[others], points.channels[others], load_series, weight)
    except CollinearError:  # no other series tells one of its loads
        return np.inf
    errors = linear.cross_validation_errors(load_series)
    scaled = (errors / robust_sigma(errors)) ** 2
    return float(np.mean(np.minimum(scaled[np.isfinite(scaled)], MAX_SCALED_SQUARE)))


def _suspect_channels(
    points: CalibrationPoints,
    fit: CalibrationModelFit,
    rows: NDArray[np.bool_],
    description: str,
    known: NDArray[np.bool_],
) -> list[SuspectLoadSeries]:
    """Suspect channels in the rows of one load series, among the `known` (c,), which the others predict."""
    change = points.channels[rows] - points.channels[rows].mean(axis=0)
    errors = np.where(known, fit.cross_validation_errors[rows], change)  # a prediction of no change has no gain
    predicted = change - (errors - errors.mean(axis=0))
    least, names = least_gain_errors(points, fit, rows, predicted), points.channel_names
    # The misfit of a linear model follows the load: it does not average out over the rows.
    power = np.maximum(np.mean(predicted**2, axis=0), np.finfo(float).tiny)
    misfit = np.sqrt(np.mean((change - np.mean(predicted * change, axis=0) / power * predicted) ** 2, axis=0))
    noise = robust_sigma(np.where(known, fit.cross_validation_errors, 0.0))

    def check(sigma: Array) -> list[SuspectLoadSeries]:
        found = (_check_channel_gain(c, change, predicted, sigma, least, names, description) for c in range(len(names)))
        return [suspect for suspect in found if suspect is not None]

    # Sigma is no less than this whatever the others tell, so that few series need the fit of the others.
    if not check(np.minimum(noise, misfit) / np.sqrt(power)):
        return []
    others = _fit_of_others(points, fit, rows, known)
    sigma = _noise(noise, misfit, others, known) / np.sqrt(power)
    return check(np.hypot(sigma, _prediction_gain_sigma(others.model, points.loads[rows], predicted)))


def _fit_of_others(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: NDArray[np.bool_], known: NDArray[np.bool_]
) -> CalibrationModelFit:
    """The terms of a fit without some rows (m,); of channels that are not `known` (c,) the loads alone."""
    is_determined = known | (np.arange(len(fit.model.t)) < len(points.components))[:, None]
    return refit_terms(points.exclude_rows(rows), replace(fit.model, t=np.where(is_determined, fit.model.t, np.nan)))


def _noise(noise: Array, misfit: Array, others: CalibrationModelFit, known: NDArray[np.bool_]) -> Array:
    """Standard deviation (c,) of predictions: `noise` of all load series, or of the `others` without the judged one.

    A wrong series spoils the prediction of each one that shares its loads, which may be most. Where the others predict
    half of their rows without it, their errors are the noise, with the `misfit` (c,) that no gain explains, as long as
    they are smaller.
    """
    errors = others.cross_validation_errors
    is_told = np.count_nonzero(np.isfinite(errors), axis=0) >= 0.5 * np.count_nonzero(np.isfinite(others.residuals), 0)
    own = np.hypot(robust_sigma(np.where(is_told & known, errors, 0.0)), misfit)
    return np.where(is_told & known, np.minimum(noise, own), noise)


def _prediction_gain_sigma(model: CalibrationModel, loads: Array, predicted: Array) -> Array:
    """Standard deviation (c,) of the gains in rows of some loads (r, k) due to the errors of their prediction (r, c).

    The other load series, of which the model is, may have loaded a component with a small fraction of its load in these
    rows. The errors of their coefficients b are then those of the prediction: gain = p'y / p'p has the derivative
    p'X / p'p with respect to b.
    """
    X = term_values(model.parsed_terms, loads / model.calibrated_range)
    derivative = predicted.T @ X / np.maximum(np.sum(predicted**2, axis=0), np.finfo(float).tiny)[:, None]
    variance = np.einsum("cp,cpq,cq->c", derivative, model.covariance, derivative)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0) * student_widening(model.dof)))


def _check_channel_gain(
    c: int,
    change: Array,
    predicted: Array,
    gain_sigma: Array,
    least: Array,
    channels: Sequence[str],
    description: str,
) -> SuspectLoadSeries | None:
    """Compare the change of channel c in some rows (r, channels) with its prediction; None where they agree.

    They do within chance and within the `least` gain error (channels,).
    """
    power = float(np.sum(predicted[:, c] ** 2))
    if power == 0.0:
        return None
    gain = float(predicted[:, c] @ change[:, c] / power)
    sigma = float(gain_sigma[c])
    is_significant = abs(gain - 1.0) > max(
        float(stats.norm.isf(0.5 * OUTLIER_SIGNIFICANCE_LEVEL / len(channels))) * sigma, float(least[c])
    )
    # A channel with hardly any signal in this load series does not determine its gain.
    if not is_significant or sigma > MAX_NOISE_TO_SIGNAL:
        return None
    residual = change[:, c] - gain * predicted[:, c]
    resembled = ""
    if np.sum(residual**2) > MIN_UNEXPLAINED_SHARE**2 * np.sum(change[:, c] ** 2) or gain < MIN_PLAUSIBLE_GAIN:
        shares = [_unexplained_share(change[:, c], predicted[:, i]) for i in range(len(channels))]
        best = int(np.argmin(shares))
        resembled = channels[best] if best != c and shares[best] < MIN_UNEXPLAINED_SHARE**2 else ""
    return SuspectLoadSeries(description, channels[c], gain, sigma, resembled)


def _unexplained_share(change: Array, predicted: Array) -> float:
    """Share of the power of a change that a prediction, not rescaled, leaves unexplained."""
    return float(np.sum((change - predicted) ** 2) / max(float(np.sum(change**2)), np.finfo(float).tiny))
