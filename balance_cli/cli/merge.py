"""`balance merge`: the shards of a reduction as one table of loads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.load_table_file import check_table_suffix, write_loads
from balance_cli.cli.options import InputFile, output_option
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.io.result_view import plural


@balance_command("merge")
@click.argument("loads", type=InputFile(), nargs=-1, required=True, metavar="LOADS...")
@output_option("LOADS", "Table of loads, .csv or .h5.")
def command(session: Session, loads: tuple[Path, ...], output: Path) -> None:
    """Join the shards of a reduction into one table.

    LOADS are the .h5 files of `reduce --shard 1/N` to `N/N`, in any order. The result is that of one call for all runs,
    with the same content digest. Shards of different reductions, and a run in two shards, are refused;
    a warning names shards that are missing.
    """
    from balance_cli.reduction.result import HubLoads
    from balance_cli.steps.merge_loads import Shard, merge_loads

    check_table_suffix(output)

    def read(path: Path) -> Shard:
        artefact = session.artefact(path, {LOADS_FORMAT: HubLoads}, "shard")
        return Shard(str(path), artefact.content, artefact.provenance)

    merged = merge_loads(read(path) for path in session.progress(loads, "shards", len(loads)))
    session.warn_of_runs(merged.new_warnings, merged.loads.runs)
    if merged.missing:
        shards = ", ".join(merged.missing)
        session.warn(f"missing: shard {shards}. Merge it, too: the loads of its runs are not in the result")
    provenance = replace(session.provenance(), options=merged.options, inputs=merged.inputs)
    write_loads(session, output, merged.loads, provenance)
    counts = [{"file": file, "runs": runs} for file, runs in merged.counts.items()]
    summary = {"method": merged.loads.method, "response": merged.loads.response, "shards": counts}
    text = ", ".join(f"{count['file']} {count['runs']}" for count in counts)
    session.finish(summary, [f"{plural(len(merged.loads.runs), 'run')}: {text}"])
