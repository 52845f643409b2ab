"""Spectral lines for the search: few, so that many candidates can be fitted, and others to validate the fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.fit_settings import FitSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.signals.run_spectrum import RunSpectrum


@dataclass(frozen=True)
class SearchLines:
    """Batches that are `fitted`, and others for `validation`: other lines of the same sweeps, and every static run."""

    fitted: tuple[Batch, ...]
    validation: tuple[Batch, ...]


def search_lines(spectra: Spectra, channel_names: tuple[str, ...], settings: FitSettings) -> SearchLines:
    """Return every n-th line of each sweep, and those half way between, both with all static points.

    The transient of a record is not removed: it is small compared with the model error.
    """
    runs = spectra.lines
    count = sum(len(run.frequency) for run in runs)
    stride = max(2, count // settings.target_lines)
    strides = [max(2, min(stride, len(run.frequency) // settings.min_run_lines)) for run in runs]
    fitted = [_every_nth_line(run, n, i % n) for i, (run, n) in enumerate(zip(runs, strides, strict=True))]
    validation = [
        _every_nth_line(run, n, (i + n // 2) % n) for i, (run, n) in enumerate(zip(runs, strides, strict=True))
    ]
    return SearchLines(_stack(fitted, spectra, channel_names), _stack(validation, spectra, channel_names))


def _stack(lines: Sequence[RunSpectrum], spectra: Spectra, channel_names: tuple[str, ...]) -> tuple[Batch, ...]:
    # Of the static runs only the linear part: it replaces a hundred points by a few lines.
    statics = [replace(points, share=None) for points in spectra.statics]
    return stack_runs(lines, statics, channel_names)


def _every_nth_line(lines: RunSpectrum, stride: int, first: int) -> RunSpectrum:
    if len(lines.frequency) < 2 * stride:
        return replace(lines, window=None)
    index: NDArray[np.intp] = np.arange(len(lines.frequency))
    # The mean of a record has no neighbor that could stand for it.
    selected = (index % stride == first) | (lines.frequency == 0)
    return replace(lines.select(selected), window=None)
