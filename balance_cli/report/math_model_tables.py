"""Tables of the calibration model: channels, nonlinear terms, natural zeros, check loads, unsupported terms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration, CheckLoads
from balance_cli.calibration.tare_result import Tares
from balance_cli.campaign.rig.load_components import FullScale
from balance_cli.report.blocks import Row, Table, TableCell, plain_row
from balance_cli.report.diagnosis_tables import PLUS_MINUS, format_p_value
from balance_cli.report.load_series_rows import channel_residual_sigma
from balance_cli.report.number_format import (
    MARKED_SIGMA,
    MISSING_VALUE,
    format_percent,
    format_significant,
    value_and_sigma_text,
)
from balance_cli.report.reading_scale import MICROVOLTS, ReadingScale
from balance_cli.signals.distributions import CONFIDENCE, binom, chi2, norm

Array = NDArray[np.float64]

LOADS_ONLY = "linear"
HIGH_INFLATION = 10.0
"""Variance inflation above which a term is marked as nearly collinear with others (rule of thumb: Marquardt, 1970)."""
THREE_SIGMA_P_VALUE = 2.0 * float(norm.sf(MARKED_SIGMA))
"""P-value of a deviation of MARKED_SIGMA standard errors."""
MIN_ZEROS_FOR_SCATTER = 3
"""Zeros from which the scatter about a line is known."""


def nonlinear_terms(all_trims: AllTrimsCalibration, channel: int) -> tuple[int, ...]:
    """Indices of the nonlinear terms of a channel."""
    model = all_trims.model
    channel_terms = np.flatnonzero(np.isfinite(model.t[:, channel])).tolist()
    return tuple(i for i in channel_terms if i >= len(model.components))


def channel_table(all_trims: AllTrimsCalibration, ranges: Array, scale: ReadingScale = MICROVOLTS) -> Table:
    """Residuals and zeros of each channel; `ranges` (c,) [V] are the rated ranges of the channels."""
    words = ("residual", "row left out", "load series left out")
    head = (
        TableCell("channel"),
        TableCell("nonlinear terms"),
        *(TableCell(f"{word} [{scale.symbol}]") for word in words),
        TableCell(f"drift of the zero [{scale.symbol} per load series]"),
        TableCell("scatter of the zeros"),
    )
    caption = (
        "Residual: standard deviation. Row or load series left out: rms error of its prediction by all other rows "
        "(PRESS) or load series. Small: % of the channel's rated range. Drift: slope of a straight line through the "
        "zeros of the load series. Scatter: chi-square per degree of freedom of the zeros about that line, about 1 "
        "where their standard errors explain it. Marked: more than three standard errors, or a p-value as small."
    )
    rows = tuple(_channel_row(all_trims, c, float(full), scale) for c, full in enumerate(ranges))
    return Table(caption, (head,), rows)


def _channel_row(all_trims: AllTrimsCalibration, c: int, full_range: float, scale: ReadingScale) -> Row:
    model, count = all_trims.model, len(nonlinear_terms(all_trims, c))
    errors = (channel_residual_sigma(all_trims)[c], model.press[c], model.cross_validation_rms[c])
    return (
        TableCell(model.channel_names[c], mark="name"),
        TableCell(str(count)) if count else TableCell(LOADS_ONLY, mark="quiet"),
        *(_residual_cell(float(value), full_range, scale) for value in errors),
        _drift_cell(all_trims, c, scale),
        _scatter_cell(all_trims, c),
    )


def _residual_cell(value: float, full_range: float, scale: ReadingScale) -> TableCell:
    if not np.isfinite(value):
        return TableCell(MISSING_VALUE)
    return TableCell(format_significant(scale.per_base_unit * value), f"{format_percent(value / full_range)} %")


def _drift_cell(all_trims: AllTrimsCalibration, c: int, scale: ReadingScale) -> TableCell:
    if len(all_trims.model.zeros) < 2:
        return TableCell(MISSING_VALUE)
    slope, sigma = float(all_trims.drift.slope[c]), float(all_trims.drift.slope_sigma[c])
    words = f" {PLUS_MINUS} ".join(value_and_sigma_text(*(scale.per_base_unit * each for each in (slope, sigma))))
    return TableCell(words, mark="bad" if abs(slope) > MARKED_SIGMA * sigma else "")


def _scatter_cell(all_trims: AllTrimsCalibration, c: int) -> TableCell:
    count, scatter = len(all_trims.model.zeros), float(all_trims.drift.chi2_per_dof[c])
    if count < MIN_ZEROS_FOR_SCATTER:
        return TableCell(MISSING_VALUE)
    limit = float(chi2.isf(THREE_SIGMA_P_VALUE, count - 2)) / (count - 2)
    return TableCell(format_significant(scatter, 2), mark="bad" if scatter > limit else "")


# ---- terms -----------------------------------------------------------------------------------------------------------


def term_table(all_trims: AllTrimsCalibration, scale: ReadingScale = MICROVOLTS) -> Table:
    """Nonlinear terms of each channel, with their statistics."""
    words = ("channel", "term", f"at calibrated range [{scale.symbol}]", "t", "p", "variance inflation")
    head = tuple(TableCell(word, mark="text" if word == "term" else "") for word in words)
    caption = (
        "Nonlinear terms: contribution where the loads are at the calibrated range, with standard error; t and its "
        f"p-value; variance inflation by the other terms (marked: more than {HIGH_INFLATION:.0f})."
    )
    rows = tuple(row for c in range(len(all_trims.model.channel_names)) for row in _term_rows(all_trims, c, scale))
    return Table(caption, (head,), rows)


def _term_rows(all_trims: AllTrimsCalibration, c: int, scale: ReadingScale) -> Iterator[Row]:
    name, terms = all_trims.model.channel_names[c], nonlinear_terms(all_trims, c)
    if not terms:
        yield TableCell(name, mark="name"), TableCell(LOADS_ONLY, mark="text quiet", span=5)
    for n, i in enumerate(terms):
        yield TableCell("" if n else name, mark="name"), *_term_cells(all_trims, c, i, scale)


def _term_cells(all_trims: AllTrimsCalibration, c: int, i: int, scale: ReadingScale) -> Row:
    model = all_trims.model
    value, sigma = float(model.coefficients[i, c]), float(np.sqrt(model.covariance[c, i, i]))
    inflation = float(model.variance_inflation[i, c])
    return (
        TableCell(model.terms[i], mark="text"),
        TableCell(
            f" {PLUS_MINUS} ".join(value_and_sigma_text(*(scale.per_base_unit * each for each in (value, sigma))))
        ),
        TableCell(format_significant(float(model.t[i, c]))),
        TableCell(format_p_value(float(model.p_value[i, c]))),
        TableCell(format_significant(inflation, 2), mark="bad" if inflation > HIGH_INFLATION else ""),
    )


def unsupported_terms_table(all_trims: AllTrimsCalibration) -> Table:
    """Terms that the loads do not support, grouped by reason."""
    terms: dict[str, list[str]] = {}
    for term, reason in all_trims.model.unsupported_terms.items():
        terms.setdefault(reason, []).append(term)
    rows = tuple(
        (TableCell(reason, mark="name"), TableCell(", ".join(names), mark="text")) for reason, names in terms.items()
    )
    caption = "Terms that cannot be tested with these loads: no channel has them in the model."
    return Table(caption, ((TableCell("reason"), TableCell("terms", mark="text")),), rows)


# ---- natural zeros ---------------------------------------------------------------------------------------------------


def tare_table(channels: tuple[str, ...], tares: Tares, scale: ReadingScale) -> Table:
    """Natural zeros: readings of the channels without any load."""
    caption = "Natural zeros: reading of each channel without any load, not even the weight of the metric part."
    count = scale.per_base_unit
    zeros = zip(channels, count * tares.natural_zeros, count * tares.natural_zeros_sigma, strict=True)
    rows = tuple(
        (
            TableCell(name, mark="name"),
            TableCell(f" {PLUS_MINUS} ".join(value_and_sigma_text(float(value), float(sigma)))),
        )
        for name, value, sigma in zeros
    )
    return Table(caption, ((TableCell("channel"), TableCell(f"natural zero [{scale.symbol}]")),), rows)


# ---- check loads -----------------------------------------------------------------------------------------------------


def check_table(all_trims: AllTrimsCalibration, scale: FullScale) -> Table:
    """Errors of held-out runs, and the share of their loads within the prediction interval."""
    head = plain_row("run", *all_trims.model.components, "rows", "left out")
    caption = (
        f"Held-out loads: rms error in % of the {scale.meaning}, by the calibration model where no other method is "
        "named; small: share of the rows within their 95 % prediction interval. Left out: rows beyond the loads for "
        "which the model is valid. Marked: a share so small that chance causes it once in 370 runs, and rows left out."
    )
    return Table(caption, (head,), tuple(_check_row(scale, check) for check in all_trims.checks))


def _check_row(scale: FullScale, check: CheckLoads) -> Row:
    count, valid = len(check.is_valid), int(np.count_nonzero(check.is_valid))
    errors = zip(check.error / scale.values, check.interval_coverage, strict=True)
    return (
        TableCell(check.label, check.zeros or "", mark="name"),
        *(_check_cell(float(error), float(share), valid) for error, share in errors),
        TableCell(str(count)),
        TableCell(str(count - valid), mark="bad" if valid < count else ""),
    )


def _check_cell(error: float, share: float, rows: int) -> TableCell:
    if not rows:
        return TableCell(MISSING_VALUE)
    if not np.isfinite(share):
        return TableCell(format_percent(error), "interval not known")
    p_value = float(binom.cdf(round(share * rows), rows, CONFIDENCE))
    return TableCell(format_percent(error), f"{100 * share:.0f} %", "bad" if p_value < THREE_SIGMA_P_VALUE else "")
