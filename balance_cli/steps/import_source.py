"""Samples of an imported run, read from foreign files block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import SampleBlock
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.importers.base import ChannelGroup
from balance_cli.io.errors import UserError
from balance_cli.steps.import_signals import Signal
from balance_cli.steps.import_timeline import Clock, Timeline

Array = NDArray[np.float64]

LEAST_SUPPLY = 0.01
"""Of the nominal supply; with less the bridge is switched off."""


@dataclass(frozen=True)
class GroupSignals:
    """The signals of one channel group, and its place in the matrix of all signals; no clock in a static run."""

    group: ChannelGroup
    signals: tuple[Signal, ...]
    places: tuple[int, ...]
    clock: Clock | None

    def read(self, timeline: Timeline | None, start: int, stop: int) -> Array:
        """Samples (stop - start, signals) in our units, on the timeline where there is one."""
        columns = [signal.source.column for signal in self.signals]
        try:
            values = self._read_raw(timeline, columns, start, stop)
        except UserError as error:
            raise error.with_location(file=str(self.signals[0].source.file.path)) from error
        factors = np.array([signal.factor for signal in self.signals])
        return np.asarray(values * factors + np.array([signal.offset for signal in self.signals]))

    def _read_raw(self, timeline: Timeline | None, columns: Sequence[int], start: int, stop: int) -> Array:
        if timeline is None or self.clock is None:
            return self.group.read(columns, start, stop)
        if timeline.is_direct(self.clock):
            first = timeline.first_sample(self.clock)
            return self.group.read(columns, first + start, first + stop)
        return timeline.resampler(self.group, self.clock, columns).read(start, stop)


@dataclass(frozen=True)
class SignalMatrix:
    """All signals of a run as one matrix, whatever groups they are in."""

    groups: tuple[GroupSignals, ...]
    timeline: Timeline | None
    samples: int
    targets: tuple[str, ...]

    def read(self, start: int, stop: int) -> Array:
        """Samples (stop - start, signals)."""
        stop = min(stop, self.samples)
        values = np.empty((stop - start, len(self.targets)))
        for group in self.groups:
            values[:, group.places] = group.read(self.timeline, start, stop)
        return values


def signal_matrix(
    signals: Sequence[Signal], clocks: Sequence[Clock | None], timeline: Timeline | None, samples: int
) -> SignalMatrix:
    """Collect the signals by their groups, so that each group is read once for each block."""
    by_group: dict[int, list[int]] = {}
    for place, signal in enumerate(signals):
        by_group.setdefault(id(signal.source.group), []).append(place)
    groups = tuple(
        GroupSignals(
            signals[places[0]].source.group, tuple(signals[k] for k in places), tuple(places), clocks[places[0]]
        )
        for places in by_group.values()
    )
    return SignalMatrix(groups, timeline, samples, tuple(signal.target for signal in signals))


@dataclass(frozen=True)
class ImportedAdditions:
    """Forces at points and temperatures, each a matrix of signals."""

    matrices: dict[str, SignalMatrix]

    def read(self, dataset: str, start: int, stop: int) -> Array:
        """Rows start to stop."""
        return self.matrices[dataset].read(start, stop)


@dataclass(frozen=True)
class ImportedSource:
    """Samples of channels [V] and hub loads [N, N m]; the matrix holds channels, loads, and supplies of bridges.

    `supplies` are channel, supply (columns) and nominal supply [V] of channels that are ratios to a measured supply.
    """

    matrix: SignalMatrix
    channels: int
    load_columns: tuple[int, ...] | None = field(default=None)
    supplies: tuple[tuple[int, int, float], ...] = ()

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop; loads that the map does not name are zero, which declares them so."""
        values = self.matrix.read(start, stop)
        channels = values[:, : self.channels]
        for channel, supply, nominal in self.supplies:
            volts = values[:, supply]
            # Without a supply there is no ratio: the sample is missing.
            channels[:, channel] *= nominal / np.where(np.abs(volts) > LEAST_SUPPLY * nominal, volts, np.nan)
        if self.load_columns is None:
            return SampleBlock(start, channels, None)
        loads = np.zeros((len(values), len(COMPONENTS)))
        loads[:, self.load_columns] = values[:, self.channels : self.channels + len(self.load_columns)]
        return SampleBlock(start, channels, loads)
