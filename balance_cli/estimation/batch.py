"""Batches: the measured lines of several runs at one rotor speed, stacked so that one call works on all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.run_spectrum import NoisePart
from balance_cli.signals.waveform_types import AnalysisWindow, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Value = TypeVar("Value")

# Batches that are worked on at once, one thread each: two cores are available nearly everywhere.
WORKERS = 2
# Lines of all batches from which threads pay. Few lines are quickly multiplied, and what is left is the interpreter,
# which runs one thread at a time: with the 300 lines of a search two threads take as long as one, and more work.
MIN_THREADED_LINES = 1000
# Bytes of one array of derivatives above which a batch is split. The C library takes larger blocks than this from the
# system for every array anew, and the system fills their pages with zeros (M_MMAP_THRESHOLD of malloc: 32 MiB at most).
MAX_DERIVATIVE_BYTES = 2**25


@dataclass(frozen=True)
class BatchLines:
    """K spectral lines, one row each: c channels and u excited load components.

    `index` (K,) is the position of the line's frequency among those of the batch, `run` (K,) its run. `channels` (K, c)
    [V] and `loads` (K, u) are measured, `components` (K, u) tells which of the six the loads are. `constant_volts` (K,)
    and `constant_loads` (K, u) are the changes of the line per unit offset, as in `RunSpectrum`.

    `precision` (K, c+u, c+u) is the inverse covariance of [channels, loads], zero where a channel is not live; `count`
    (K,) the real degrees of freedom of the line. `efficiency` (K,) is the share of the information that weights from an
    estimated covariance keep. The precision contains it as a factor, so that the information gives the scatter of the
    estimate; chi-square against the noise is that of the precision divided by it.
    """

    index: Index
    run: Index
    channels: ComplexArray
    loads: ComplexArray
    components: Index
    constant_volts: Array
    constant_loads: Array
    precision: ComplexArray
    count: Array
    efficiency: Array

    def select(self, mask: Mask | slice) -> BatchLines:
        """The lines in the mask; a slice makes no copies."""
        return BatchLines(**{item.name: getattr(self, item.name)[mask] for item in fields(self)})

    @property
    def channel_precision(self) -> Array:
        """Diagonal (K, c) of the channels' precision [1/V2]; zero where a channel is not live."""
        c = self.channels.shape[1]
        return np.real(np.diagonal(self.precision[:, :c, :c], axis1=1, axis2=2))


@dataclass(frozen=True)
class BatchRun:
    """One run of a batch: its name, its `lines`, and what is known of it besides these.

    `window`: the samples that a periodic record's lines come from; None where they hold no transient. `waveform`: the
    channels through time, None where no effect needs them. `noise_dof`: real degrees of freedom with which its noise is
    known; `noise_parts`: the parts of the noise, where they are not known equally well. All channels in their order.
    """

    name: str
    lines: slice
    window: AnalysisWindow | None
    waveform: Waveform | None
    noise_dof: float
    noise_parts: tuple[NoisePart, ...]

    def select(self, mask: Mask, start: int) -> BatchRun:
        """The run with the lines in the mask (k,), the first of which becomes line `start`."""
        lines = slice(start, start + int(np.count_nonzero(mask)))
        parts = tuple(part.select(mask) for part in self.noise_parts)
        if not mask.any():
            return replace(self, lines=lines, window=None, waveform=None, noise_parts=parts)
        window = None if self.window is None else self.window.select(mask)
        waveform = None if self.waveform is None else self.waveform.select(mask)
        return replace(self, lines=lines, window=window, waveform=waveform, noise_parts=parts)


@dataclass(frozen=True)
class Batch:
    """Lines of one rotor speed `spin` [Hz], all with the same number of excited components and the same kind of weight.

    `frequency` (f,) [Hz] are the distinct ones. `has_exact_loads`: the loads carry no noise of their own. `is_static`:
    the lines are those of static runs, whose loads no exciter applied. The lines of a run are consecutive.
    """

    spin: float
    frequency: Array
    has_exact_loads: bool
    is_static: bool
    lines: BatchLines
    runs: tuple[BatchRun, ...]

    @property
    def run_names(self) -> tuple[str, ...]:
        """The names of the runs, in order."""
        return tuple(run.name for run in self.runs)

    @property
    def parts(self) -> tuple[slice, ...]:
        """The lines of each run."""
        return tuple(run.lines for run in self.runs)

    @property
    def line_frequency(self) -> Array:
        """Frequency (K,) [Hz] of each line."""
        return self.frequency[self.lines.index]


def map_batches(
    function: Callable[..., Value], batches: Sequence[Batch], *of_batches: Sequence[object]
) -> Iterator[Value]:
    """The function of each batch, and what belongs to it, in order; where there are many lines on several threads."""
    if sum(len(batch.lines.index) for batch in batches) < MIN_THREADED_LINES:
        yield from map(function, batches, *of_batches)
        return
    with ThreadPoolExecutor(WORKERS) as workers:
        # Threads suffice, because numpy releases the interpreter lock.
        yield from workers.map(function, batches, *of_batches)


def select_lines(batch: Batch, mask: Mask) -> Batch:
    """The batch with the lines in the mask (K,) only; a run without any keeps its name."""
    starts = np.cumsum([0, *(np.count_nonzero(mask[part]) for part in batch.parts)])
    runs = tuple(run.select(mask[run.lines], int(start)) for run, start in zip(batch.runs, starts, strict=False))
    return replace(batch, lines=batch.lines.select(mask), runs=runs)


def split_by_run(batches: Sequence[Batch]) -> tuple[Batch, ...]:
    """Each run as a batch of its own, for smaller arrays where there are many derivatives."""
    return tuple(_batch_of_run(batch, run) for batch in batches for run in batch.runs)


def split_large_batches(batches: Sequence[Batch], parameters: int) -> tuple[Batch, ...]:
    """The batches; those whose derivatives by this many parameters exceed `MAX_DERIVATIVE_BYTES` split by run."""
    sizes = [batch.lines.channels.nbytes * parameters for batch in batches]
    return tuple(
        part
        for batch, size in zip(batches, sizes, strict=True)
        for part in ([batch] if size <= MAX_DERIVATIVE_BYTES else split_by_run([batch]))
    )


def _batch_of_run(batch: Batch, run: BatchRun) -> Batch:
    lines = batch.lines.select(run.lines)
    frequency, index = np.unique(batch.frequency[lines.index], return_inverse=True)
    index = index.reshape(-1)
    alone = replace(run, lines=slice(0, len(index)))
    return replace(
        batch, frequency=frequency, lines=replace(lines, index=index, run=np.zeros_like(index)), runs=(alone,)
    )
