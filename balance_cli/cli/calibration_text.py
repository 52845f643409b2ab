"""Terminal text of `balance calibrate`: matrices of each trim, the calibration model of all trims, and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from balance_cli.calibration.contradicted_block import UNDECIDED
from balance_cli.calibration.load_schedule import components_of_one_series
from balance_cli.calibration.normal_equations import MAX_VARIANCE_INFLATION as MAX_INFLATION
from balance_cli.campaign.rig.load_components import full_scale
from balance_cli.cli.calibration_summary import nonlinear_terms_summary
from balance_cli.cli.load_residual_summary import load_residual_text
from balance_cli.cli.temperature_summary import temperature_text
from balance_cli.io.units import VOLTAGE, short_reading

if TYPE_CHECKING:
    from balance_cli.calibration.all_trims_result import AllTrimsCalibration, CheckLoads, Outlier, SuspectLoadSeries
    from balance_cli.calibration.result import Calibration, TrimCalibration
    from balance_cli.calibration.tare_result import Tares
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.campaign.rig.load_components import FullScale

RANDOM_TERMS_TEXT = (
    "loads by all |F|, F^2, F|F| and F G that the rows show, each shrunk by the variance of its family: more likely "
    "than the significant terms alone"
)
"""What computes the loads where the significant terms do not."""


def calibration_text(calibration: Calibration) -> Iterator[str]:
    """Lines of text that summarize a calibration."""
    for trim in calibration.trims.values():
        yield from _trim_text(trim)
    yield from load_residual_text(calibration)
    if calibration.all_trims:
        yield from _math_model_text(calibration.all_trims, calibration.geometry)
    yield from temperature_text(calibration)


def math_model_warnings(all_trims: AllTrimsCalibration) -> Iterator[str]:
    """Warnings about excluded rows and load series, swapped channels, and an iteration that may not converge."""
    undecided = [note for note in all_trims.screening_notes if note.endswith(UNDECIDED)]
    yield from undecided  # what single rows and series deviate by follows from it
    for _, channels in groupby(all_trims.suspect_series, key=lambda suspect: suspect.load_series):
        yield _suspect_series_text(list(channels))
    yield from (outlier_text(outlier) for outlier in all_trims.outliers)
    for pair in all_trims.swapped_channels:
        yield f"{pair} read each other's loads in all runs: their cables seem to be swapped"
    yield from (note for note in all_trims.screening_notes if note not in undecided)
    yield from _missing_terms(all_trims)
    if not all_trims.loads_model.contraction().is_proved:
        yield "the load iteration is not proved to converge over the calibrated range; reduce refuses this model"


def _missing_terms(all_trims: AllTrimsCalibration) -> Iterator[str]:
    """What was asked for by `--terms` and is not in the model."""
    choice, unsupported = all_trims.term_choice, all_trims.model.unsupported_terms
    if choice is None or choice.is_search:
        return
    reasons: dict[str, list[str]] = {}
    for name, reason in unsupported.items():
        reasons.setdefault(reason, []).append(name)
    for reason, names in reasons.items():
        yield f"--terms: {', '.join(f'`{name}`' for name in names)} not fitted: {reason}"
    yield from _confounded_terms(all_trims)


def _confounded_terms(all_trims: AllTrimsCalibration) -> Iterator[str]:
    """Terms that were asked for, and that the rows hardly tell from each other: a search would not take them."""
    inflation = np.nan_to_num(all_trims.model.variance_inflation)
    names = [
        f"`{name}`" for name, row in zip(all_trims.model.terms, inflation, strict=True) if row.max() > MAX_INFLATION
    ]
    if names:
        yield (
            f"--terms: these loads hardly separate {', '.join(names)} from each other: variance inflation up to "
            f"{inflation.max():.2g}, of which a search takes {MAX_INFLATION:.0f} at the most; leave some out"
        )


def outlier_text(outlier: Outlier) -> str:
    """An excluded row, what its error is, and what seems to be wrong with it."""
    if outlier.exchanged_with is not None:
        first, second = sorted((outlier.row, outlier.exchanged_with))
        what = f"rows {first} and {second} of run {outlier.run} look exchanged: "
    else:
        what = f"{outlier.cause}: " if outlier.cause else ""
    error = short_reading(outlier.error, outlier.unit or VOLTAGE)
    return (
        f"run {outlier.run} row {outlier.row}: {what}{outlier.channel} deviates by {error} from "
        f"the prediction of all other rows ({outlier.over_sigma:.1f} sigma); the row was excluded"
    )


def _suspect_series_text(channels: Sequence[SuspectLoadSeries]) -> str:
    """One sentence on a load series and all the channels that deviate in it."""
    first = channels[0]
    cause = f"{first.cause}: " if first.cause else ""
    gains = ", ".join(_gain_text(suspect) for suspect in channels)
    alternatives = f"; {' or '.join(first.alternatives)} may be wrong instead" if first.alternatives else ""
    return (
        f"{first.load_series}: {cause}{gains} times as much as the other load series predict; "
        f"the load series was excluded{alternatives}"
    )


def _gain_text(suspect: SuspectLoadSeries) -> str:
    resembled = f" (as expected of {suspect.resembled_channel})" if suspect.resembled_channel else ""
    return f"{suspect.channel} changes {suspect.gain:.4f} +- {suspect.gain_sigma:.4f}{resembled}"


def _trim_text(trim: TrimCalibration) -> Iterator[str]:
    if not trim.runs:
        yield f"From a matrix, linear part at zero load: condition {trim.condition:.1f}"
        return
    yield f"Trim {trim.trim}: {trim.rows} rows of {', '.join(trim.runs)}; condition {trim.condition:.1f}"
    if np.isfinite(trim.lack_of_fit):
        yield f"  residual over noise {trim.lack_of_fit:.2f} (1: a straight line describes the readings)"
    else:
        of_dof = f", of {trim.dof} degree{'s' * (trim.dof != 1)} of freedom"
        yield f"  residual over noise not known: the rows do not show it; sigma is that of the residual{of_dof}"
    full_scale_words = "calibrated range" if trim.rated_load is None else "rated load, where one is declared"
    yield f"  component  cal. range  full scale   residual % FS   hysteresis % FS   (full scale: {full_scale_words})"
    for j, name in enumerate(trim.components):
        full, scale = trim.calibrated_range[j], trim.full_scale[j]
        loop, sigma = 100 * trim.hysteresis.loads[j] / scale, 100 * trim.hysteresis.loads_sigma[j] / scale
        width = f"{loop:9.4f} +- {sigma:.4f}" if np.isfinite(sigma) else "not known"
        yield f"  {name:9s} {full:11.5g} {scale:11.5g} {trim.residual_percent_fs[name]:15.4f}   {width}"


def _math_model_text(all_trims: AllTrimsCalibration, geometry: Geometry) -> Iterator[str]:
    model = all_trims.model
    proof = all_trims.loads_model.contraction()
    if all_trims.runs:
        count = len(model.load_series)
        series = f"{count} load series, each with its own zero" if count > 1 else "one load series"
        yield f"All trims, {_rows_text(all_trims)} in {series}"
    for note in all_trims.series_notes or ():
        yield f"  {note}"
    unconfirmed = components_of_one_series(all_trims)
    if unconfirmed:
        yield (
            f"  {', '.join(unconfirmed)}: varied in one load series only; no other series confirms it, and "
            "sigma does not contain an error of its loads (weights, lever arms, directions)"
        )
    for channel, name in enumerate(model.channel_names):
        terms = nonlinear_terms_summary(all_trims, channel)
        yield f"  {name:12s} {', '.join(_term_text(term, values['t']) for term, values in terms.items()) or 'linear'}"
    if all_trims.random_terms is not None:
        yield f"  {RANDOM_TERMS_TEXT}"
    if proof.is_proved and all_trims.loads_model.is_nonlinear:
        yield f"  loads by iteration: every step reduces the error to {100.0 * proof.rho:.2g} % or less"
    if all_trims.non_iterative is not None:
        residuals = zip(model.components, all_trims.non_iterative.residual_percent_fs, strict=True)
        values = ", ".join(f"{name} {value:.4f}" for name, value in residuals)
        yield f"  non-iterative method; residual in % of calibrated range: {values}"
    if all_trims.tares is not None:
        yield from _tares_text(all_trims.tares)
    if model.unsupported_terms:
        count, example = len(model.unsupported_terms), _first_unsupported_term_text(model.unsupported_terms)
        yield f"  {count} terms are not supported by these loads, such as {example}"
    for check in all_trims.checks:
        yield from _check_text(check, model.components, full_scale(geometry, model.components, model.calibrated_range))


def _rows_text(all_trims: AllTrimsCalibration) -> str:
    """How many rows were fitted and, where some were excluded, of how many."""
    fitted, rows = int(np.count_nonzero(all_trims.used)), len(all_trims.loads)
    if fitted == rows:
        return f"{rows} rows"
    named = len(all_trims.outliers)
    others = "" if all_trims.suspect_series or fitted + named == rows else " (check points and repetitions aside)"
    return f"{fitted} of {rows} rows{others}"


def _check_text(check: CheckLoads, components: tuple[str, ...], scale: FullScale) -> Iterator[str]:
    rows = len(check.is_valid)
    outside = rows - int(np.count_nonzero(check.is_valid))
    note = f"; {outside} of {rows} rows outside the calibrated loads are left out" if outside else ""
    yield f"  {check.label}: rms error in % of {scale.meaning}, and share of loads within their 95 % interval{note}"
    if check.zeros is not None:
        yield f"    {check.zeros}"
    for j, component in enumerate(components):
        error, share = 100.0 * check.error[j] / scale.values[j], 100.0 * check.interval_coverage[j]
        known = np.isfinite(error)
        within = f"{share:6.1f} %" if np.isfinite(share) else "interval not known"
        yield f"    {component:4s} {error:9.4f} {within}" if known else f"    {component:4s} not known"


def _tares_text(tares: Tares) -> Iterator[str]:
    yield f"  metric part: weight {tares.weight:.6g} +- {tares.weight_sigma:.2g} N, included in the loads of the model"
    if np.isfinite(tares.center_of_gravity).all():
        axes = zip("xyz", 1e3 * tares.center_of_gravity, 1e3 * tares.center_of_gravity_sigma, strict=True)
        place = ", ".join(f"{axis} {value:.5g} +- {sigma:.2g}" for axis, value, sigma in axes)
        yield f"    its center of gravity from the hub [mm]: {place}"
    tested = f"chi2/dof {tares.chi2_per_dof:.2f}" if np.isfinite(tares.chi2_per_dof) else "not tested by further zeros"
    yield f"    from the zeros of {tares.series_count} load series: {tested}"


def _term_text(term: str, t: float) -> str:
    return f"{term} (t {t:.1f})" if np.isfinite(t) else term


def _first_unsupported_term_text(unsupported: Mapping[str, str]) -> str:
    name, reason = next(iter(unsupported.items()))
    return f"{name}: {reason}"
