"""Bode plots of every sensor and component as one chart: amplitude, phase and residual, with multiples of 1/rev."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.report.blocks import Chart, PlotGroup
from balance_cli.report.figure_style import BLACK, GRAY, PlotStyle
from balance_cli.report.force_responses import quotient
from balance_cli.report.plots import Marker, Plot, Trace
from balance_cli.report.response_figures import Panel, phase_with_gaps

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOST_MODELS = 3
"""Models of the chart: each adds three curves for every sensor and component to the page."""
FREQUENCY_LABEL = "frequency [Hz]"


def bode_chart(
    panels: Sequence[Panel], shown_models: Sequence[str], markers: tuple[Marker, ...], static_markup: str
) -> Chart:
    """Return the chart with one choice for each panel; `shown_models` are labels of models, the first MOST_MODELS."""
    kept = list(shown_models)[:MOST_MODELS]
    groups = tuple(
        PlotGroup(f"{panel.sensor}/{panel.component}", tuple(_plots(panel, kept, markers))) for panel in panels
    )
    named = f" Models: {', '.join(kept)}." if kept else ""
    caption = (
        "Response of each cell to each component: amplitude, phase and relative residual, with the noise of the "
        f"measurement. Dashed: multiples of the nominal rotor speed.{named} In print: a selection."
    )
    return Chart("fit", caption, groups, "frequency", static_markup, wide=True)


def _plots(panel: Panel, kept: Sequence[str], markers: tuple[Marker, ...]) -> list[Plot]:
    x, measured = panel.measured.frequency, panel.measured.value
    size = np.abs(measured)
    models = [(label, style, value) for label, style, value in panel.models if label in kept and value.any()]
    amplitude = [_trace("measured", size, BLACK, width=2.2)]
    phase = [_trace("measured", phase_with_gaps(measured), BLACK, width=2.2)]
    residual = [_trace("noise, 1 sigma", 100 * quotient(panel.measured.sigma, size), GRAY, width=2.2)]
    for label, style, value in models:
        amplitude.append(_styled(label, np.abs(value), style))
        phase.append(_styled(label, phase_with_gaps(value), style))
        residual.append(_styled(label, 100 * quotient(np.abs(value - measured), size), style))
    name = f"{panel.sensor}/{panel.component}"
    shown = [
        Plot(name, x, tuple(amplitude), FREQUENCY_LABEL, f"amplitude [{panel.unit}]", True, markers, height=230),
        Plot(f"{name}, phase", x, tuple(phase), FREQUENCY_LABEL, "phase [°]", False, markers, (-190.0, 190.0), 150),
    ]
    if models:
        title = f"{name}, residual"
        shown.append(Plot(title, x, tuple(residual), FREQUENCY_LABEL, "residual [%]", True, markers, height=180))
    return shown


def _trace(label: str, y: Array, color: str, dashes: tuple[float, ...] = (), width: float = 1.4) -> Trace:
    return Trace(label, y, color, dashes, width, compact=True)


def _styled(label: str, y: Array, style: PlotStyle) -> Trace:
    return _trace(label, y, style.color, tuple(2.0 * dash for dash in style.dashes))
