"""The options of a command over many runs that are reduced each by itself."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from balance_cli.cli.options import OutputFile
from balance_cli.io.errors import UserError

F = TypeVar("F", bound=Callable[..., Any])
MOST_JOBS = 256
"""Worker processes; a greater number is taken for a typing error."""


@dataclass(frozen=True)
class BatchOptions:
    """How a batch is done; nothing of it changes a result.

    `skip_bad`: the user expects bad runs, so that they do not change the exit status; `strict`: the first bad run ends
    the call. `shard` (i, n): every n-th run, from the i-th on. `survey`:
    the file in which what the headers of all runs state is kept for other calls.
    """

    skip_bad: bool = False
    strict: bool = False
    jobs: int = 1
    executor: str | None = None
    shard: tuple[int, int] | None = None
    survey: Path | None = None

    def skips(self, count: int) -> bool:
        """Whether bad ones among `count` runs are skipped: where there are others, unless the user wants all or none.

        Raises UserError where the options contradict each other.
        """
        if self.skip_bad and self.strict:
            raise UserError("does not go with --skip-bad", "--strict", remedy="Leave one of them out")
        if self.executor is not None and self.jobs > 1:
            raise UserError("does not go with --jobs", "--executor", remedy="The Dask cluster has workers of its own")
        return self.skip_bad or (count > 1 and not self.strict)


def batch_options(function: F) -> F:
    """The options of a batch, passed to the command together as `batch`."""
    for decorate in reversed(_OPTIONS):
        function = decorate(function)
    return function


def gather_batch_options(parameters: dict[str, Any]) -> BatchOptions:
    """Take the options of a batch out of the parameters of a command."""
    return BatchOptions(**{name: parameters.pop(name) for name in BatchOptions.__dataclass_fields__})


def parse_shard(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Return i and n of `i/n`. UserError unless i is from 1 to n."""
    if value is None:
        return None
    match = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", value)
    shard = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= shard[0] <= shard[1]:
        fault = f"`{value}` is not a shard"
        raise UserError(fault, "--shard", remedy="Write i/n, for example 3/8 for the third of eight shards")
    return shard


_OPTIONS = (
    click.option("--skip-bad", is_flag=True, help="Exit status 0, not 4, where runs were skipped."),
    click.option("--strict", is_flag=True, help="The first run that cannot be used ends the call; nothing is written."),
    click.option(
        "-j",
        "--jobs",
        metavar="N",
        type=click.IntRange(1, MOST_JOBS),
        default=1,
        show_default=True,
        help="Processes in which runs are reduced.",
    ),
    click.option("--executor", metavar="dask://HOST:PORT", help="Reduce the runs on this Dask cluster (extra `dask`)."),
    click.option(
        "--shard",
        callback=parse_shard,
        metavar="I/N",
        help="Reduce every N-th run only, from the I-th on; `balance merge` puts the shards together.",
    ),
    click.option(
        "--survey",
        type=OutputFile(),
        metavar="FILE",
        help="Keep the headers of all runs in FILE for other shards, which then read only those of their own runs.",
    ),
)
