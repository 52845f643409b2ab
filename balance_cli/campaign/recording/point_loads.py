"""Runs with forces at points other than the hub, as runs with hub loads."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from balance_cli.campaign.recording.additions import RunAdditions
from balance_cli.campaign.recording.run import Array, Run, SampleBlock, SampleSource


@dataclass(frozen=True)
class PointLoadSource:
    """Samples of a run whose loads are those at the hub and the forces at its points, about the hub."""

    parent_source: SampleSource
    additions: RunAdditions
    hub: tuple[float, float, float]

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        block = self.parent_source.read(start, stop)
        at_points: Array = self.additions.hub_loads(np.array(self.hub), start, stop)
        return SampleBlock(start, block.channels, at_points if block.loads is None else block.loads + at_points)


def with_hub_loads(run: Run, hub: tuple[float, float, float]) -> Run:
    """The run with its forces at points added to the hub loads; the same run where it has no such forces."""
    additions = run.additions
    if additions is None or additions.load_points is None or isinstance(run.source, PointLoadSource):
        return run
    return replace(run, source=PointLoadSource(run.source, additions, hub), has_loads=True)
