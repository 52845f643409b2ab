"""Pictures of measured and modeled responses: amplitude, phase and residual in small panels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.report.figure_style import BLACK, PlotStyle, new_figure, set_log_axis
from balance_cli.report.force_responses import TORQUE_METER, Curve, quotient

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOST_IN_FOUR_COLUMNS = 8
LEGEND_INCHES = 0.35
RESIDUAL_LIMITS = (0.1, 300.0)
"""Limits of the residual axis [%]."""
NO_RESPONSE_STYLE: dict[str, Any] = {"ha": "center", "va": "center", "color": "#666666"}
MAX_AXIS_RATIO = 1e4
"""Largest ratio of the ends of the amplitude axis: more decades would flatten the curves."""


@dataclass(frozen=True)
class Panel:
    """One sensor and component: the measured curve, and (label, plot style, value (k,)) of each model."""

    sensor: str
    component: str
    measured: Curve
    models: tuple[tuple[str, PlotStyle, ComplexArray], ...]

    @property
    def unit(self) -> str:
        """Unit of the response."""
        per = UNIT_OF[self.component]
        sensor_unit = "N m" if self.sensor.startswith(TORQUE_METER) else "N"
        if sensor_unit == per:
            return "1"
        return f"{sensor_unit}/({per})" if " " in per else f"{sensor_unit}/{per}"

    @property
    def is_zero_in_models(self) -> bool:
        """Whether there are models and the response is zero in all of them."""
        return bool(self.models) and not any(value.any() for _, _, value in self.models)


def component_figure(panels: Sequence[Panel]) -> Figure:
    """All sensors of one component, with common amplitude limits."""
    limits = _amplitude_limits(panels)
    columns = min(len(panels), 4 if len(panels) <= MOST_IN_FOUR_COLUMNS else 5)
    return _draw_grid(panels, columns, 2.45, (1.15, 0.6, 0.85), limits)


def detail_figure(panels: Sequence[Panel]) -> Figure:
    """A few pairs in larger panels, each with its own amplitude limits."""
    return _draw_grid(panels, min(len(panels), 2), 3.4, (1.5, 0.7, 1.0), None)


def _draw_grid(
    panels: Sequence[Panel],
    columns: int,
    height: float,
    ratios: tuple[float, float, float],
    limits: tuple[float, float] | None,
) -> Figure:
    lines = -(-len(panels) // columns)
    total = height * lines + LEGEND_INCHES + 0.3
    figure = new_figure(12.0, total)
    grid = figure.add_gridspec(
        lines,
        columns,
        left=0.05,
        right=0.985,
        top=1 - 0.2 / total,
        bottom=(LEGEND_INCHES + 0.35) / total,
        wspace=0.2,
        hspace=0.22,
    )
    for i, panel in enumerate(panels):
        ends = (i % columns == 0, i >= len(panels) - columns)
        _draw_panel(figure, grid[i // columns, i % columns], panel, ratios, limits or _amplitude_limits([panel]), ends)
    _add_model_legend(figure, panels)
    return figure


def _draw_panel(
    figure: Figure,
    spec: SubplotSpec,
    panel: Panel,
    ratios: tuple[float, float, float],
    limits: tuple[float, float],
    ends: tuple[bool, bool],
) -> None:
    first, last = ends
    inner = spec.subgridspec(3, 1, height_ratios=ratios, hspace=0.1)
    upper, middle, lower = (figure.add_subplot(inner[row]) for row in range(3))
    _draw_amplitude(upper, panel, limits)
    _draw_phase(middle, panel)
    _draw_residual(lower, panel)
    upper.set_title(f"{panel.sensor}/{panel.component} [{panel.unit}]")
    if first:
        upper.set_ylabel("amplitude")
        middle.set_ylabel("phase [°]")
        lower.set_ylabel("residual [%]")
        figure.align_ylabels([upper, middle, lower])
    for axes in (upper, middle, lower):
        axes.set_xlim(0.0, float(panel.measured.frequency[-1]))
        axes.tick_params(axis="x", labelbottom=axes is lower)
    if last:
        lower.set_xlabel("frequency [Hz]")


def _draw_amplitude(axes: Axes, panel: Panel, limits: tuple[float, float]) -> None:
    set_log_axis(axes, limits)
    frequency = panel.measured.frequency
    axes.plot(frequency, np.abs(panel.measured.value), color=BLACK, linewidth=1.8, alpha=0.55, rasterized=True)
    for _, plot_style, value in panel.models:
        if value.any():
            axes.plot(frequency, np.abs(value), linewidth=1.0, rasterized=True, **plot_style.line_kwargs)


def _draw_phase(axes: Axes, panel: Panel) -> None:
    frequency = panel.measured.frequency
    if not panel.is_zero_in_models:
        phase = phase_with_gaps(panel.measured.value)
        axes.plot(frequency, phase, color=BLACK, linewidth=1.8, alpha=0.55, rasterized=True)
    for _, plot_style, value in panel.models:
        if value.any():
            axes.plot(frequency, phase_with_gaps(value), linewidth=1.0, rasterized=True, **plot_style.line_kwargs)
    axes.set_ylim(-190.0, 190.0)
    axes.set_yticks([-180, 0, 180])


def phase_with_gaps(value: ComplexArray) -> Array:
    """Phase [deg] within +-180, NaN at the first line after a jump so that no curve crosses the panel."""
    phase = np.degrees(np.angle(value))
    phase[1:][np.abs(np.diff(phase)) > 180.0] = np.nan
    return np.asarray(phase)


def _draw_residual(axes: Axes, panel: Panel) -> None:
    set_log_axis(axes, RESIDUAL_LIMITS)
    frequency, size = panel.measured.frequency, np.abs(panel.measured.value)
    noise = 100 * quotient(panel.measured.sigma, size)
    axes.fill_between(frequency, RESIDUAL_LIMITS[0] / 10, noise, color="#d4d4d4", linewidth=0, rasterized=True)
    for _, plot_style, value in panel.models:
        if value.any():
            residual = 100 * quotient(np.abs(value - panel.measured.value), size)
            axes.plot(frequency, residual, linewidth=0.9, rasterized=True, **plot_style.line_kwargs)
    if panel.is_zero_in_models:
        axes.text(0.5, 0.5, "no response in the models", transform=axes.transAxes, **NO_RESPONSE_STYLE)


def _amplitude_limits(panels: Sequence[Panel]) -> tuple[float, float]:
    """Limits that contain every measured curve except the deepest notches."""
    sizes = [np.abs(panel.measured.value) for panel in panels]
    high = 1.6 * max(float(size.max()) for size in sizes)
    low = min(float(np.percentile(size, 1)) for size in sizes)
    return max(0.6 * low, high / MAX_AXIS_RATIO), high


def _add_model_legend(figure: Figure, panels: Sequence[Panel]) -> None:
    labels = {label: plot_style for panel in panels for label, plot_style, _ in panel.models}
    handles: list[Line2D | Patch] = [Line2D([], [], color=BLACK, linewidth=1.8, alpha=0.55)]
    handles += [Line2D([], [], **plot_style.line_kwargs) for plot_style in labels.values()]
    handles.append(Patch(facecolor="#d4d4d4"))
    names = ["measured", *labels, "noise of the measurement (1 sigma)"]
    figure.legend(handles, names, loc="lower center", ncols=len(names))
