"""The samples in a run file, read on demand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from balance_cli.campaign.recording.reading_units import EXCITATION, ReadingConversion
from balance_cli.campaign.recording.run import SampleBlock
from balance_cli.campaign.recording.run_contents import report_damage


@dataclass(frozen=True)
class Hdf5Source:
    """Samples in a run file, which is opened for each read, so that many runs can be held without open files."""

    path: Path
    load_order: tuple[int, ...] | None
    conversion: ReadingConversion | None = None

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop. Raises UserError where the file can no longer be read."""
        with report_damage(self.path), h5py.File(self.path, "r") as file:
            channels = np.asarray(file["channels"][start:stop], np.float64)
            if self.conversion is not None:
                measured = np.asarray(file[EXCITATION][start:stop], np.float64) if EXCITATION in file else None
                channels = self.conversion.convert(channels, measured)
            if self.load_order is None:
                return SampleBlock(start, channels, None)
            return SampleBlock(start, channels, np.asarray(file["loads"][start:stop], np.float64)[:, self.load_order])
