"""The values of a chart as tables, for readers without the picture."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.report.blocks import Chart, Row, Table, TableCell, plain_row
from balance_cli.report.number_format import format_significant
from balance_cli.report.plots import Plot

MOST_ROWS = 19
"""Rows of a table: an azimuth in steps of 20 degrees. The file of all values is beside the picture."""
DIGITS = 6
"""Significant digits, as many as the cursor of the picture shows."""


def data_tables(chart: Chart) -> Iterator[Table]:
    """Yield a table of equally spaced values of each plot of the first group."""
    yield from (plot_table(plot) for plot in chart.groups[0].plots)


def plot_table(plot: Plot) -> Table:
    """Return the table of one plot: x, then every trace."""
    index = np.unique(np.linspace(0, len(plot.x) - 1, min(MOST_ROWS, len(plot.x))).round().astype(int))
    names = [plot.x_label, *(trace.label for trace in plot.traces)]
    rows: list[Row] = []
    for i in index:
        values = [float(plot.x[i]), *(float(trace.y[i]) for trace in plot.traces)]
        rows.append(tuple(TableCell(format_significant(value, DIGITS)) for value in values))
    left = f"; {len(index)} of {len(plot.x)} values" if len(index) < len(plot.x) else ""
    head = plain_row(*names)
    return Table(f"{plot.title}: {plot.y_label}{left}", (head,), tuple(rows))
