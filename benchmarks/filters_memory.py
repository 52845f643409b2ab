"""The peak memory of a reduction in time of a generated record, measured in a process of its own.

No part of the record is stored: its samples are generated as they are read.
"""

from __future__ import annotations

import pickle
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run, SampleBlock
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.steps.reduce_in_time import reduce_run_in_time

Array = NDArray[np.float64]

RATE, SPEED = 800.0, 17.5
"""Samples per second, and revolutions per second."""
CHUNK = 8192
"""Samples that one seed generates."""


@dataclass(frozen=True)
class ReductionCase:
    """Geometry, calibration and response of a reduction."""

    geometry: Geometry
    calibration: Calibration
    source: ModelSource


@dataclass(frozen=True)
class GeneratedSource:
    """Rotor harmonics and white noise, generated reproducibly at every read."""

    channels: int
    samples: int

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        stop = min(stop, self.samples)
        chunks = range(start // CHUNK, (stop - 1) // CHUNK + 1)
        generated = np.concatenate([self._chunk(i) for i in chunks])
        return SampleBlock(start, generated[start - chunks[0] * CHUNK : stop - chunks[0] * CHUNK], None)

    def _chunk(self, index: int) -> Array:
        noise = np.random.default_rng(index).standard_normal((CHUNK, self.channels))
        psi = 2 * np.pi * SPEED / RATE * (index * CHUNK + np.arange(CHUNK))
        shape = np.random.default_rng(2**32).standard_normal((2, 8, self.channels))
        angle = np.outer(psi, np.arange(1, 9))
        return 1e-3 * noise + 0.05 * (np.cos(angle) @ shape[0] + np.sin(angle) @ shape[1])


def _generated_run(case: ReductionCase, length: float) -> Run:
    names = case.geometry.channel_names
    samples = round(length * RATE)
    pulses = np.arange(0.02, length - 0.02, 1.0 / SPEED)
    source = GeneratedSource(len(names), samples)
    return Run(
        f"made-{length:.0f}",
        case.geometry.rig,
        "wind",
        names,
        samples,
        source,
        has_loads=False,
        sample_rate=RATE,
        rotor_speed=SPEED,
        pulse_times=pulses,
    )


def _print_peak_memory(path: Path, length: float) -> None:
    """Reduce a generated record and print the peak memory [MB] of this process."""
    case: ReductionCase = pickle.loads(path.read_bytes())
    reduce_run_in_time(
        _generated_run(case, length), case.geometry, case.calibration, case.source, sink=lambda history: None
    )
    sys.stdout.write(f"{_own_peak_memory()}\n")


def _own_peak_memory() -> float:
    """Return the peak memory [MB] of this process from Linux; `ru_maxrss` would include that of the parent."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


if __name__ == "__main__":
    _print_peak_memory(Path(sys.argv[1]), float(sys.argv[2]))
