"""What a fit takes: runs, given as paths or objects, and measured frequency responses."""

from __future__ import annotations

import os
from collections.abc import Iterable

from balance_cli.api.inputs import RunLike, to_runs
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.measured_responses import MeasuredResponses, require_usable_responses
from balance_cli.signals.response.transfer import Transfer

FittedLike = RunLike | Transfer


def to_fitted(
    data: FittedLike | Iterable[FittedLike], geometry: Geometry
) -> tuple[tuple[Run, ...], tuple[MeasuredResponses, ...]]:
    """The runs of `to_runs`, and the measured responses among the data.

    Raises UserError as `to_runs`, and where responses cannot be used beside these runs.
    """
    items = [data] if isinstance(data, Run | Transfer | str | os.PathLike) else list(data)
    responses = tuple(MeasuredResponses(item) for item in items if isinstance(item, Transfer))
    runs = to_runs([item for item in items if not isinstance(item, Transfer)], geometry)
    require_usable_responses(responses, runs, geometry)
    return runs, responses
