"""What a run file may hold beside channels, hub loads and 1/rev pulses: forces at points, temperatures, more rotors."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FORCE, POSITION, TEMPERATURE = "load_points/force", "load_points/position", "temperature"
"""Datasets with a row for each sample."""
BLOCK = 65536
"""Samples that are held at once."""


class AdditionSource(Protocol):
    """Source of the datasets with a row for each sample."""

    def read(self, dataset: str, start: int, stop: int) -> Array:
        """Rows start to stop: forces (m, p) [N], positions (m, p, 3) [m] or temperatures (m, k) [degC]."""
        ...


@dataclass(frozen=True)
class LoadPoints:
    """Points at which p forces act: names, `direction` (p, 3) in rig axes, `position` (p, 3) [m].

    The position is None where points move; it is then a dataset with a row for each sample. Both are NaN where the
    file has neither: the points are then those of the geometry, by name.
    """

    names: tuple[str, ...]
    direction: Array
    position: Array | None

    @property
    def are_named_only(self) -> bool:
        """Whether the file has no directions and positions."""
        return bool(np.isnan(self.direction).any())

    @property
    def unit_directions(self) -> Array:
        """Directions (p, 3) of length one."""
        return np.asarray(self.direction / np.linalg.norm(self.direction, axis=1, keepdims=True))


@dataclass(frozen=True)
class RunAdditions:
    """The optional parts of a run.

    `further_pulse_times` are those of a second rotor and so on [s]. `azimuth_error_deg` is one standard deviation of
    the azimuth at a pulse of the first rotor, where an import stated it; it enters sigma of the harmonics.
    """

    load_points: LoadPoints | None = None
    temperature_names: tuple[str, ...] = ()
    further_pulse_times: tuple[Array, ...] = ()
    azimuth_error_deg: float | None = None
    source: AdditionSource | None = field(default=None, repr=False)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing in it."""
        has_parts = self.load_points is not None or self.temperature_names or self.further_pulse_times
        return not has_parts and self.azimuth_error_deg is None

    def read(self, dataset: str, start: int, stop: int) -> Array:
        """Rows start to stop of a dataset."""
        assert self.source is not None
        return self.source.read(dataset, start, stop)

    def hub_loads(self, hub: Array, start: int, stop: int) -> Array:
        """The forces at points as hub loads (m, 6) [N, N m] about `hub` (3,) [m]; the metric side is rigid."""
        points = self.load_points
        assert points is not None
        forces = self.read(FORCE, start, stop)[:, :, None] * points.unit_directions
        position = self.read(POSITION, start, stop) if points.position is None else points.position
        return np.hstack([forces.sum(axis=1), np.cross(position - hub, forces).sum(axis=1)])

    def excerpt(self, start: int, stop: int, rate: float) -> RunAdditions:
        """The additions of samples start to stop."""
        pulses = tuple(times - start / rate for times in self.further_pulse_times)
        inside = tuple(times[(times >= 0.0) & (times <= (stop - 1 - start) / rate)] for times in pulses)
        source = None if self.source is None else _ExcerptSource(self.source, start)
        return replace(self, further_pulse_times=inside, source=source)

    def digest(self, samples: int) -> bytes:
        """SHA-256 of the content."""
        points = self.load_points
        metadata = {
            "temperature": self.temperature_names,
            "points": None if points is None else points.names,
            "azimuth_error_deg": self.azimuth_error_deg,
        }
        hashed = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
        arrays = [*self.further_pulse_times] + ([] if points is None else [points.direction])
        arrays += [points.position] if points is not None and points.position is not None else []
        for array in arrays:
            hashed.update(np.ascontiguousarray(array, "<f8").tobytes())
        for dataset in self.sampled_datasets:
            for start in range(0, samples, BLOCK):
                rows = self.read(dataset, start, min(start + BLOCK, samples))
                hashed.update(np.ascontiguousarray(rows, "<f8").tobytes())
        return hashed.digest()

    @property
    def sampled_datasets(self) -> tuple[str, ...]:
        """Names of the datasets with a row for each sample."""
        names = []
        if self.load_points is not None:
            names += [FORCE] + ([POSITION] if self.load_points.position is None else [])
        return (*names, *([TEMPERATURE] if self.temperature_names else []))


@dataclass(frozen=True)
class _ExcerptSource:
    """The additions of a run from the sample `start` on."""

    parent: AdditionSource
    start: int

    def read(self, dataset: str, start: int, stop: int) -> Array:
        return self.parent.read(dataset, self.start + start, self.start + stop)


@dataclass(frozen=True)
class MemoryAdditions:
    """Datasets held in memory."""

    datasets: dict[str, Array]

    def read(self, dataset: str, start: int, stop: int) -> Array:
        """Rows start to stop."""
        return self.datasets[dataset][start:stop]
