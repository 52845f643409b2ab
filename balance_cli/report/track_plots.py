"""Plots of loads in time: means and amplitudes from revolution to revolution, with sigma."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.kalman.load_history import LoadTrack
from balance_cli.reduction.result import RunLoads
from balance_cli.report.figure_style import (
    BLACK,
    BLUE,
    EXTRA_COLORS,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
)
from balance_cli.report.number_format import format_significant
from balance_cli.report.plots import Marker, Plot, Trace

Array = NDArray[np.float64]

HARMONICS_SHOWN = 3
"""Harmonics drawn of each component."""
HARMONIC_COLORS = (BLUE, ORANGE, GREEN, VERMILION, SKY, PURPLE, *EXTRA_COLORS)
TIME_LABEL = "time [s]"


def strongest_harmonics(track: LoadTrack, component: int) -> tuple[int, ...]:
    """Return the harmonics of a component (its column) with the largest mean square amplitude, in rising order."""
    power = np.nan_to_num(np.nanmean(np.abs(track.amplitude[:, 1:, component]) ** 2, axis=0))
    return tuple(sorted(int(n) + 1 for n in np.argsort(-power, kind="stable")[:HARMONICS_SHOWN]))


def track_plots(run: RunLoads, track: LoadTrack) -> tuple[Plot, ...]:
    """Return two plots for each component: means of revolutions, and changes of its strongest harmonics.

    A change is an amplitude less its mean over the steady part, which the legend states.
    """
    plots: list[Plot] = []
    markers = tuple(Marker(edge, "") for edge in run.interval)
    for name in [name for name in COMPONENTS if name in run.components]:
        m = run.components.index(name)
        unit = UNIT_OF[name]
        mean = _banded("mean", track.amplitude[:, 0, m].real, track.sigma[:, 0, m], BLACK)
        plots.append(Plot(f"{name}, mean", track.time, (mean,), TIME_LABEL, f"{name} [{unit}]", markers=markers))
        changes = tuple(_change(run, track, m, n) for n in strongest_harmonics(track, m))
        label = f"change of {name} [{unit}]"
        plots.append(Plot(f"{name}, harmonics", track.time, changes, TIME_LABEL, label, markers=markers))
    return tuple(plots)


def _change(run: RunLoads, track: LoadTrack, m: int, n: int) -> Trace:
    inside = (track.time >= run.interval[0]) & (track.time <= run.interval[1])
    amplitude = np.abs(track.amplitude[:, n, m])
    mean = float(np.nanmean(amplitude[inside]))
    return _banded(f"{n}/rev, {format_significant(mean)}", amplitude - mean, track.sigma[:, n, m], harmonic_color(n))


def _banded(label: str, y: Array, sigma: Array, color: str) -> Trace:
    return Trace(label, y, color, width=1.0, band=np.array([y - sigma, y + sigma]), compact=True)


def harmonic_color(n: int) -> str:
    """The color of a harmonic wherever it is drawn."""
    return HARMONIC_COLORS[(n - 1) % len(HARMONIC_COLORS)]
