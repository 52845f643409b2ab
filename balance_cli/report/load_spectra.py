"""Section of spectral densities of hub loads: records without rotor pulses, such as those of a machine tool."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.reduction.spectra_result import DENSITY_UNITS, LoadSpectra, RunSpectra
from balance_cli.report.blocks import Chart, PageBlock, Paragraph, PlotGroup, Section, Table, TableCell
from balance_cli.report.figure_style import BLUE, GRAY
from balance_cli.report.number_format import format_significant, join_names
from balance_cli.report.plots import Plot, Trace
from balance_cli.report.sources import Source, Sources

MOST_RUNS = 12
"""Runs that are drawn: each adds about 100 kB to the page."""
LINES = 1200
"""Frequencies of a curve; of a finer one the largest of neighbors is drawn, so that no peak is lost."""
ONE_SIGMA = np.array([[-1.0], [1.0]])


def section(sources: Sources) -> Section | None:
    """Return the spectra of all runs; None without any."""
    runs = [(source, run) for source in sources.spectra for run in source.content.runs.values()]
    if not runs:
        return None
    return Section("load-spectra", "Spectra of hub loads", tuple(_blocks(runs)))


def _blocks(runs: Sequence[tuple[Source[LoadSpectra], RunSpectra]]) -> Iterator[PageBlock]:
    yield _table([run for _, run in runs])
    several = len({source.label for source, _ in runs}) > 1
    groups = tuple(
        PlotGroup(f"{run.run}, {source.label}" if several else run.run, tuple(_plots(run)))
        for source, run in runs[:MOST_RUNS]
    )
    caption = "One-sided spectral density of each hub load, with one sigma as a band. Gray: noise of the channels."
    yield Chart("load-spectra", caption, groups, "load-spectra")
    if len(runs) > MOST_RUNS:
        yield Paragraph(f"Not drawn: {join_names([run.run for _, run in runs[MOST_RUNS:]])}.")


def _table(runs: Sequence[RunSpectra]) -> Table:
    """Return the rms of each load within the band, its sigma, the frequency of its peak, and the trust in a run."""
    names = list(dict.fromkeys(name for run in runs for name in run.components))
    head = tuple(
        TableCell(text) for text in ("run", "band [Hz]", *(f"{name} [{UNIT_OF[name]}]" for name in names), "trust")
    )
    rows = []
    for run in runs:
        rms, peaks = run.band_rms, run.peak_hz
        cells = [
            TableCell(format_significant(rms[name][0], 4), f"± {rms[name][1]:.2g}; peak at {peaks[name]:.4g} Hz")
            if name in rms
            else TableCell("")
            for name in names
        ]
        band = f"{run.frequency_hz[0]:.4g} to {run.frequency_hz[-1]:.4g}"
        rows.append((TableCell(run.run, mark="name"), TableCell(band), *cells, TableCell(run.trust)))
    return Table("Root mean square of the hub loads within the band, noise included.", (head,), tuple(rows))


def _plots(run: RunSpectra) -> Iterator[Plot]:
    size = -(-len(run.frequency_hz) // LINES)
    starts = np.arange(len(run.frequency_hz) // size) * size
    for i, name in enumerate(run.components):
        # The largest of neighbors, with the sigma and the noise that belong to it.
        parts = run.density[: len(starts) * size, i].reshape(len(starts), size)
        at = starts + np.argmax(parts, axis=1)
        density, sigma = run.density[at, i], run.sigma[at, i]
        band = np.maximum(density + ONE_SIGMA * sigma, density / 10.0)
        traces = (
            Trace("load", density, BLUE, width=1.0, band=band, compact=True),
            Trace("noise", np.maximum(run.noise[at, i], density.min() * 1e-3), GRAY, width=1.0, compact=True),
        )
        unit = DENSITY_UNITS[UNIT_OF[name]]
        yield Plot(name, run.frequency_hz[at], traces, "frequency [Hz]", f"density [{unit}]", True)
