"""The calibration model on the page: overview, warnings, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from matplotlib.figure import Figure

from balance_cli.calibration.all_trims_result import AllTrimsCalibration, Outlier, SuspectLoadSeries
from balance_cli.calibration.convergence import Contraction
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.tare_result import Tares
from balance_cli.calibration.term_choice import LISTED, QUADRATIC, TERM_SIGNIFICANCE_LEVEL
from balance_cli.campaign.rig.load_components import component_units, full_scale
from balance_cli.io.units import short_reading
from balance_cli.report.blocks import Details, Heading, PageBlock, Paragraph, Picture, WarningText
from balance_cli.report.diagnosis_tables import PLUS_MINUS
from balance_cli.report.figure_style import svg
from balance_cli.report.load_series_rows import channel_ranges, split_load_series
from balance_cli.report.math_model_figures import load_figure, order_figure
from balance_cli.report.math_model_tables import (
    channel_table,
    check_table,
    nonlinear_terms,
    tare_table,
    term_table,
    unsupported_terms_table,
)
from balance_cli.report.number_format import format_significant, join_names, value_and_sigma_text
from balance_cli.report.reading_scale import MICROVOLTS, reading_scale
from balance_cli.report.sources import Source

NO_MODEL_TEXT = (
    "There is no calibration model of all trims: the channels that the trims have in common do not determine the "
    "loads, or loads were applied that the balance does not carry."
)
MATRIX_ONLY_TEXT = (
    "Calibration model of all channels, read from a matrix: load points and errors of its coefficients are not known."
)
LINEAR_TERMS_TEXT = "All channels have linear terms only; no others were searched for."
FIXED_TERMS_TEXT = {
    QUADRATIC: "All channels have all squares and products of the loads that the schedule supports; no others were "
    "searched for.",
    LISTED: "The channels have the terms that were listed, as far as the schedule supports them; no others were "
    "searched for.",
}

RANDOM_TERMS_TEXT = (
    "Loads are computed by a model with random terms: all |F|, F^2, F|F| and F G that the rows determine, each with a "
    "coefficient that is shrunk by the variance of its family, because it is more likely than the significant terms "
    "alone. Its terms are not tested one by one; the tables show the significant terms."
)


def math_model_blocks(source: Source[Calibration], named: bool, suffix: str) -> Iterator[PageBlock]:
    """The part of the page on one calibration model; `suffix` makes the names of its pictures unique."""
    all_trims = source.content.all_trims
    yield Heading(f"{source.file}: calibration model of all trims" if named else "Calibration model of all trims")
    if all_trims is None:
        yield Paragraph(NO_MODEL_TEXT)
        return
    has_rows = len(all_trims.loads) > 0
    with_search = source.artefact.provenance.options.get("terms") != "linear"
    yield Paragraph(_overview_text(all_trims, with_search) if has_rows else MATRIX_ONLY_TEXT)
    if all_trims.random_terms is not None:
        yield Paragraph(RANDOM_TERMS_TEXT)
    proof = all_trims.loads_model.contraction()
    yield from _math_model_warnings(all_trims, proof)
    if proof.is_proved:
        yield Paragraph(_iteration_text(all_trims, proof, component_units(source.content.geometry)))
    if all_trims.non_iterative is not None:
        yield Paragraph(_non_iterative_text(all_trims.non_iterative))
    yield from _math_model_tables(source.content, all_trims, has_rows)
    if has_rows:
        yield from _residual_pictures(source.content, all_trims, suffix)
    if all_trims.model.unsupported_terms:
        summary = f"{len(all_trims.model.unsupported_terms)} terms that these loads do not support"
        yield Details(summary, (unsupported_terms_table(all_trims),))


def _math_model_tables(calibration: Calibration, all_trims: AllTrimsCalibration, has_rows: bool) -> Iterator[PageBlock]:
    scale = reading_scale(calibration.geometry, all_trims.model.channel_names)
    if has_rows:
        yield channel_table(all_trims, channel_ranges(calibration, all_trims), scale)
    if all_trims.model.is_nonlinear:
        yield term_table(all_trims, scale)
    if all_trims.tares is not None:
        yield Paragraph(_metric_weight_text(all_trims.tares))
        yield tare_table(all_trims.model.channel_names, all_trims.tares, scale)
    if all_trims.checks:
        model = all_trims.model
        yield check_table(all_trims, full_scale(calibration.geometry, model.components, model.calibrated_range))


# ---- text ------------------------------------------------------------------------------------------------------------


def _overview_text(all_trims: AllTrimsCalibration, with_search: bool) -> str:
    rows, used = len(all_trims.loads), int(np.count_nonzero(np.isfinite(all_trims.residuals).any(axis=1)))
    row_text = f"{rows} rows" if used == rows else f"{used} of {rows} rows"
    count = len(all_trims.model.load_series)
    series = f"{count} load series, each with its own zero" if count > 1 else "one load series"
    selection = _selection_text(all_trims) if with_search else LINEAR_TERMS_TEXT
    return f"All channels, all trims: {row_text} of {join_names(all_trims.runs)} in {series}. {selection}"


def _selection_text(all_trims: AllTrimsCalibration) -> str:
    names, choice = all_trims.model.channel_names, all_trims.term_choice
    level = TERM_SIGNIFICANCE_LEVEL if choice is None else choice.significance
    if choice is not None and choice.kind in FIXED_TERMS_TEXT:
        return FIXED_TERMS_TEXT[choice.kind]
    nonlinear = [name for c, name in enumerate(names) if nonlinear_terms(all_trims, c)]
    verb = "have" if len(nonlinear) > 1 else "has"
    result = f"{join_names(nonlinear)} {verb} such terms" if nonlinear else "no channel has such terms"
    return (
        "Beside the linear terms a channel has those nonlinear terms that are significant (probability of any spurious "
        f"term in the balance {level:g}) and that reduce the cross-validation error of the load "
        f"series: {result}."
    )


def _iteration_text(all_trims: AllTrimsCalibration, proof: Contraction, units: Mapping[str, str]) -> str:
    """The calibrated range, and the loads beyond which a result is refused."""
    model = all_trims.loads_model
    limits = zip(model.components, model.smallest_load, model.largest_load, strict=True)
    calibrated = ", ".join(
        f"{name} {format_significant(float(low))} to {format_significant(float(high))} {units[name]}"
        for name, low, high in limits
    )
    reach = zip(model.components, proof.reach * model.calibrated_range, strict=True)
    refused = ", ".join(f"{name} {PLUS_MINUS}{format_significant(float(size))} {units[name]}" for name, size in reach)
    left = format_significant(100.0 * proof.rho, 2)
    iteration = f"Loads are computed by iteration; every step reduces the error to {left} % or less. "
    return (
        f"{iteration if model.is_nonlinear else ''}Calibrated: {calibrated}. Loads beyond are flagged as extrapolated, "
        f"and beyond {refused} they are refused."
    )


def _non_iterative_text(non_iterative: NonIterativeModel) -> str:
    pairs = zip(non_iterative.model.components, non_iterative.residual_percent_fs, strict=True)
    residuals = ", ".join(f"{name} {format_significant(float(value), 2)}" for name, value in pairs)
    return (
        "Non-iterative method: mean loads are computed as functions of the readings; residual in % of the calibrated "
        f"range: {residuals}."
    )


def _metric_weight_text(tares: Tares) -> str:
    weight = f" {PLUS_MINUS} ".join(value_and_sigma_text(tares.weight, tares.weight_sigma))
    place = ""
    if np.isfinite(tares.center_of_gravity).all():
        axes = zip("xyz", tares.center_of_gravity, tares.center_of_gravity_sigma, strict=True)
        values = (
            f"{axis} {f' {PLUS_MINUS} '.join(value_and_sigma_text(1e3 * at, 1e3 * sigma))}" for axis, at, sigma in axes
        )
        place = f", center of gravity from the hub {', '.join(values)} mm"
    chi2 = format_significant(tares.chi2_per_dof, 2)
    return (
        f"Metric part, from the zeros of {tares.series_count} load series in their attitudes: weight {weight} N{place} "
        f"(chi-square per degree of freedom {chi2}). The loads of the model include this weight."
    )


# ---- warnings --------------------------------------------------------------------------------------------------------


def _math_model_warnings(all_trims: AllTrimsCalibration, proof: Contraction) -> Iterator[PageBlock]:
    for suspect in all_trims.suspect_series:
        yield WarningText(_suspect_series_warning(suspect))
    for outlier in all_trims.outliers:
        yield WarningText(_outlier_warning(outlier))
    for note in all_trims.screening_notes:
        yield WarningText(f"{note}.")
    for pair in all_trims.swapped_channels:
        yield WarningText(f"{pair} read each other's loads in all runs: their cables seem to be swapped.")
    if not proof.is_proved:
        yield WarningText(
            "The load iteration is not proved to converge over the calibrated range: no loads are computed with this "
            "model."
        )


def _suspect_series_warning(suspect: SuspectLoadSeries) -> str:
    gain = f" {PLUS_MINUS} ".join(value_and_sigma_text(suspect.gain, suspect.gain_sigma))
    cause = f"{suspect.cause}; " if suspect.cause else ""
    resembled = f", as expected of {suspect.resembled_channel}" if suspect.resembled_channel else ""
    alternatives = f" {' or '.join(suspect.alternatives)} may be wrong instead." if suspect.alternatives else ""
    return (
        f"{suspect.load_series}: {cause}{suspect.channel} changes {gain} times as much as the other load series "
        f"predict{resembled}. The load series was excluded.{alternatives}"
    )


def _reading_text(value: float, unit: str | None) -> str:
    """A reading in microvolt, or in the unit in which it is short where it is not a voltage."""
    return f"{format_significant(1e6 * value)} {MICROVOLTS.symbol}" if unit is None else short_reading(value, unit)


def _outlier_warning(outlier: Outlier) -> str:
    size, direction = _reading_text(abs(outlier.error), outlier.unit), "above" if outlier.error > 0 else "below"
    cause = f" {outlier.cause}." if outlier.cause else ""
    if outlier.exchanged_with is not None:
        first, second = sorted((outlier.row, outlier.exchanged_with))
        cause = f" Rows {first} and {second} look exchanged."
    return (
        f"{outlier.run} row {outlier.row}: {outlier.channel} is {size} {direction} the prediction of all "
        f"other rows ({format_significant(abs(outlier.over_sigma))} standard deviations).{cause} The row was excluded."
    )


# ---- pictures --------------------------------------------------------------------------------------------------------


def _residual_pictures(calibration: Calibration, all_trims: AllTrimsCalibration, suffix: str) -> Iterator[PageBlock]:
    series, ranges = split_load_series(all_trims), channel_ranges(calibration, all_trims)
    scale = reading_scale(calibration.geometry, all_trims.model.channel_names)
    excluded = " Hatched: excluded." if not all(rows.used for rows in series) else ""
    outliers = " Triangles: excluded rows." if all_trims.outliers else ""
    yield _picture(
        f"calibration-order{suffix}",
        "Residual of each channel in the order of loading; the bands are the load series, named by the loads that were "
        f"varied. Dashed: two standard deviations.{excluded}{outliers}",
        lambda: order_figure(all_trims, series, ranges, scale),
    )
    yield _picture(
        f"calibration-load{suffix}",
        "Residual of each channel against the applied load in % of its calibrated range, every row at each load that "
        f"was varied in its load series. A cubic is drawn where a residual depends significantly on a load.{outliers}",
        lambda: load_figure(all_trims, series, ranges, scale),
    )


def _picture(name: str, caption: str, draw: Callable[[], Figure]) -> Picture:
    return Picture(name, caption, svg(name, caption.split(".", maxsplit=1)[0], draw))
