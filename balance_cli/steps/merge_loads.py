"""Shards of a reduction put together: the loads that one call for all runs would have given."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from balance_cli.campaign.rig.geometry_file import geometry_digest
from balance_cli.io.artefacts import Input, Provenance
from balance_cli.io.errors import UserError
from balance_cli.io.stored_mapping import StoredMapping
from balance_cli.reduction.choices import FREQUENCIES
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.steps.contradicted_loads import compare_with_other_runs

RUN_ROLE = "run"
SHARD = re.compile(r"--shard (\d{1,9})/(\d{1,9})$")
"""The end of the command that made a shard."""
MOST_LISTED = 5
"""Missing shards that a message names."""
REMEDY = "Merge shards of one reduction: the same options, calibration, response and zero run"


@dataclass(frozen=True)
class Shard:
    """Loads with their provenance, and the file that they come from."""

    file: str
    loads: HubLoads
    provenance: Provenance


@dataclass(frozen=True)
class MergedShards:
    """The loads of all shards; options and inputs of their reduction; the number of runs of each file.

    `new_warnings`: what the comparison of runs of different shards says. `missing`: shards of the reduction that are
    not among them, `2/3`, as far as the others tell how many there are.
    """

    loads: HubLoads
    options: Mapping[str, Any]
    inputs: tuple[Input, ...]
    counts: Mapping[str, int]
    new_warnings: tuple[str, ...]
    missing: tuple[str, ...] = ()


class _Ordered(Mapping[str, RunLoads]):
    """The values of a mapping in the order of their keys, each read when it is asked for."""

    def __init__(self, values: Mapping[str, RunLoads]) -> None:
        self._values, self._keys = values, sorted(values)

    def __getitem__(self, key: str) -> RunLoads:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)


def merge_loads(shards: Iterable[Shard]) -> MergedShards:
    """Return the loads of all shards, runs in the order of their names; one shard at a time is in memory.

    The runs, of which a shard holds only some, are compared with each other.
    Raises UserError where two shards come from different reductions, or have a run in common.
    """
    first: _Reduction | None = None
    runs: StoredMapping[RunLoads] = StoredMapping()
    files: dict[str, str] = {}
    warnings: set[str] = set()
    inputs: dict[Input, None] = {}
    counts: dict[str, int] = {}
    commands: list[str] = []
    for shard in shards:
        commands.append(shard.provenance.command)
        reduction = _Reduction.of(shard)
        first = first or reduction
        difference = _difference(first, reduction)
        if difference:
            raise UserError(f"{difference} differs from that of {first.file}", shard.file, remedy=REMEDY)
        for name, loads in shard.loads.runs.items():
            if name in runs:
                fault = f"has the run `{name}`, which {files[name]} has too"
                raise UserError(fault, shard.file, "runs", "Give each shard once")
            runs[name], files[name] = loads, shard.file
        warnings.update(shard.loads.warnings or ())
        inputs |= dict.fromkeys(shard.provenance.inputs)
        counts[shard.file] = len(shard.loads.runs)
    assert first is not None
    ordered: Mapping[str, RunLoads] = _Ordered(runs)
    new_warnings: tuple[str, ...] = ()
    if first.loads.method != FREQUENCIES:
        ordered, new_warnings = compare_with_other_runs(ordered)
    merged = replace(first.loads, runs=ordered, warnings=tuple(sorted({*warnings, *new_warnings})) or None)
    return MergedShards(
        merged, first.provenance.options, tuple(inputs), counts, new_warnings, _missing_shards(commands)
    )


def _missing_shards(commands: Iterable[str]) -> tuple[str, ...]:
    """Return the shards that are missing beside those that these commands made."""
    numbers = [match.groups() for command in commands if (match := SHARD.search(command))]
    found, totals = {int(number) for number, _ in numbers}, {int(total) for _, total in numbers}
    if len(totals) != 1:
        return ()  # none that tells, or parts of several divisions
    total = totals.pop()
    missing = (f"{number}/{total}" for number in range(1, total + 1) if number not in found)
    listed, more = tuple(islice(missing, MOST_LISTED)), total - len(found) - MOST_LISTED
    return (*listed, f"{more} more") if more > 0 else listed


@dataclass(frozen=True)
class _Reduction:
    """What the shards of one reduction have in common; `loads` without its runs."""

    file: str
    loads: HubLoads
    provenance: Provenance
    geometry: str

    @classmethod
    def of(cls, shard: Shard) -> _Reduction:
        """Return that of a shard."""
        digest = geometry_digest(shard.loads.geometry)
        return cls(shard.file, replace(shard.loads, runs={}), shard.provenance, digest)


def _difference(first: _Reduction, other: _Reduction) -> str:
    """What distinguishes two reductions; empty where they are one."""
    if first.geometry != other.geometry:
        return "its geometry"
    if (first.loads.method, first.loads.response) != (other.loads.method, other.loads.response):
        return "its method or response"
    if first.provenance.options != other.provenance.options:
        return "an option of the reduction"
    for role in sorted({item.role for shard in (first, other) for item in shard.provenance.inputs} - {RUN_ROLE}):
        if _digests(first, role) != _digests(other, role):
            return f"the {role}"
    return ""  # each run has the harmonics that its band permits


def _digests(reduction: _Reduction, role: str) -> set[str]:
    return {item.digest for item in reduction.provenance.inputs if item.role == role}
