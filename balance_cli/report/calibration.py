"""The static calibration on the page: C0, T0, residuals and hysteresis of each trim, and the calibration model."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.campaign.rig.load_components import component_units, full_scale
from balance_cli.report.blocks import (
    Details,
    Heading,
    PageBlock,
    Paragraph,
    Row,
    Section,
    Table,
    TableCell,
    WarningText,
    plain_row,
    row_with_name,
)
from balance_cli.report.load_residuals import check_load_blocks, load_residual_blocks
from balance_cli.report.load_schedule import load_schedule_blocks
from balance_cli.report.math_model import math_model_blocks
from balance_cli.report.number_format import MARKED_SIGMA, format_significant, value_and_sigma_text
from balance_cli.report.reading_scale import MICROVOLTS, ReadingScale, reading_scale
from balance_cli.report.sources import Source, Sources
from balance_cli.report.temperature import temperature_blocks

Array = NDArray[np.float64]

LARGEST_LACK_OF_FIT = 1.5
"""Residual over noise variance above which a warning says that a straight line does not describe the readings."""


def section(sources: Sources) -> Section | None:
    """The section of all calibrations; None without any."""
    named, blocks = len(sources.calibrations) > 1, list[PageBlock]()
    for i, source in enumerate(sources.calibrations):
        suffix = f"-{i + 1}" if i else ""
        blocks += [Heading(source.file)] if named else []
        blocks += load_residual_blocks(source.content, suffix)
        blocks += check_load_blocks(source.content, suffix)
        blocks += _calibration_blocks(source)
        blocks += math_model_blocks(source, named, suffix)
        blocks += temperature_blocks(source.content)
        blocks += load_schedule_blocks(source.content)
    return Section("calibration", "Static calibration", tuple(blocks)) if blocks else None


def _calibration_blocks(source: Source[Calibration]) -> Iterator[PageBlock]:
    trims = source.content.trims
    rows = sum(trim.rows for trim in trims.values())
    yield Heading("Matrices of the trims")
    yield from _unit_notes(source.content)
    yield Paragraph(
        f"{len(trims)} trim{'s' if len(trims) > 1 else ''}, {rows} load points, a linear fit to each trim. "
        "Residual: standard deviation of back-calculated less applied loads."
        if rows
        else "Read from a matrix: without load points neither residuals nor standard errors are known."
    )
    for trim in trims.values():
        yield from _trim_warnings(trim)
    yield residual_table(source.content)
    if any(np.isfinite(trim.hysteresis.loads).any() for trim in trims.values()):
        yield hysteresis_table(source.content)
    if _is_linear_matrix(source.content):
        # C0 would be a pseudo-inverse that nobody measured.
        yield from (inverse_table(trim) for trim in trims.values())
        return
    for trim in trims.values():
        yield matrix_table(trim, reading_scale(source.content.geometry, trim.channel_names))
    yield Details("T0: loads from channels", tuple(inverse_table(trim) for trim in trims.values()))


def _is_linear_matrix(calibration: Calibration) -> bool:
    """Whether the calibration was read from a matrix of loads from readings, T0, which states no noise."""
    return all(trim.rows == 0 and np.isnan(trim.residual_covariance).all() for trim in calibration.trims.values())


def _unit_notes(calibration: Calibration) -> Iterator[PageBlock]:
    """What V and microvolts stand for where some readings are ratios to the excitation, or counts, and others not."""
    units = {channel.reading_unit for channel in calibration.geometry.channels}
    for unit, meaning in (("V/V", "ratios to the excitation"), ("1", "numbers (counts)")):
        names = [channel.name for channel in calibration.geometry.channels if channel.reading_unit == unit]
        if names:
            small = f", and {MICROVOLTS.symbol} for a millionth of it" if len(units) > 1 else ""
            yield Paragraph(f"The readings of {', '.join(names)} are {meaning}: V stands for {unit}{small}.")


def _trim_warnings(trim: TrimCalibration) -> Iterator[PageBlock]:
    for channel, reason in trim.excluded_channels.items():
        yield WarningText(f"Trim {trim.trim}: channel {channel} left out: {reason}.")
    if trim.lack_of_fit > LARGEST_LACK_OF_FIT:
        yield WarningText(
            f"Trim {trim.trim}: a straight line does not describe the readings: the residual variance is "
            f"{format_significant(trim.lack_of_fit, 2)} times that of the noise."
        )


def residual_table(calibration: Calibration) -> Table:
    """Residuals in percent of the calibrated range by component, condition and lack of fit; one row per trim."""
    components = next(iter(calibration.trims.values())).components
    head = (
        TableCell("trim"),
        *(TableCell(name) for name in components),
        TableCell("condition"),
        TableCell("variance / noise"),
        TableCell("load points"),
        TableCell("runs"),
    )
    rows = tuple(_residual_row(trim) for trim in calibration.trims.values())
    first = next(iter(calibration.trims.values()))
    units = component_units(calibration.geometry)
    scale = full_scale(calibration.geometry, first.components, first.calibrated_range)
    ranges = zip(first.components, scale.values, strict=True)
    full = ", ".join(f"{name} {format_significant(float(value))} {units[name]}" for name, value in ranges)
    caption = (
        f"Residual in % of the {scale.meaning} ({full}); condition of C0 in units of the calibrated range and of the "
        "noise of the channels; variance of the residuals over that of the noise (1 where a straight line fits the "
        "readings; not known where the rows do not show their noise)."
    )
    return Table(caption, (head,), rows)


def _residual_row(trim: TrimCalibration) -> Row:
    percents = [format_significant(value, 2) for value in trim.residual_percent_fs.values()]
    rest = (
        format_significant(trim.condition),
        format_significant(trim.lack_of_fit) if np.isfinite(trim.lack_of_fit) else "not known",
        str(trim.rows),
        ", ".join(trim.runs),
    )
    return row_with_name(trim.trim, *percents, *rest)


def hysteresis_table(calibration: Calibration) -> Table:
    """Hysteresis of each trim, as loads."""
    components, units = next(iter(calibration.trims.values())).components, component_units(calibration.geometry)
    head = (TableCell("trim"), *(TableCell(f"{name} [{units[name]}]") for name in components))
    rows = []
    for trim in calibration.trims.values():
        pairs = zip(trim.hysteresis.loads, trim.hysteresis.loads_sigma, trim.full_scale, strict=True)
        cells = [_hysteresis_cell(float(width), float(sigma), float(full)) for width, sigma, full in pairs]
        rows.append((TableCell(trim.trim, mark="name"), *cells))
    caption = (
        "Hysteresis: reading while loading less reading while unloading, as load, with standard error; small: % of "
        "full scale. Marked: more than three standard errors."
    )
    return Table(caption, (head,), tuple(rows))


def _hysteresis_cell(width: float, sigma: float, full_range: float) -> TableCell:
    value, error = value_and_sigma_text(width, sigma)
    mark = "bad" if abs(width) > MARKED_SIGMA * sigma else ""
    return TableCell(
        f"{value} \N{PLUS-MINUS SIGN} {error}", f"{format_significant(100 * width / full_range, 2)} %", mark
    )


def matrix_table(trim: TrimCalibration, scale: ReadingScale) -> Table:
    """C0 of a trim with standard errors."""
    caption = f"C0 of trim {trim.trim} [{scale.symbol}/N, {scale.symbol}/(N m)] with standard errors."
    scaled = (scale.per_base_unit * trim.C0, scale.per_base_unit * trim.C0_sigma)
    return _coefficient_table(caption, trim.channel_names, trim.components, *scaled)


def inverse_table(trim: TrimCalibration) -> Table:
    """T0 of a trim with standard errors."""
    errors = " with standard errors" if np.isfinite(trim.T0_sigma).any() else ", as it was read"
    caption = f"T0 of trim {trim.trim} [N/V, N m/V]{errors}."
    return _coefficient_table(caption, trim.components, trim.channel_names, trim.T0, trim.T0_sigma)


def _coefficient_table(
    caption: str,
    names: tuple[str, ...],
    columns: tuple[str, ...],
    values: Array,
    sigmas: Array,
) -> Table:
    rows = []
    for name, value_row, sigma_row in zip(names, values, sigmas, strict=True):
        pairs = (value_and_sigma_text(float(v), float(s)) for v, s in zip(value_row, sigma_row, strict=True))
        rows.append(
            (
                TableCell(name, mark="name"),
                *(TableCell(value, f"\N{PLUS-MINUS SIGN} {sigma}") for value, sigma in pairs),
            )
        )
    head = plain_row("", *columns)
    return Table(caption, (head,), tuple(rows))
