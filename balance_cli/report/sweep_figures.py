"""Pictures of the measured responses: coherence, and the ratio of the two channels of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.paper.spectra import channel_response
from balance_cli.report.figure_style import (
    BLACK,
    BLUE,
    EXTRA_COLORS,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
)
from balance_cli.report.force_responses import best_channel, excitation_level, quotient
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]

DECLARED_STYLE: dict[str, Any] = {"color": BLACK, "linestyle": "--", "zorder": 5}
CELL_COLORS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, GRAY, *EXTRA_COLORS)


def coherence_figure(responses: Sequence[FrequencyResponse]) -> Figure:
    """One panel per component: 1 - coherence over frequency, the highest level as a thick line."""
    names = [name for name in COMPONENTS if any(name in response.components for response in responses)]
    columns = min(len(names), 6)
    figure = new_figure(12.0, 2.1 * -(-len(names) // columns))
    panels = figure.subplots(-(-len(names) // columns), columns, squeeze=False, sharex=True, sharey=True)
    highest = max(float(response.frequency[-1]) for response in responses)
    for axes, name in zip(panels.ravel(), names, strict=False):
        component_responses = [response for response in responses if name in response.components]
        strongest = max(excitation_level(response) for response in component_responses)
        for response in component_responses:
            thick = excitation_level(response) == strongest
            missing = np.maximum(1.0 - best_channel(response)[0], 1e-9)
            plot_style = {"color": BLUE, "linewidth": 1.0} if thick else {"color": SKY, "linewidth": 0.6}
            axes.semilogy(response.frequency, missing, rasterized=True, zorder=3 if thick else 2, **plot_style)
        axes.set_title(name)
        axes.set_xlim(0, highest)
        axes.xaxis.set_major_locator(MaxNLocator(3, prune="upper"))
        axes.set_xlabel("frequency [Hz]")
    panels[0, 0].set_ylim(1e-8, 1.5)
    panels[0, 0].set_yticks([1e-8, 1e-6, 1e-4, 1e-2, 1], ["1e-8", "1e-6", "1e-4", "0.01", "1"])
    panels[0, 0].set_ylabel("1 - coherence")
    figure.subplots_adjust(left=0.055, right=0.995, top=0.9, bottom=0.2, wspace=0.07)
    return figure


def cell_channel_pairs(
    cell_of: dict[str, str | None], responses: Sequence[FrequencyResponse]
) -> dict[str, tuple[str, str]]:
    """{cell: its two channels, the later declared one first}, where every response has both."""
    present = set.intersection(*(set(response.channel_names) for response in responses))
    pairs: dict[str, tuple[str, str]] = {}
    for cell in dict.fromkeys(cell for cell in cell_of.values() if cell):
        channels = [name for name, of_cell in cell_of.items() if of_cell == cell and name in present]
        if len(channels) == 2:
            pairs[cell] = (channels[1], channels[0])
    return pairs


def cell_channel_ratio(
    pair: tuple[str, str], responses: Sequence[FrequencyResponse], sensitivity: dict[str, float]
) -> tuple[Array, NDArray[np.complex128]]:
    """Ratio of the two channels of a cell as forces, at each line from the response with the least relative noise."""
    best: dict[float, tuple[float, complex]] = {}
    for response in responses:
        a, b = (response.channel_names.index(name) for name in pair)
        T = response.response[:, [a, b], 0] / np.array([sensitivity[name] for name in pair])
        ratios = quotient(T[:, 0], T[:, 1])
        variance = np.real(response.channel_covariance[:, [a, b], [a, b]] * response.load_covariance[:, :1, 0])
        quality = np.min(quotient(np.abs(response.response[:, [a, b], 0]), np.sqrt(variance)), axis=1)
        for frequency, signal_to_noise, ratio in zip(response.frequency, quality, ratios, strict=True):
            if signal_to_noise > best.get(float(frequency), (0.0, 0j))[0]:
                best[float(frequency)] = (float(signal_to_noise), complex(ratio))
    frequencies = sorted(best)
    return np.array(frequencies), np.array([best[f][1] for f in frequencies])


def ratio_figure(
    pairs: dict[str, tuple[str, str]], responses: Sequence[FrequencyResponse], geometry: Geometry
) -> Figure:
    """Amplitude and phase of the ratio for every cell, and the ratio of the declared dynamics of the channels."""
    figure = new_figure(12.0, 2.7)
    left, right = figure.subplots(1, 2)
    declared = {channel.name: channel for channel in geometry.channels}
    sensitivity = {name: channel.sensitivity for name, channel in declared.items()}
    for i, pair in enumerate(pairs.values()):
        frequency, ratio = cell_channel_ratio(pair, responses, sensitivity)
        gains = [channel_response(declared[name], frequency) / sensitivity[name] for name in pair]
        curves = ((ratio, {"color": CELL_COLORS[i % len(CELL_COLORS)]}), (gains[0] / gains[1], DECLARED_STYLE))
        for value, plot_style in curves:
            left.plot(frequency, np.abs(value), linewidth=0.9, rasterized=True, **plot_style)
            right.plot(frequency, np.degrees(np.angle(value)), linewidth=0.9, rasterized=True, **plot_style)
    left.set_title("amplitude")
    right.set_title("phase [°]")
    for axes in (left, right):
        axes.set_xlim(0, max(float(response.frequency[-1]) for response in responses))
        axes.set_xlabel("frequency [Hz]")
    handles = [Line2D([], [], color=CELL_COLORS[i % len(CELL_COLORS)]) for i in range(len(pairs))]
    handles.append(Line2D([], [], linewidth=0.9, **DECLARED_STYLE))
    figure.legend(handles, [*pairs, "as declared"], loc="lower center", ncols=len(handles))
    figure.subplots_adjust(left=0.04, right=0.985, top=0.9, bottom=0.28, wspace=0.1)
    return figure
