"""Lines for the search: few enough to try many fits, and others of the same runs to judge them by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import Batch, stack_runs
from balance_cli.signals.run_spectrum import RunSpectrum

# Lines of all sweeps together that a fit of the search takes, and at least of each run.
TARGET_LINES = 300
MIN_RUN_LINES = 20


@dataclass(frozen=True)
class SearchLines:
    """Batches that are fitted, and `folds` that judge: other lines of the same sweeps, and every static run."""

    fitted: tuple[Batch, ...]
    folds: tuple[Batch, ...]


def search_lines(spectra: Spectra, channel_names: tuple[str, ...]) -> SearchLines:
    """Every n-th line of each sweep, and those half way between, both with all static points.

    The free motion that rings in a record is left in: beside a model's error it is nothing.
    """
    runs = spectra.lines
    count = sum(len(run.frequency) for run in runs)
    stride = max(2, count // TARGET_LINES)
    strides = [max(2, min(stride, len(run.frequency) // MIN_RUN_LINES)) for run in runs]
    fitted = [_every_nth_line(run, n, i % n) for i, (run, n) in enumerate(zip(runs, strides, strict=True))]
    judged = [_every_nth_line(run, n, (i + n // 2) % n) for i, (run, n) in enumerate(zip(runs, strides, strict=True))]
    return SearchLines(_stacked(fitted, spectra, channel_names), _stacked(judged, spectra, channel_names))


def _stacked(lines: Sequence[RunSpectrum], spectra: Spectra, channel_names: tuple[str, ...]) -> tuple[Batch, ...]:
    # Of the static runs the straight part: a few lines for a hundred.
    statics = [replace(points, share=None) for points in spectra.statics]
    return stack_runs(lines, statics, channel_names)


def _every_nth_line(lines: RunSpectrum, stride: int, first: int) -> RunSpectrum:
    if len(lines.frequency) < 2 * stride:
        return replace(lines, window=None)
    every: NDArray[np.intp] = np.arange(len(lines.frequency))
    # The mean of a record stands alone.
    chosen = (every % stride == first) | (lines.frequency == 0)
    return replace(lines.select(chosen), window=None)
