"""Hub loads over the azimuth of one revolution, from their harmonics, with a band of one sigma."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.flags import NOT_MEASURED
from balance_cli.reduction.result import RunLoads
from balance_cli.report.blocks import Chart, PlotGroup
from balance_cli.report.figure_style import BLUE, GRAY
from balance_cli.report.plots import Plot, Trace

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DEGREES = np.linspace(0.0, 360.0, 181)
"""Azimuths of a curve [deg]: two degrees are a quarter of a period of the 45th harmonic."""


def waveform(amplitude: ComplexArray, mean: bool = True) -> Array:
    """Return the load at DEGREES from its complex harmonics (n+1,): Re sum of A_n exp(j n psi)."""
    orders = np.arange(len(amplitude))
    turning = np.exp(1j * np.outer(np.radians(DEGREES), orders))
    values = np.real(turning @ np.where(orders == 0, amplitude if mean else 0.0, amplitude))
    return np.asarray(values)


def waveform_sigma(run: RunLoads, m: int, mean: bool = True) -> Array:
    """Return sigma of the waveform of component m at DEGREES; harmonics are taken as independent."""
    orders = np.arange(len(run.amplitude))
    angle = np.outer(np.radians(DEGREES), orders)
    variance = (np.cos(angle) * run.sigma_cosine[:, m]) ** 2 + (np.sin(angle) * run.sigma_sine[:, m]) ** 2
    return np.asarray(np.sqrt(np.nansum(variance[:, 0 if mean else 1 :], axis=1)))


def azimuth_chart(runs: dict[str, RunLoads], label: str) -> Chart:
    """Return the loads over one revolution, a plot for each component and a choice of runs."""
    groups = tuple(PlotGroup(name, tuple(_plots(run))) for name, run in runs.items())
    caption = (
        f"Hub loads over one revolution by {label}, from the mean and all harmonics that were reduced; band: one "
        "sigma. Dashed: the mean. Azimuth 0 is at the 1/rev pulse."
    )
    return Chart("azimuth", caption, groups, "azimuth")


def _plots(run: RunLoads) -> list[Plot]:
    plots = []
    for name in [name for name in COMPONENTS if name in run.components]:
        m = run.components.index(name)
        mean = NOT_MEASURED not in run.flags[0][m] and bool(np.isfinite(run.amplitude[0, m]))
        value, sigma = waveform(run.amplitude[:, m], mean), waveform_sigma(run, m, mean)
        level = float(run.amplitude[0, m].real) if mean else 0.0
        traces = (
            Trace(name, value, BLUE, band=np.array([value - sigma, value + sigma])),
            Trace("mean", np.full(len(DEGREES), level), GRAY, (4.0, 3.0), 1.0),
        )
        title = f"{name}, {run.run}" if mean else f"{name} without its mean, {run.run}"
        plots.append(Plot(title, DEGREES, traces, "azimuth [°]", f"{name} [{UNIT_OF[name]}]"))
    return plots
