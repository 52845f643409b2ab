"""The gage model of a calibration on the page: what it is, what is wrong in it, its tables and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from matplotlib.figure import Figure

from balance_cli.calibration.all_trims import AllTrimsCalibration
from balance_cli.calibration.convergence import Contraction
from balance_cli.calibration.noniterative import NonIterativeModel
from balance_cli.calibration.outliers import Outlier, SuspectLoadSeries
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.selection import TERM_SIGNIFICANCE_LEVEL
from balance_cli.calibration.tares import Tares
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.report.blocks import Details, Heading, PageBlock, Paragraph, Picture, WarningText
from balance_cli.report.diagnosis_tables import PLUS_MINUS
from balance_cli.report.figure_style import svg
from balance_cli.report.load_series_rows import channel_ranges, split_load_series
from balance_cli.report.math_model_figures import load_figure, order_figure
from balance_cli.report.math_model_tables import (
    MICROVOLT,
    channel_table,
    check_table,
    nonlinear_terms,
    tare_table,
    term_table,
    unsupported_terms_table,
)
from balance_cli.report.number_format import format_significant, join_names, value_and_sigma_text
from balance_cli.report.sources import Source

NO_MODEL_TEXT = (
    "There is no model through all trims: their channels in common do not serve, or loads were applied that the "
    "balance does not carry."
)


def math_model_blocks(source: Source[Calibration], named: bool, suffix: str) -> Iterator[PageBlock]:
    """Everything of one calibration's gage model; `ending` makes the names of its pictures unique."""
    gage = source.content.gage
    yield Heading(f"{source.file}: one model through all trims" if named else "One model through all trims")
    if gage is None:
        yield Paragraph(NO_MODEL_TEXT)
        return
    proof = gage.model.contraction()
    stated = not len(gage.loads)
    yield Paragraph(
        MATRIX_ONLY_TEXT
        if stated
        else _overview_text(gage, source.artefact.provenance.options.get("terms") != "linear")
    )
    yield from _math_model_warnings(gage, proof)
    if proof.proved:
        yield Paragraph(_iteration_text(gage, proof))
    if gage.direct is not None:
        yield Paragraph(_non_iterative_text(gage.direct))
    if not stated:
        yield channel_table(gage, channel_ranges(source.content, gage))
    if gage.model.curved:
        yield term_table(gage)
    if gage.tares is not None:
        yield Paragraph(_metric_weight_text(gage.tares))
        yield tare_table(gage.model.channel_names, gage.tares)
    if gage.checks:
        yield check_table(gage)
    if not stated:
        yield from _residual_pictures(source.content, gage, suffix)
    if gage.model.refused:
        words = f"{len(gage.model.refused)} terms that these loads do not support"
        yield Details(words, (unsupported_terms_table(gage),))


def _overview_text(gage: AllTrimsCalibration, search: bool) -> str:
    rows, used = len(gage.loads), int(np.count_nonzero(np.isfinite(gage.residuals).any(axis=1)))
    taken = f"{rows} rows" if used == rows else f"{used} of {rows} rows"
    count = len(gage.model.sequences)
    each = f"{count} loading sequences, each with a zero of its own" if count > 1 else "one loading sequence"
    chosen = _selection_text(gage) if search else LINEAR_TERMS_TEXT
    return f"All channels through all trims, {taken} of {join_names(gage.runs)} in {each}. {chosen}"


MATRIX_ONLY_TEXT = (
    "All channels through all trims, as a matrix states them: no load points are behind it, nor errors of its terms."
)
LINEAR_TERMS_TEXT = "Every channel has the loads alone; no other terms were sought."


def _selection_text(gage: AllTrimsCalibration) -> str:
    names = gage.model.channel_names
    curved = [name for c, name in enumerate(names) if nonlinear_terms(gage, c)]
    having = f"{join_names(curved)} {'have' if len(curved) > 1 else 'has'} some" if curved else "no channel has any"
    return (
        "Beside the loads themselves a channel has the terms that are significant (probability of a spurious one in "
        f"the whole balance {TERM_SIGNIFICANCE_LEVEL:g}) and that help to predict loading sequences that took no part: "
        f"{having}."
    )


def _iteration_text(gage: AllTrimsCalibration, proof: Contraction) -> str:
    """Between which loads it was calibrated, and beyond which it is refused."""
    model = gage.model
    limits = zip(model.components, model.smallest, model.largest, strict=True)
    calibrated = ", ".join(
        f"{name} {format_significant(float(low))} to {format_significant(float(high))} {UNIT_OF[name]}"
        for name, low, high in limits
    )
    reach = zip(model.components, proof.reach * model.full_range, strict=True)
    refused = ", ".join(f"{name} {PLUS_MINUS}{format_significant(float(size))} {UNIT_OF[name]}" for name, size in reach)
    shrinks = "Loads are found by iteration; every step shrinks the error at least "
    steps = f"{shrinks}{format_significant(1.0 / max(proof.rho, 1e-12), 2)} times. " if model.curved else ""
    return f"{steps}Calibrated: {calibrated}. Loads beyond {refused} are refused."


def _non_iterative_text(direct: NonIterativeModel) -> str:
    """What the loads as functions of the readings leave."""
    pairs = zip(direct.model.components, direct.residual_percent_fs, strict=True)
    left = ", ".join(f"{name} {format_significant(float(value), 2)}" for name, value in pairs)
    return f"Mean loads are taken as functions of the readings, without iteration; residual in % of full range: {left}."


def _metric_weight_text(tares: Tares) -> str:
    """The weight of the metric part and its place, in words."""
    weight = f" {PLUS_MINUS} ".join(value_and_sigma_text(tares.weight, tares.weight_sigma))
    place = ""
    if np.isfinite(tares.center_of_gravity).all():
        each = zip("xyz", tares.center_of_gravity, tares.center_of_gravity_sigma, strict=True)
        words = (
            f"{axis} {f' {PLUS_MINUS} '.join(value_and_sigma_text(1e3 * at, 1e3 * sigma))}" for axis, at, sigma in each
        )
        place = f", its centre of gravity from the hub at {', '.join(words)} mm"
    chi2 = format_significant(tares.chi2_per_dof, 2)
    return (
        f"The zeros of {tares.sequences} loading sequences in their attitudes tell the metric part: weight {weight} N"
        f"{place} (chi-square per degree of freedom {chi2}). Loads of the model hold this weight."
    )


def _math_model_warnings(gage: AllTrimsCalibration, proof: Contraction) -> Iterator[PageBlock]:
    for one in gage.bad_sequences:
        yield WarningText(_suspect_series_warning(one))
    for row in gage.outliers:
        yield WarningText(_outlier_warning(row))
    if not proof.proved:
        yield WarningText(
            "The iteration from readings to loads is not proved to converge over the range of the calibration: no "
            "loads are found with this model."
        )


def _suspect_series_warning(one: SuspectLoadSeries) -> str:
    gain = f" {PLUS_MINUS} ".join(value_and_sigma_text(one.gain, one.gain_sigma))
    like = f", as {one.like} should" if one.like else ""
    other = f" Or it is {' or '.join(one.or_else)} that is wrong." if one.or_else else ""
    return (
        f"{one.sequence}: {one.channel} changes {gain} times as much as the other sequences say{like}. The sequence "
        f"took no part.{other}"
    )


def _outlier_warning(one: Outlier) -> str:
    size, way = format_significant(abs(1e6 * one.error)), "above" if one.error > 0 else "below"
    return (
        f"{one.run} row {one.row}: {one.channel} is {size} {MICROVOLT} {way} what all other rows say "
        f"({format_significant(abs(one.over_sigma))} standard deviations). The row took no part."
    )


def _residual_pictures(calibration: Calibration, gage: AllTrimsCalibration, suffix: str) -> Iterator[PageBlock]:
    known, ranges = split_load_series(gage), channel_ranges(calibration, gage)
    lost = " Hatched: took no part." if not all(one.used for one in known) else ""
    found = " Triangles: rows that took no part." if gage.outliers else ""
    yield _picture(
        f"gage-order{suffix}",
        "Residual of each channel in the order of loading; the bands are the loading sequences, named by the loads "
        f"that moved. Dashed: two standard deviations.{lost}{found}",
        lambda: order_figure(gage, known, ranges),
    )
    yield _picture(
        f"gage-load{suffix}",
        "Residual of each channel against the applied load in % of its full range, every row at each load that moved "
        f"in its sequence. A line, cubic, where more is left of a component than chance leaves.{found}",
        lambda: load_figure(gage, known, ranges),
    )


def _picture(name: str, caption: str, draw: Callable[[], Figure]) -> Picture:
    return Picture(name, caption, svg(name, caption.split(".", maxsplit=1)[0], draw))
