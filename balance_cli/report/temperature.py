"""Temperature on the page: what it adds to the reading of each channel."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.calibration.temperature_terms import TemperatureTerms
from balance_cli.report.blocks import Heading, PageBlock, Paragraph, Row, Table, TableCell
from balance_cli.report.number_format import MARKED_SIGMA, format_significant

Array = NDArray[np.float64]


def temperature_blocks(calibration: Calibration) -> Iterator[PageBlock]:
    """Shift of the zero and drift of the sensitivities of each channel; nothing where temperature is not known."""
    terms = calibration.temperature
    if terms is None:
        return
    yield Heading("Temperature")
    first, last = (f"{value:.1f} \N{DEGREE SIGN}C" for value in (terms.lowest, terms.highest))
    span = f"Readings refer to {terms.reference:.1f} \N{DEGREE SIGN}C; load points were taken from {first} to {last}."
    if terms.is_empty:
        yield Paragraph(f"{span} No channel depends on the temperature significantly.")
        return
    yield Paragraph(f"{span} Loads at other temperatures are corrected by these terms.")
    yield temperature_table(calibration, terms)


def temperature_table(calibration: Calibration, terms: TemperatureTerms) -> Table:
    """One row for each channel: what one kelvin changes, in percent of its largest reading."""
    trim = next(iter(calibration.trims.values()))
    head = (TableCell("channel"), TableCell("zero"), *(TableCell(name) for name in trim.components))
    rows: list[Row] = []
    for channel, name in enumerate(terms.channel_names):
        if name not in trim.channel_names:
            continue
        sensitivity = trim.C0[trim.channel_names.index(name)]
        largest = float(np.max(np.abs(sensitivity) * trim.calibrated_range))
        sigma = np.sqrt(np.diag(terms.covariance[channel]))
        # In percent of a small sensitivity its change would look large.
        scale = np.r_[largest, largest / trim.calibrated_range]
        rows.append((TableCell(name, mark="name"), *_cells(terms.coefficients[:, channel], sigma, scale)))
    caption = (
        "Effect of one kelvin in % of the largest reading of the channel, with standard error: shift of the zero, and "
        "change of the reading under the largest calibrated load of each component. Empty: not significant. Marked: "
        "more than three standard errors."
    )
    return Table(caption, (head,), tuple(rows))


def _cells(values: Array, sigma: Array, scale: Array) -> Iterator[TableCell]:
    for value, error, unit in zip(100.0 * values / scale, 100.0 * sigma / scale, scale, strict=True):
        if value == 0.0 or unit == 0.0:
            yield TableCell("")
            continue
        mark = "bad" if abs(value) > MARKED_SIGMA * error else ""
        yield TableCell(
            format_significant(float(value), 3), f"\N{PLUS-MINUS SIGN} {format_significant(float(error), 2)}", mark
        )
