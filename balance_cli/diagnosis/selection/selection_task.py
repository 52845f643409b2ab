"""What the effects of a fit on all lines are tested with."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch

Announce = Callable[[str], bool]


@dataclass(frozen=True)
class SelectionTask:
    """The lines on which effects are tested, the settings, and the effects that stay whatever the lines show.

    `announce` reports a step and returns whether the time is over. `error_runs`: names of the runs whose weights carry
    a model error. `given_labels`: effects of the model that was given; `certain_labels`: these and the ones that the
    channels demand.
    """

    batches: Sequence[Batch]
    settings: SearchSettings
    announce: Announce
    error_runs: Collection[str] = ()
    given_labels: Collection[str] = ()
    certain_labels: Collection[str] = ()
