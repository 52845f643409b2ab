"""Tables of the gage model: channels, curved terms, loads that checked it, terms that the loads do not support."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibration.all_trims import AllTrimsCalibration, CheckLoads
from balance_cli.calibration.tares import Tares
from balance_cli.report.blocks import Row, Table, TableCell
from balance_cli.report.diagnosis_tables import PLUS_MINUS, format_p_value
from balance_cli.report.load_series_rows import channel_residual_sigma
from balance_cli.report.number_format import (
    MARKED_SIGMA,
    MISSING_VALUE,
    format_percent,
    format_significant,
    value_and_sigma_text,
)

Array = NDArray[np.float64]

MICROVOLT = "\N{MICRO SIGN}V"
LOADS_ONLY = "the loads alone"
HIGH_INFLATION = 10.0
"""Variance inflation above which a term is hardly told from others."""
THREE_SIGMA_P_VALUE = 2.0 * float(stats.norm.sf(MARKED_SIGMA))
"""How often chance exceeds so many standard errors."""
MIN_ZEROS_FOR_SCATTER = 3
"""Zeros that tell a scatter about a line."""


def nonlinear_terms(gage: AllTrimsCalibration, channel: int) -> tuple[int, ...]:
    """Which terms of a channel are not loads themselves."""
    model = gage.model
    of_channel = np.flatnonzero(np.isfinite(model.t[:, channel])).tolist()
    return tuple(i for i in of_channel if i >= len(model.components))


def channel_table(gage: AllTrimsCalibration, ranges: Array) -> Table:
    """What each channel leaves, and its zeros; `ranges` (c,) [V] are the channels' full ranges."""
    words = ("residual", "row left out", "sequence left out")
    head = (
        TableCell("channel"),
        TableCell("curved terms"),
        *(TableCell(f"{word} [{MICROVOLT}]") for word in words),
        TableCell(f"drift of the zero [{MICROVOLT} per sequence]"),
        TableCell("scatter of the zeros"),
    )
    caption = (
        "Residual: standard deviation. Row, sequence left out: rms error where all other rows (PRESS), or all other "
        "sequences, predict it. Small: % of the channel's full range. Drift: straight line through the zeros of the "
        "sequences; scatter about it: chi-square per degree of freedom, 1 or less where the standard errors of the "
        "zeros say it all. Marked: beyond three standard errors, or as rare."
    )
    rows = tuple(_channel_row(gage, c, float(full)) for c, full in enumerate(ranges))
    return Table(caption, (head,), rows)


def _channel_row(gage: AllTrimsCalibration, c: int, full_range: float) -> Row:
    model, count = gage.model, len(nonlinear_terms(gage, c))
    left = (channel_residual_sigma(gage)[c], model.press[c], model.left_out[c])
    return (
        TableCell(model.channel_names[c], mark="name"),
        TableCell(str(count)) if count else TableCell(LOADS_ONLY, mark="quiet"),
        *(_residual_cell(float(value), full_range) for value in left),
        _drift_cell(gage, c),
        _scatter_cell(gage, c),
    )


def _residual_cell(value: float, full_range: float) -> TableCell:
    if not np.isfinite(value):
        return TableCell(MISSING_VALUE)
    return TableCell(format_significant(1e6 * value), f"{format_percent(value / full_range)} %")


def _drift_cell(gage: AllTrimsCalibration, c: int) -> TableCell:
    if len(gage.model.zeros) < 2:
        return TableCell(MISSING_VALUE)
    slope, sigma = float(gage.drift.slope[c]), float(gage.drift.slope_sigma[c])
    words = f" {PLUS_MINUS} ".join(value_and_sigma_text(1e6 * slope, 1e6 * sigma))
    return TableCell(words, mark="bad" if abs(slope) > MARKED_SIGMA * sigma else "")


def _scatter_cell(gage: AllTrimsCalibration, c: int) -> TableCell:
    count, scatter = len(gage.model.zeros), float(gage.drift.scatter[c])
    if count < MIN_ZEROS_FOR_SCATTER:
        return TableCell(MISSING_VALUE)
    limit = float(stats.chi2.isf(THREE_SIGMA_P_VALUE, count - 2)) / (count - 2)
    return TableCell(format_significant(scatter, 2), mark="bad" if scatter > limit else "")


# ---- terms -----------------------------------------------------------------------------------------------------------


def term_table(gage: AllTrimsCalibration) -> Table:
    """Every curved term of every channel; a channel without any has the loads alone."""
    words = ("channel", "term", f"at full range [{MICROVOLT}]", "t", "p", "variance inflation")
    head = tuple(TableCell(word, mark="text" if word == "term" else "") for word in words)
    caption = (
        "Curved terms: what each adds where its loads are at full range, with standard error; t, the probability of so "
        "large a t by chance, and by how much the other terms inflate its variance (marked: more than "
        f"{HIGH_INFLATION:.0f} times)."
    )
    rows = tuple(row for c in range(len(gage.model.channel_names)) for row in _term_rows(gage, c))
    return Table(caption, (head,), rows)


def _term_rows(gage: AllTrimsCalibration, c: int) -> Iterator[Row]:
    name, terms = gage.model.channel_names[c], nonlinear_terms(gage, c)
    if not terms:
        yield TableCell(name, mark="name"), TableCell(LOADS_ONLY, mark="text quiet", span=5)
    for n, i in enumerate(terms):
        yield TableCell("" if n else name, mark="name"), *_term_cells(gage, c, i)


def _term_cells(gage: AllTrimsCalibration, c: int, i: int) -> Row:
    model = gage.model
    value, sigma = float(model.coefficients[i, c]), float(np.sqrt(model.covariance[c, i, i]))
    inflation = float(model.variance_inflation[i, c])
    return (
        TableCell(model.terms[i], mark="text"),
        TableCell(f" {PLUS_MINUS} ".join(value_and_sigma_text(1e6 * value, 1e6 * sigma))),
        TableCell(format_significant(float(model.t[i, c]))),
        TableCell(format_p_value(float(model.p_value[i, c]))),
        TableCell(format_significant(inflation, 2), mark="bad" if inflation > HIGH_INFLATION else ""),
    )


def unsupported_terms_table(gage: AllTrimsCalibration) -> Table:
    """Terms that the loads do not support, gathered by reason."""
    terms: dict[str, list[str]] = {}
    for term, reason in gage.model.refused.items():
        terms.setdefault(reason, []).append(term)
    rows = tuple(
        (TableCell(reason, mark="name"), TableCell(", ".join(names), mark="text")) for reason, names in terms.items()
    )
    caption = "Terms that nothing can be said of: no channel has them, whether they are there or not."
    return Table(caption, ((TableCell("reason"), TableCell("terms", mark="text")),), rows)


# ---- natural zeros ---------------------------------------------------------------------------------------------------


def tare_table(channels: tuple[str, ...], tares: Tares) -> Table:
    """What the channels read without any load."""
    caption = "Natural zeros: what each channel reads without any load, nor the weight of the metric part."
    zeros = zip(channels, 1e6 * tares.natural_zeros, 1e6 * tares.natural_zeros_sigma, strict=True)
    rows = tuple(
        (
            TableCell(name, mark="name"),
            TableCell(f" {PLUS_MINUS} ".join(value_and_sigma_text(float(value), float(sigma)))),
        )
        for name, value, sigma in zeros
    )
    return Table(caption, ((TableCell("channel"), TableCell(f"natural zero [{MICROVOLT}]")),), rows)


# ---- loads that checked it -------------------------------------------------------------------------------------------


def check_table(gage: AllTrimsCalibration) -> Table:
    """Error and share within the interval, run by run."""
    head = tuple(TableCell(word) for word in ("run", *gage.model.components, "rows", "left out"))
    caption = (
        "Loads that took no part in the fit: rms error in % of full range; small: share of the rows within their 95 % "
        "interval. Left out: rows beyond the loads for which the model is taken. Marked: a smaller share than chance "
        "gives once in 370 runs, and rows left out."
    )
    return Table(caption, (head,), tuple(_check_row(gage, check) for check in gage.checks))


def _check_row(gage: AllTrimsCalibration, check: CheckLoads) -> Row:
    count, solved = len(check.solved), int(np.count_nonzero(check.solved))
    errors = zip(check.error / gage.model.full_range, check.interval_coverage, strict=True)
    return (
        TableCell(check.run, mark="name"),
        *(_check_cell(float(error), float(share), solved) for error, share in errors),
        TableCell(str(count)),
        TableCell(str(count - solved), mark="bad" if solved < count else ""),
    )


def _check_cell(error: float, share: float, rows: int) -> TableCell:
    if not rows:
        return TableCell(MISSING_VALUE)
    chance = float(stats.binom.cdf(round(share * rows), rows, 0.95))
    return TableCell(format_percent(error), f"{100 * share:.0f} %", "bad" if chance < THREE_SIGMA_P_VALUE else "")
