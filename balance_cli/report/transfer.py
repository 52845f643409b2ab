"""The measured responses: runs and levels, coherence, sigma, and dependence on the level of excitation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.report.blocks import (
    PageBlock,
    Paragraph,
    Picture,
    Row,
    Section,
    Table,
    TableCell,
    WarningText,
    plain_row,
)
from balance_cli.report.figure_style import svg
from balance_cli.report.force_responses import (
    Band,
    band_text,
    best_channel,
    error_band,
    excitation_level,
    force_response,
    lines_within,
    relative_error,
    relative_noise,
)
from balance_cli.report.number_format import format_percent, format_significant, join_names
from balance_cli.report.sources import Source, Sources
from balance_cli.report.sweep_figures import cell_channel_pairs, coherence_figure, ratio_figure
from balance_cli.signals.response.transfer import Transfer, select_component
from balance_cli.signals.run_spectrum import FrequencyResponse

LEVEL_NOISE_FACTOR = 1.5
"""A difference between levels above this factor times the noise is marked."""
RUN_HEADER = (
    "run",
    "excited",
    "level rms",
    "rotor Hz",
    "lines",
    "Hz",
    "steady part",
    "lowest coherence",
    "sigma %",
    "estimator",
)


def section(sources: Sources) -> Section | None:
    """Tables and pictures of all measured responses; None without any."""
    transfer_sources = [source for source in sources.transfers if source.content.responses]
    blocks = [block for source in transfer_sources for block in _transfer_blocks(source, len(transfer_sources) > 1)]
    return Section("sweeps", "Measured responses: coherence and noise", tuple(blocks)) if blocks else None


def _transfer_blocks(source: Source[Transfer], several: bool) -> Iterator[PageBlock]:
    transfer, suffix = source.content, f" ({source.file})" if several else ""
    component_responses = [
        select_component(response, name) for response in transfer.responses for name in response.components
    ]
    for run, channels in transfer.channels_left_out.items():
        for channel, reason in channels.items():
            yield WarningText(f"Run {run}, channel {channel} left out: {reason}.")
    for run, part in transfer.steady_parts.items():
        if not part.steady:
            yield WarningText(f"Run {run} did not pass the test of steadiness before its last two periods.")
    if transfer.unused_runs:
        yield Paragraph(f"Not used: {join_names(list(transfer.unused_runs))}.")
    yield run_table(transfer)
    name = f"coherence-{source.file}" if several else "coherence"
    caption = f"1 - coherence of the best-responding channel at each line; light: lower levels{suffix}."
    yield Picture(name, caption, svg(name, caption, lambda: coherence_figure(component_responses)))
    table = level_table(source, component_responses)
    if table.rows:
        yield table
    yield from _ratio_pictures(source, component_responses, several, suffix)


def _ratio_pictures(
    source: Source[Transfer], component_responses: Sequence[FrequencyResponse], several: bool, suffix: str
) -> Iterator[PageBlock]:
    geometry = source.content.geometry
    pairs = cell_channel_pairs({channel.name: channel.cell for channel in geometry.channels}, component_responses)
    if pairs:
        name = f"channel-ratio-{source.file}" if several else "channel-ratio"
        caption = (
            "Piezo over strain channel of each cell, as forces: at each line from the response with the least noise, "
            f"without a model of the plate (figure 4 of the paper). Dashed: declared dynamics{suffix}."
        )
        yield Picture(name, caption, svg(name, caption, lambda: ratio_figure(pairs, component_responses, geometry)))


def run_table(transfer: Transfer) -> Table:
    """One row per run and component: level of excitation, lines, steady part, coherence, sigma, estimator."""
    limits = error_band(transfer.responses, transfer.geometry)
    caption = (
        "Runs. Lowest coherence and median relative sigma of the best-responding channel of each line, "
        f"{band_text(limits)}. "
        "Steady part: the part of a periodic record that was used; small: its first period, line by line."
    )
    rows = [
        _run_row(transfer, select_component(r, name), r, limits) for r in transfer.responses for name in r.components
    ]
    return Table(caption, (plain_row(*RUN_HEADER),), tuple(rows))


def _run_row(transfer: Transfer, response: FrequencyResponse, full_response: FrequencyResponse, limits: Band) -> Row:
    coherence, sigma = best_channel(response)
    band, component = lines_within(limits, response.frequency), response.components[0]
    return (
        TableCell(response.run, mark="name"),
        TableCell(component),
        TableCell(f"{format_significant(response.level[0])} {UNIT_OF[component]}"),
        TableCell(format_significant(response.rotor_speed)),
        TableCell(str(len(response.frequency))),
        TableCell(
            f"{format_significant(float(response.frequency[0]))} to "
            f"{format_significant(float(response.frequency[-1]), 4)}"
        ),
        _steady_cell(transfer, full_response.run),
        TableCell(f"{coherence[band].min():.6f}" if band.any() else ""),
        TableCell(format_percent(float(np.median(sigma[band]))) if band.any() else ""),
        TableCell(response.estimator),
    )


def _steady_cell(transfer: Transfer, run: str) -> TableCell:
    """The steady part of a run; for runs that were solved together (`a+b`), of the first one."""
    part = transfer.steady_parts.get(run) or transfer.steady_parts.get(run.partition("+")[0])
    if part is None:
        return TableCell("")
    earliest = f"{part.first + 1}" if part.first == part.last else f"{part.first + 1} to {part.last + 1}"
    return TableCell(
        f"{format_significant(part.start, 4)} to {format_significant(part.stop, 4)} s",
        f"period {earliest} of {part.periods}",
    )


def level_table(source: Source[Transfer], component_responses: Sequence[FrequencyResponse]) -> Table:
    """Compare the response at lower levels with that at the highest, for each component, over all channels."""
    rows = []
    limits = error_band(component_responses, source.content.geometry)
    for component in COMPONENTS:
        by_level = sorted(
            (r for r in component_responses if component in r.components), key=excitation_level, reverse=True
        )
        for low in by_level[1:]:
            high = by_level[0]
            if np.array_equal(high.frequency, low.frequency) and high.channel_names == low.channel_names:
                rows.append(_level_row(source, component, high, low, limits))
    caption = (
        "Dependence of the response on the level: relative difference of two runs over all channels, "
        f"{band_text(limits)}, and the noise of both. Marked: more than {LEVEL_NOISE_FACTOR} times the noise."
    )
    head = plain_row("component", "levels rms", "runs", "difference %", "noise %")
    return Table(caption, (head,), tuple(rows))


def _level_row(
    source: Source[Transfer], component: str, high: FrequencyResponse, low: FrequencyResponse, limits: Band
) -> Row:
    band, geometry = lines_within(limits, high.frequency), source.content.geometry
    high_value, high_sigma = force_response(high, geometry)
    low_value, low_sigma = force_response(low, geometry)
    difference = relative_error(low_value[band], high_value[band])
    noise = relative_noise(np.hypot(high_sigma, low_sigma)[band], high_value[band])
    levels = " and ".join(format_significant(excitation_level(response)) for response in (low, high))
    return (
        TableCell(component, mark="name"),
        TableCell(f"{levels} {UNIT_OF[component]}"),
        TableCell(f"{low.run} and {high.run}"),
        TableCell(format_percent(difference), mark="bad" if difference > LEVEL_NOISE_FACTOR * noise else ""),
        TableCell(format_percent(noise), mark="quiet"),
    )
