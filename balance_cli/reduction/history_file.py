"""Load histories: hub loads of a run over time with sigma, and the HDF5 file to which they are written in blocks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS, UNITS
from balance_cli.io.formats import HISTORY_FORMAT
from balance_cli.reduction.kalman.load_history import LoadHistory, LoadTrack
from balance_cli.reduction.result import RunLoads
from balance_cli.signals.rotor.azimuth import Azimuth, azimuth_from_pulses

Array = NDArray[np.float64]

HISTORY_CHUNK_ROWS = 8192
"""Rows that are held in memory before they are written, and of a chunk of the file: 400 KB of one table."""


# ---- of harmonics ----------------------------------------------------------------------------------------------------


def harmonic_history(run: Run, loads: RunLoads) -> Iterator[LoadHistory]:
    """Yield the sum of the harmonics of a run at the azimuth of each sample, over the interval that was used."""
    assert run.sample_rate is not None and run.pulse_times is not None
    azimuth = azimuth_from_pulses(run.pulse_times)
    # Rounding may move these by one sample; the times themselves are compared below.
    first, stop = (int(t * run.sample_rate) for t in loads.interval)
    for start in range(max(first - 1, 0), min(stop + 2, run.samples), HISTORY_CHUNK_ROWS):
        time = np.arange(start, min(start + HISTORY_CHUNK_ROWS, stop + 2, run.samples)) / run.sample_rate
        time = time[(time >= loads.interval[0]) & (time < loads.interval[1])]
        if len(time):
            yield _sum_harmonics(azimuth, loads, time)


def _sum_harmonics(azimuth: Azimuth, loads: RunLoads, time: Array) -> LoadHistory:
    """Return the sum of the harmonics at times (n,) [s]."""
    phasors = np.exp(1j * azimuth.psi(time)[:, None] * np.arange(len(loads.frequency_hz)))
    columns = [COMPONENTS.index(name) for name in loads.components]
    values, sigma = np.full((2, len(time), 6), np.nan)
    # A mean that is not measured is NaN: the history is then the deviation from it.
    values[:, columns] = np.real(phasors @ np.nan_to_num(loads.amplitude))
    sigma_cosine = np.nan_to_num(loads.sigma_cosine)
    variance = phasors.real**2 @ sigma_cosine**2 + phasors.imag**2 @ loads.sigma_sine**2
    sigma[:, columns] = np.sqrt(variance)
    return LoadHistory(loads.run, time, values, sigma)


# ---- the file --------------------------------------------------------------------------------------------------------


class HistoryFile:
    """An HDF5 file of `time` (n,), `loads` (n, 6) and `sigma` (n, 6), to which blocks are appended.

    Without `has_mean` the loads count from a mean that was not measured, and the attribute `mean` says so. A context
    manager closes it. Raises UserError where it cannot be written.
    """

    def __init__(self, path: Path, run: str, has_mean: bool = True) -> None:
        from balance_cli.io.hdf5_output import Hdf5Output

        self._output, self._buffer = Hdf5Output(path), _WriteBuffer()
        self._file = self._output.file
        self._file.attrs["format"] = HISTORY_FORMAT
        self._file.attrs["run"] = run
        if not has_mean:
            self._file.attrs["mean"] = "not measured"
        self._create_appendable("time", ()).attrs["unit"] = "s"
        for name in ("loads", "sigma"):
            table = self._create_appendable(name, (len(COMPONENTS),))
            table.attrs["names"] = COMPONENTS
            table.attrs["units"] = UNITS

    def _create_appendable(self, name: str, row: tuple[int, ...]) -> Any:
        """Create an empty dataset to which rows can be appended."""
        return self._file.create_dataset(
            name, (0, *row), maxshape=(None, *row), chunks=(HISTORY_CHUNK_ROWS, *row), dtype="f8", compression="gzip"
        )

    def __enter__(self) -> HistoryFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._append(self._buffer.drain())
        finally:
            self._output.close(report=error is None)

    def add(self, block: LoadHistory) -> None:
        """Append a block; short blocks are collected before they are written."""
        self._buffer.add(block)
        if self._buffer.rows >= HISTORY_CHUNK_ROWS:
            self._append(self._buffer.drain())
            self._output.check()

    def _append(self, rows: dict[str, Array]) -> None:
        for name, values in rows.items():
            dataset = self._file[name]
            before = len(dataset)
            dataset.resize(before + len(values), axis=0)
            dataset[before:] = values

    def add_harmonics(self, track: LoadTrack, components: tuple[str, ...]) -> None:
        """Write the group `harmonics`: `time` (r,), `cosine`, `sine`, `sigma` (r, n+1, 6), NaN if not carried."""
        columns = [COMPONENTS.index(name) for name in components]
        parts = {"cosine": track.amplitude.real, "sine": -track.amplitude.imag, "sigma": track.sigma}
        group = self._file.create_group("harmonics")
        group.create_dataset("time", data=track.time).attrs["unit"] = "s"
        for name, values in parts.items():
            table = np.full((*values.shape[:2], len(COMPONENTS)), np.nan)
            table[:, :, columns] = values
            dataset = group.create_dataset(name, data=table, compression="gzip")
            dataset.attrs["names"] = COMPONENTS
            dataset.attrs["units"] = UNITS
        self._output.check()


class _WriteBuffer:
    """Blocks that are not written yet."""

    def __init__(self) -> None:
        self.rows = 0
        self._blocks: list[LoadHistory] = []

    def add(self, block: LoadHistory) -> None:
        """Keep one more block."""
        self._blocks.append(block)
        self.rows += len(block.time)

    def drain(self) -> dict[str, Array]:
        """Return {dataset: rows} of all blocks, and forget them."""
        blocks, self._blocks, self.rows = self._blocks, [], 0
        if not blocks:
            return {}
        return {name: np.concatenate([getattr(block, name) for block in blocks]) for name in ("time", "loads", "sigma")}
