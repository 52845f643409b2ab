"""`balance merge`: the shards of a reduction as one table of loads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from balance_cli.cli.common import Session, balance_command, output_option
from balance_cli.cli.load_table_file import check_table_suffix, write_loads
from balance_cli.cli.options import InputFile
from balance_cli.io.formats import LOADS_FORMAT


@balance_command("merge")
@click.argument("loads", type=InputFile(), nargs=-1, required=True, metavar="LOADS...")
@output_option("LOADS", "Table of loads, .csv or .h5.")
def command(session: Session, loads: tuple[Path, ...], output: Path) -> None:
    """Put the shards of a reduction together.

    LOADS are the .h5 files of `reduce --shard 1/N` to `N/N`, in any order. The result is that of one call for all runs,
    with the same content digest. Shards of different reductions, and a run in two shards, are refused.
    """
    from balance_cli.reduction.result import HubLoads
    from balance_cli.steps.merge_loads import Shard, merge_loads, merged_inputs

    check_table_suffix(output)
    shards = []
    for path in session.progress(loads, "shards", len(loads)):
        artefact = session.artefact(path, {LOADS_FORMAT: HubLoads}, "shard")
        shards.append(Shard(str(path), artefact.content, artefact.provenance))
    merged = merge_loads(shards)
    provenance = replace(session.provenance(), options=shards[0].provenance.options, inputs=merged_inputs(shards))
    write_loads(session, output, merged, provenance)
    counts = [{"file": shard.file, "runs": len(shard.loads.runs)} for shard in shards]
    summary = {"method": merged.method, "response": merged.response, "shards": counts}
    text = ", ".join(f"{count['file']} {count['runs']}" for count in counts)
    session.finish(summary, [f"{len(merged.runs)} runs: {text}"])
