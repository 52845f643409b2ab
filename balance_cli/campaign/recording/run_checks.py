"""What must hold in a run file: the faults that show without its samples, and those of the samples of its loads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from balance_cli.campaign.recording.attribute_checks import kind_faults, name_faults
from balance_cli.campaign.recording.dataset_checks import attitude_faults, channel_faults, load_faults, pulse_faults
from balance_cli.campaign.recording.point_labels import label_faults
from balance_cli.campaign.recording.reading_units import reading_unit_faults
from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE, Run, SampleBlock
from balance_cli.campaign.recording.run_schema import RunFileContents
from balance_cli.campaign.rig.components import COMPONENTS, RUN_KINDS
from balance_cli.io.errors import UserError


def run_file_faults(contents: RunFileContents) -> Iterator[UserError]:
    """Yield all faults of a run file that show without its samples."""
    kind = contents.attributes.get("kind")
    yield from name_faults(contents.attributes)
    yield from channel_faults(contents.channels, 1 if kind == "static" else 2)
    yield from reading_unit_faults(contents)
    if kind not in RUN_KINDS:
        return
    yield from kind_faults(contents.attributes)
    if contents.loads is not None or not contents.has_load_points:
        yield from load_faults(kind, contents.loads, contents.channels)
    yield from pulse_faults(kind, contents)
    yield from attitude_faults(kind, contents)
    rows = contents.channels.shape[0] if contents.channels is not None and contents.channels.shape else 0
    yield from label_faults(kind, "series", contents.series, rows)
    yield from label_faults(kind, "point", contents.point, rows)


def load_sample_faults(run: Run) -> Iterator[UserError]:
    """Yield the faults that only the samples of the loads show.

    Either samples are not finite or not plausible, or a load is zero throughout although `excited` names it.
    """
    if not run.has_loads:
        return
    check = LoadCheck(run)
    for block in run.blocks():
        check.see(block)
    yield from check.faults()


class LoadCheck:
    """The check of the samples of the loads of a run, while they pass block by block."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._has_points = run.additions is not None and run.additions.load_points is not None
        self._bad, self._largest = np.zeros(len(COMPONENTS), int), np.zeros(len(COMPONENTS))

    def watch(self, blocks: Iterable[SampleBlock]) -> Iterator[SampleBlock]:
        """The same blocks, seen."""
        for block in blocks:
            self.see(block)
            yield block

    def see(self, block: SampleBlock) -> None:
        """Take note of the loads of a block."""
        if block.loads is not None:
            sound = np.abs(block.loads) <= LARGEST_MAGNITUDE
            self._bad += (~sound).sum(axis=0)
            largest = np.abs(np.where(sound, block.loads, 0.0)).max(axis=0, initial=0.0)
            self._largest = np.maximum(self._largest, largest)

    def faults(self) -> Iterator[UserError]:
        """Yield the faults of what was seen."""
        if not self._run.has_loads:
            return
        for name, count, peak in zip(COMPONENTS, self._bad, self._largest, strict=True):
            place = f"loads, column {name}"
            if count:
                samples = f"{count} of {self._run.samples} samples"
                fault = f"{samples} of the load are not finite, or beyond {LARGEST_MAGNITUDE:g}"
                yield UserError(fault, place=place, remedy="Repeat the run, or cut it before these samples")
            elif name in self._run.excited and peak == 0.0 and not self._has_points:
                fault = "all samples are zero, which declares the load as not measured, but `excited` names it"
                yield UserError(fault, place=place, remedy="Correct `excited`, or record this load")


class MissingSamples:
    """A count of the samples that each channel of a run lacks, while they pass block by block."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._missing = np.zeros(len(run.channel_names), int)

    def watch(self, blocks: Iterable[SampleBlock]) -> Iterator[SampleBlock]:
        """The same blocks, counted."""
        for block in blocks:
            self._missing += (~np.isfinite(block.channels)).sum(axis=0)
            yield block

    def notes(self) -> list[str]:
        """What to tell of channels with missing samples."""
        pairs = zip(self._run.channel_names, self._missing, strict=True)
        return [f"{name}: no value in {count} of {self._run.samples} samples" for name, count in pairs if count]
