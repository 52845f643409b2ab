"""Section of the runs themselves: channels over time and their spectra, with the multiples of the rotor speed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.report.blocks import Chart, PageBlock, Paragraph, PlotGroup, Section
from balance_cli.report.figure_style import BLUE
from balance_cli.report.number_format import join_names
from balance_cli.report.plots import Marker, Plot, Trace, rotor_markers
from balance_cli.report.sources import Sources
from balance_cli.signals.amplitude_spectrum import amplitude_spectrum
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]

MOST_RUNS = 12
"""Runs whose channels are drawn: each adds about 100 kB to the page."""
BINS = 400
"""Bins of a record: minimum, mean and maximum of each."""
REVOLUTIONS = 4
"""Revolutions of the excerpt in which every sample is drawn."""
LINES = 1200
"""Lines of a spectrum; of a finer one the largest of neighboring lines is drawn, so that no peak is lost."""
MOST_MARKERS = 40
"""Harmonics of the rotor that are marked: more of them hide the spectrum."""
CHANNEL_HEIGHT = 130
"""Height [px] of the plot of one channel."""


def section(sources: Sources) -> Section | None:
    """Return channels and spectra of the runs that were given; None without any."""
    runs = [run for run in sources.runs if run.sample_rate and run.samples > 1]
    if not runs:
        return None
    rotors = [geometry.rotor for geometry in sources.geometries if geometry.rotor]
    return Section("runs", "Runs as recorded", tuple(_blocks(runs, rotors[0].blades if rotors else 0)))


def _blocks(runs: Sequence[Run], blades: int) -> Iterator[PageBlock]:
    shown = runs[:MOST_RUNS]
    yield Chart(
        "run-spectra",
        "Amplitude spectra of the channels (Hann window, a sine of amplitude A gives a line of height A). Dashed: "
        "multiples of the rotor speed of the run.",
        tuple(PlotGroup(run.name, tuple(_spectrum_plots(run, blades))) for run in shown),
        "run-frequency",
    )
    yield Chart(
        "run-time",
        f"Channels over the whole record: mean, with minimum and maximum of each of {BINS} parts as a band.",
        tuple(PlotGroup(run.name, tuple(_record_plots(run))) for run in shown),
        "run-time",
    )
    turning = [run for run in shown if _rotor_speed(run) > 0]
    if turning:
        caption = f"Every sample of {REVOLUTIONS} revolutions in the middle of the record. Dashed: pulses."
        groups = tuple(PlotGroup(run.name, tuple(_excerpt_plots(run))) for run in turning)
        yield Chart("run-revolutions", caption, groups, "run-revolutions")
    if len(runs) > MOST_RUNS:
        yield Paragraph(f"Not drawn: {join_names([run.name for run in runs[MOST_RUNS:]])}.")


def _rotor_speed(run: Run) -> float:
    """Return the mean speed between the pulses [Hz], that of the file where there are none."""
    if run.pulse_times is not None and len(run.pulse_times) > 1:
        return float((len(run.pulse_times) - 1) / (run.pulse_times[-1] - run.pulse_times[0]))
    return run.rotor_speed


def _spectrum_plots(run: Run, blades: int) -> Iterator[Plot]:
    frequency, amplitude = amplitude_spectrum(run.read().channels, sample_rate(run))
    size = -(-len(frequency) // LINES)
    count = len(frequency) // size
    lines = amplitude[: count * size].reshape(count, size, -1).max(axis=1)[1:]
    x = frequency[: count * size].reshape(count, size).mean(axis=1)[1:]
    speed = _rotor_speed(run)
    markers = rotor_markers(speed, speed, min(float(x[-1]), MOST_MARKERS * speed), blades, MOST_MARKERS)
    for i, name in enumerate(run.channel_names):
        trace = Trace(name, lines[:, i], BLUE, width=1.0, compact=True)
        yield Plot(name, x, (trace,), "frequency [Hz]", "amplitude [V]", True, markers, height=CHANNEL_HEIGHT)


def _record_plots(run: Run) -> Iterator[Plot]:
    samples = run.read().channels
    edges = np.linspace(0, len(samples), min(BINS, len(samples)) + 1).astype(int)[:-1]
    count = np.diff(np.append(edges, len(samples)))[:, None]
    mean = np.add.reduceat(samples, edges) / count
    low, high = np.minimum.reduceat(samples, edges), np.maximum.reduceat(samples, edges)
    x = (edges + 0.5 * count[:, 0]) / sample_rate(run)
    for i, name in enumerate(run.channel_names):
        band = np.array([low[:, i], high[:, i]])
        trace = Trace(name, mean[:, i], BLUE, width=1.0, band=band, compact=True)
        yield Plot(name, x, (trace,), "time [s]", "reading [V]", height=CHANNEL_HEIGHT)


def _excerpt_plots(run: Run) -> Iterator[Plot]:
    length = int(REVOLUTIONS / _rotor_speed(run) * sample_rate(run)) + 2
    start = max(0, (run.samples - length) // 2)
    samples = run.read(start, start + length).channels
    x = (start + np.arange(len(samples))) / sample_rate(run)
    pulses = run.pulse_times if run.pulse_times is not None else np.zeros(0)
    markers = tuple(Marker(float(pulse), "") for pulse in pulses if x[0] <= pulse <= x[-1])
    for i, name in enumerate(run.channel_names):
        trace = Trace(name, samples[:, i], BLUE, width=1.0, compact=True)
        yield Plot(name, x, (trace,), "time [s]", "reading [V]", markers=markers, height=CHANNEL_HEIGHT)
