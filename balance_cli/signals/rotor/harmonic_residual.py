"""What the harmonics of a rotor leave of a record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, SampleBlock, SampleSource
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.harmonics import Harmonics
from balance_cli.signals.rotor.line_sums import trigonometric_basis
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HarmonicsRemoved:
    """Samples of a run without harmonics `coefficients` (2 n + 1, signals) of the azimuth, cosines before sines.

    `columns` are the places of these signals among the channels; beyond the pulses the azimuth stays as it is there.
    """

    parent: SampleSource
    rate: float
    azimuth: Azimuth
    coefficients: Array
    columns: tuple[int, ...]

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        block = self.parent.read(start, stop)
        psi, _ = self.azimuth.of_samples(self.rate, start, start + len(block.channels))
        channels = np.array(block.channels)
        channels[:, list(self.columns)] -= trigonometric_basis(psi, len(self.coefficients) // 2).T @ self.coefficients
        return SampleBlock(start, channels, block.loads)


def without_harmonics(run: Run, azimuth: Azimuth, spectra: Harmonics, names: tuple[str, ...]) -> Run:
    """Return the run without the harmonics of the named channels, each of constant amplitude."""
    signals = spectra.columns(names)
    coefficients = np.concatenate([spectra.cosine[:, signals], spectra.sine[1:, signals]])
    columns = tuple(run.channel_names.index(name) for name in names)
    return replace(run, source=HarmonicsRemoved(run.source, sample_rate(run), azimuth, coefficients, columns))
