"""Measured responses against all models: one picture per component, one panel per cell, and tables of errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.report.blocks import (
    Details,
    Heading,
    PageBlock,
    Paragraph,
    Picture,
    Row,
    Section,
    Table,
    TableCell,
    group_heading_row,
)
from balance_cli.report.bode_chart import bode_chart
from balance_cli.report.force_responses import (
    Band,
    ModelResponse,
    Sensor,
    band_text,
    error_band,
    lines_within,
    measured_curve,
    model_response,
    relative_error,
    relative_noise,
    sensors,
)
from balance_cli.report.frequencies import reference_model
from balance_cli.report.number_format import format_percent, join_names
from balance_cli.report.nyquist import Evaluation, nyquist_picture
from balance_cli.report.plots import Marker, rotor_markers
from balance_cli.report.response_figures import Panel, component_svg, detail_svg
from balance_cli.report.source_roles import SourceRole
from balance_cli.report.sources import Source, Sources
from balance_cli.signals.response.transfer import Transfer, response_components, response_to_component
from balance_cli.signals.run_spectrum import FrequencyResponse

RESPONSE_NOISE_FACTOR = 1.5
"""An error up to this factor times the noise counts as noise."""
MAX_RELATIVE_NOISE = 0.5
"""A channel whose relative noise is above this is not informative and printed in gray."""
CHART_ROLES = (SourceRole.COMPUTED, SourceRole.IDENTIFIED, SourceRole.UPDATED, SourceRole.PAPER, SourceRole.LS)
"""Models of the interactive chart, those that tell most first."""
PAPER_PAIRS = (("x", "Fx"), ("x", "My"), ("y1", "Fy"), ("z1", "Fz"))
"""Pairs of cell and component in figure 14 of the paper."""


@dataclass(frozen=True)
class Comparison:
    """One component: the measured response, and the responses of each model at its lines, for the sensors shown.

    `error_band` [Hz] is that of relative errors.
    """

    component: str
    geometry: Geometry
    error_band: Band
    shown_sensors: tuple[Sensor, ...]
    measured: FrequencyResponse
    models: tuple[tuple[Source[IdentifiedModel], ModelResponse], ...]


def comparisons(sources: Sources) -> tuple[Comparison, ...]:
    """Every component that was excited, at its highest level, against all models."""
    measured: dict[str, tuple[Transfer, FrequencyResponse]] = {}
    for source in sources.transfers:
        for component in response_components(source.content):
            measured.setdefault(component, (source.content, response_to_component(source.content, component)))
    models = [source.content for source in sources.models]
    result = []
    for component in sorted(measured, key=COMPONENTS.index):
        transfer, response = measured[component]
        responses = [item for source, item in measured.values() if source is transfer]
        shown_sensors = sensors(transfer.geometry, responses, models)
        predictions = tuple(_predict_responses(sources, response, shown_sensors, transfer.geometry))
        band = error_band(responses, transfer.geometry)
        result.append(Comparison(component, transfer.geometry, band, shown_sensors, response, predictions))
    return tuple(result)


def _predict_responses(
    sources: Sources, measured: FrequencyResponse, shown_sensors: tuple[Sensor, ...], geometry: Geometry
) -> Iterator[tuple[Source[IdentifiedModel], ModelResponse]]:
    for source in sources.models:
        yield source, model_response(source.content, measured.frequency, measured.rotor_speed, shown_sensors, geometry)


def section(sources: Sources) -> Section | None:
    """Pictures of all components and the table of errors; None without measured responses."""
    if not any(source.content.responses for source in sources.transfers):
        return None
    compared = comparisons(sources)
    blocks: list[PageBlock] = [Paragraph(_introduction(compared))]
    if sources.models:
        blocks += [*_bode_blocks(sources, compared), error_table(compared)]
    blocks.append(Heading("All cells and components"))
    blocks += [_component_picture(comparison) for comparison in compared]
    if sources.models:
        blocks.append(Details("Errors of each channel", (channel_table(compared),)))
    title = "Measured responses against the models" if sources.models else "Measured responses, cell by cell"
    return Section("responses", title, tuple(blocks))


def _introduction(compared: Sequence[Comparison]) -> str:
    runs = join_names([comparison.measured.run for comparison in compared])
    channels = ", ".join(f"{sensor.name} by {' + '.join(sensor.channels)}" for sensor in compared[0].shown_sensors)
    return (
        "Force in each cell, or in a sum of cells that a channel reads, per unit of hub load, from the runs of the "
        f"highest level: {runs}. Each is shown by the channel with the least noise, divided by its "
        f"declared sensitivity and dynamics ({channels}). Residual: "
        "|model minus measurement| over |measurement|; gray: one standard deviation of the measurement. A residual "
        "above the gray area is an error of the model."
    )


def _panels(comparison: Comparison) -> Iterator[Panel]:
    column = COMPONENTS.index(comparison.component)
    for sensor in comparison.shown_sensors:
        measured = measured_curve(comparison.measured, sensor, comparison.component, comparison.geometry)
        if measured is None:
            continue
        models = tuple(
            (source.label, source.plot_style, predictions.sensors[sensor.name][:, column])
            for source, predictions in comparison.models
            if sensor.name in predictions.sensors
        )
        yield Panel(sensor.name, comparison.component, measured, models)


def _component_picture(comparison: Comparison) -> Picture:
    panels = tuple(_panels(comparison))
    name = f"response-{comparison.component}"
    caption = (
        f"{comparison.component} ({comparison.measured.run}): amplitude, phase and relative residual of every cell."
    )
    return Picture(name, caption, component_svg(panels, caption))


def _bode_blocks(sources: Sources, compared: Sequence[Comparison]) -> Iterator[PageBlock]:
    """Yield the chart of all pairs.

    First, and in print, come the pairs of figure 14 of the paper where this rig has them, else the strongest cell of
    each component.
    """
    panels = {(panel.sensor, panel.component): panel for comparison in compared for panel in _panels(comparison)}
    pairs = [pair for pair in PAPER_PAIRS if pair in panels] or _strongest_pairs(panels)
    if not pairs:
        return
    by_role = [source for role in CHART_ROLES for source in sources.models if source.role is role]
    first = tuple(panels[pair] for pair in pairs)
    caption = "Fit of " + join_names([f"{sensor}/{component}" for sensor, component in pairs]) + "."
    ordered = [*first, *(panel for pair, panel in panels.items() if pair not in pairs)]
    lines = np.concatenate([comparison.measured.frequency for comparison in compared])
    markers = rotor_lines(compared[0].geometry, float(lines.min()), float(lines.max()))
    yield bode_chart(ordered, [source.label for source in by_role], markers, detail_svg(first, caption))
    best = reference_model(sources.models) or sources.models[0]
    curves = {source.label: source.plot_style for source in (best, *by_role)}
    single = {sensor.name for item in compared for sensor in item.shown_sensors if len(sensor.channels) == 1}
    shown = [panel for panel in panels.values() if panel.sensor in single]
    picture = nyquist_picture(best, shown, _evaluation(sources, compared), list(curves.items()))
    if picture is not None:
        yield picture


def _evaluation(sources: Sources, compared: Sequence[Comparison]) -> Evaluation:
    """The response of a model at any frequency, as the Nyquist plots need it."""
    models = {source.label: source.content for source in sources.models}
    by_component = {comparison.component: comparison for comparison in compared}

    def evaluate(label: str, panel: Panel, frequency: NDArray[np.float64]) -> NDArray[np.complex128] | None:
        item = by_component[panel.component]
        speed = item.measured.rotor_speed
        values = model_response(models[label], frequency, speed, item.shown_sensors, item.geometry).sensors
        column = COMPONENTS.index(panel.component)
        return values[panel.sensor][:, column] if panel.sensor in values else None

    return evaluate


def rotor_lines(geometry: Geometry, low: float, high: float) -> tuple[Marker, ...]:
    """Return the multiples of the nominal rotor speed within low to high [Hz]; empty where no rotor is declared."""
    if geometry.rotor is None:
        return ()
    return rotor_markers(geometry.rotor.speed, low, high, geometry.rotor.blades)


def _strongest_pairs(panels: dict[tuple[str, str], Panel]) -> list[tuple[str, str]]:
    pairs = []
    for component in dict.fromkeys(component for _, component in panels):
        sizes = {pair: float(np.median(np.abs(p.measured.value))) for pair, p in panels.items() if pair[1] == component}
        pairs.append(max(sizes, key=lambda pair: sizes[pair]))
    return pairs[:4]


def error_table(compared: Sequence[Comparison]) -> Table:
    """Relative error over all sensors together, components down, models across, beside the noise."""
    rows: list[Row] = []
    for comparison in compared:
        noise, errors = sensor_errors(comparison)
        cells = (
            TableCell(format_percent(error), mark="good" if error <= RESPONSE_NOISE_FACTOR * noise else "")
            for error in errors
        )
        rows.append(
            (TableCell(comparison.component, mark="name"), *cells, TableCell(format_percent(noise), mark="quiet"))
        )
    head = (
        TableCell(""),
        *(TableCell(source.label, title=source.file) for source, _ in compared[0].models),
        TableCell("noise"),
    )
    caption = (
        f"Relative error of the responses of all cells together, % (rms of model minus measurement over rms of "
        f"measurement, {band_text(compared[0].error_band)}), and the noise of the measurement. "
        "The paper's form is compared at its own sensors, a model of another geometry at those it has. "
        "Shaded: within 1.5 times the noise."
    )
    return Table(caption, (head,), tuple(rows))


def sensor_errors(comparison: Comparison) -> tuple[float, list[float]]:
    """Relative noise of the cells' measured responses, and the relative error of each model over those it tells."""
    band = lines_within(comparison.error_band, comparison.measured.frequency)
    column = COMPONENTS.index(comparison.component)
    curves = {
        s.name: measured_curve(comparison.measured, s, comparison.component, comparison.geometry)
        for s in comparison.shown_sensors
    }
    measured = {name: curve for name, curve in curves.items() if curve is not None}
    single = [
        name
        for sensor in comparison.shown_sensors
        if len(sensor.channels) == 1
        for name in [sensor.name]
        if name in measured
    ]
    noise = relative_noise(
        np.array([measured[name].sigma[band] for name in single]),
        np.array([measured[name].value[band] for name in single]),
    )
    errors = []
    for source, predictions in comparison.models:
        candidates = measured if source.content.paper else single
        known = [name for name in candidates if name in predictions.sensors]
        model = np.array([predictions.sensors[name][band, column] for name in known])
        error = relative_error(model, np.array([measured[name].value[band] for name in known]))
        errors.append(error if model.any() else float("nan"))
    return noise, errors


def channel_table(compared: Sequence[Comparison]) -> Table:
    """Channels down, components across, for each model that has channels; the noise in small print."""
    names = list(dict.fromkeys(name for comparison in compared for name in comparison.measured.channel_names))
    rows: list[Row] = []
    for m, (source, _) in enumerate(compared[0].models):
        if any(comparison.models[m][1].channels for comparison in compared):
            rows.append(group_heading_row(source.label, 1 + len(compared)))
            for name in names:
                rows.append(
                    (TableCell(name, mark="name"), *(_channel_cell(comparison, m, name) for comparison in compared))
                )
    head = (TableCell(""), *(TableCell(comparison.component) for comparison in compared))
    caption = "Relative error of each channel, %; small: noise of the measurement."
    return Table(caption, (head,), tuple(rows))


def _channel_cell(comparison: Comparison, m: int, name: str) -> TableCell:
    if name not in comparison.measured.channel_names or name not in comparison.models[m][1].channels:
        return TableCell("")
    i, j = comparison.measured.channel_names.index(name), comparison.measured.components.index(comparison.component)
    band = lines_within(comparison.error_band, comparison.measured.frequency)
    measured = comparison.measured.response[band, i, j]
    variance = comparison.measured.channel_covariance[band, i, i] * comparison.measured.load_covariance[band, j, j]
    noise = relative_noise(np.sqrt(np.real(variance)), measured)
    error = relative_error(
        comparison.models[m][1].channels[name][band, COMPONENTS.index(comparison.component)], measured
    )
    mark = "quiet" if noise > MAX_RELATIVE_NOISE else "good" if error <= RESPONSE_NOISE_FACTOR * noise else ""
    return TableCell(format_percent(error), format_percent(noise), mark)
