"""Picture of the whiteness of innovations: their autocorrelation by channel, with the limits for white ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from balance_cli.reduction.kalman.innovations import InnovationTests
from balance_cli.reduction.result import HubLoads
from balance_cli.report.blocks import Chart, PlotGroup
from balance_cli.report.figure_style import BLUE, GRAY
from balance_cli.report.number_format import format_fixed
from balance_cli.report.plots import Plot, Trace
from balance_cli.report.sources import Source

LIMIT_SIGMAS = 1.96
"""Limits that 95 % of the autocorrelations of white innovations lie within, in units of 1 / sqrt(pairs)."""
SMALLEST_AXIS = 0.05
"""Half height of the axes where all autocorrelations are small: the level above which a record counts as not steady."""
PLOT_HEIGHT = 180
"""Height [px] of the plot of one run: a dozen runs fit a page."""


def innovation_chart(sources: Sequence[Source[HubLoads]]) -> Chart | None:
    """Return the chart with a choice of runs; None where no filter has kept its autocorrelations."""
    groups, above, total = [], 0, 0
    for source in sources:
        for name, run in source.content.runs.items():
            tests = run.in_time.innovations if run.in_time is not None else None
            if tests is None or tests.autocorrelation is None or tests.pairs is None:
                continue
            label = name if len(sources) == 1 else f"{name}, {source.label}"
            groups.append(PlotGroup(label, tuple(_plots(tests))))
            limit = LIMIT_SIGMAS / np.sqrt(np.maximum(tests.pairs, 1.0))
            above += sum(int(np.count_nonzero(np.abs(rho) > limit)) for rho in tests.autocorrelation.values())
            total += len(tests.autocorrelation) * len(tests.pairs)
    if not groups:
        return None
    percent = format_fixed(100.0 * above / max(total, 1), 1)
    caption = (
        "Whiteness of the innovations: their autocorrelation by channel and lag. White innovations lie within the "
        f"gray band in 95 % of all places; {above} of {total} ({percent} %) lie outside."
    )
    return Chart("innovations", caption, tuple(groups))


def _plots(tests: InnovationTests) -> list[Plot]:
    assert tests.autocorrelation is not None and tests.pairs is not None
    lags = np.arange(1.0, len(tests.pairs) + 1.0)
    limit = LIMIT_SIGMAS / np.sqrt(np.maximum(tests.pairs, 1.0))
    largest = max((float(np.nanmax(np.abs(rho))) for rho in tests.autocorrelation.values()), default=0.0)
    height = 1.1 * max(largest, SMALLEST_AXIS)
    plots = []
    for name, rho in tests.autocorrelation.items():
        traces = (
            Trace(name, rho, BLUE, points=True),
            Trace("white, 95 %", np.zeros(len(lags)), GRAY, (4.0, 3.0), 1.0, band=np.array([-limit, limit])),
        )
        plots.append(
            Plot(name, lags, traces, "lag [samples]", "autocorrelation [1]", False, (), (-height, height), PLOT_HEIGHT)
        )
    return plots
