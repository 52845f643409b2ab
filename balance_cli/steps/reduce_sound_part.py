"""Reduction of a run in which channels that the loads need are lost for a while: its longest part without that."""

from __future__ import annotations

from dataclasses import replace

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.sound_part import SoundPart, longest_sound_part
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.steps.reduce import ReduceOptions, reduce_run


def reduce_sound_part(
    error: UserError,
    run: Run,
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None = None,
    options: ReduceOptions | None = None,
) -> RunLoads:
    """Reduce the longest part of a run in which no channel is lost, where the whole run ended in `error`.

    Raises that error where it is not one of lost channels, and UserError where the part does not determine the loads.
    """
    lost = live_channels(run, geometry).left_out if error.place == "channels" else {}
    part = longest_sound_part(run, lost) if lost else None
    if part is None:
        raise error
    loads = reduce_run(part.run, geometry, calibration, source, zero, options)
    begin, end = loads.interval
    interval = (begin + part.offset, end + part.offset)
    return replace(loads, interval=interval, notes=(*loads.notes, _note(part, run, lost)))


def _note(part: SoundPart, run: Run, lost: dict[str, str]) -> str:
    """Return in words which part of a run was reduced, and why."""
    name, reason = next(iter(lost.items()))
    others = f" and so are {plural(len(lost) - 1, 'other channel')}" if len(lost) > 1 else ""
    return (
        f"reduced are samples {part.start} to {part.stop - 1} of {run.samples} alone: beside them {name} is lost "
        f"({reason}){others}, and without it the loads are not determined"
    )
