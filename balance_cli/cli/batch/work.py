"""The work on one run of a batch, as workers do it: all that it needs is in its argument."""

from __future__ import annotations

import functools
import pickle
from dataclasses import dataclass
from pathlib import Path

from balance_cli.campaign.recording.gaps import describe_gaps, gap_summary
from balance_cli.campaign.recording.run_file import open_matching_run, run_header
from balance_cli.cli.reduce_runs import Reduction
from balance_cli.io.errors import UserError
from balance_cli.reduction.result import RunLoads
from balance_cli.signals.nyquist_noise import RunNoise, measure_nyquist_noise
from balance_cli.signals.response_rows import ResponseRows, response_rows
from balance_cli.steps.reduction_inputs import default_harmonics, harmonics_within_band

# What every run needs is imported with this module, before workers are forked.
import balance_cli.steps.reduce  # noqa: F401  # isort: skip

ROTOR_KINDS = ("check", "wind")


@dataclass(frozen=True)
class Item:
    """A run file, the reduction (a pickle, the same for all runs), and the file of its history where one is written.

    `harmonics`: how many are reduced where the reduction does not say it.
    """

    path: Path
    reduction: bytes
    history: Path | None = None
    harmonics: int = 0


@dataclass(frozen=True)
class RunSurvey:
    """What is known of a run before it is reduced: its name and kind, and the harmonics that it permits."""

    name: str
    kind: str
    harmonics: int


@dataclass(frozen=True)
class RunResult:
    """What became of a run: its loads where it is a check or wind run, and what is compared with other runs.

    `gaps` {signal: counts} and `gap_text`: samples that were interpolated; `rows` and `level` where its loads are
    known; `noise`: of its channels, where there is some to compare it with. `error`: why a run that could be read
    could not be reduced.
    """

    name: str
    kind: str
    digest: str
    gaps: dict[str, dict[str, int]]
    gap_text: str
    loads: RunLoads | None
    rows: ResponseRows | None
    level: tuple[float, ...]
    error: UserError | None = None
    noise: RunNoise | None = None


def survey_run(item: Item) -> RunSurvey:
    """Read what a run file holds beside its samples. Raises UserError where it is no run of this rig."""
    reduction = _reduction(item.reduction)
    # The header alone has no pulses of further rotors.
    read = run_header if reduction.method.rotor == 1 else open_matching_run
    run = read(item.path, reduction.geometry)
    wanted = default_harmonics(reduction.geometry)
    possible = (
        harmonics_within_band(run, reduction.source, wanted, reduction.method.rotor)
        if run.kind in ROTOR_KINDS
        else wanted
    )
    return RunSurvey(run.name, run.kind, possible)


def reduce_file(item: Item) -> RunResult:
    """Read one run, reduce it if it has rotor loads, and return all that the batch needs of it.

    Raises UserError where the run cannot be read.
    """
    reduction = _reduction(item.reduction)
    run = open_matching_run(item.path, reduction.geometry, hold=True)
    rows = response_rows(run, reduction.geometry.channel_names) if reduction.compare_runs else None
    compares_noise = reduction.compare_runs or reduction.usual_noise
    noise = measure_nyquist_noise(run, reduction.geometry.channel_names) if compares_noise else None
    loads, fault = None, None
    try:
        loads = (
            reduction.with_harmonics(item.harmonics).reduce_run(run, item.history) if run.kind in ROTOR_KINDS else None
        )
    except UserError as error:
        fault = error.with_file_of(run.name, str(item.path))
    return RunResult(
        name=run.name,
        kind=run.kind,
        digest=run.digest,
        gaps=gap_summary(run),
        gap_text=describe_gaps(run),
        loads=loads,
        rows=rows,
        level=run.level,
        error=fault,
        noise=noise,
    )


def pickle_reduction(reduction: Reduction) -> bytes:
    """Return the reduction as it is sent to the workers."""
    return pickle.dumps(reduction, protocol=pickle.HIGHEST_PROTOCOL)


@functools.lru_cache(maxsize=2)
def _reduction(data: bytes) -> Reduction:
    """The reduction, restored once in each worker, with what its response computes once for all runs."""
    reduction: Reduction = pickle.loads(data)
    return reduction
