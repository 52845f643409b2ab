"""Shards of a reduction put together: the loads that one call for all runs would have given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from balance_cli.campaign.rig.geometry_file import geometry_digest
from balance_cli.io.artefacts import Input, Provenance
from balance_cli.io.errors import UserError
from balance_cli.reduction.result import HubLoads, RunLoads

RUN_ROLE = "run"
REMEDY = "Merge shards of one reduction: the same options, calibration, response and zero run"


@dataclass(frozen=True)
class Shard:
    """Loads with their provenance, and the file that they come from."""

    file: str
    loads: HubLoads
    provenance: Provenance


def merge_loads(shards: Sequence[Shard]) -> HubLoads:
    """Return the loads of all shards, runs in the order of their names.

    Raises UserError where two shards come from different reductions, or have a run in common.
    """
    first = shards[0]
    runs: dict[str, RunLoads] = {}
    files: dict[str, str] = {}
    for shard in shards:
        difference = _difference(first, shard)
        if difference:
            raise UserError(f"{difference} differs from that of {first.file}", shard.file, remedy=REMEDY)
        for name, loads in shard.loads.runs.items():
            if name in runs:
                fault = f"has the run `{name}`, which {files[name]} has too"
                raise UserError(fault, shard.file, "runs", "Give each shard once")
            runs[name], files[name] = loads, shard.file
    warnings = tuple(sorted({text for shard in shards for text in shard.loads.warnings or ()}))
    return replace(first.loads, runs=dict(sorted(runs.items())), warnings=warnings or None)


def merged_inputs(shards: Sequence[Shard]) -> tuple[Input, ...]:
    """Return the inputs of all shards, each once."""
    return tuple(dict.fromkeys(item for shard in shards for item in shard.provenance.inputs))


def _difference(first: Shard, other: Shard) -> str:
    """What distinguishes the reductions of two shards; empty where they are one."""
    if geometry_digest(first.loads.geometry) != geometry_digest(other.loads.geometry):
        return "its geometry"
    if (first.loads.method, first.loads.response) != (other.loads.method, other.loads.response):
        return "its method or response"
    if first.provenance.options != other.provenance.options:
        return "an option of the reduction"
    for role in sorted({item.role for shard in (first, other) for item in shard.provenance.inputs} - {RUN_ROLE}):
        if _digests(first, role) != _digests(other, role):
            return f"the {role}"
    return "" if _harmonics(first) == _harmonics(other) else "the number of harmonics"


def _digests(shard: Shard, role: str) -> set[str]:
    return {item.digest for item in shard.provenance.inputs if item.role == role}


def _harmonics(shard: Shard) -> set[int]:
    return {len(loads.frequency_hz) for loads in shard.loads.runs.values()}
