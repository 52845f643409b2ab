"""What contradicts what in a campaign: one finding for each fault, in words and as data. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, field

FAULT = "fault"
"""Loads that rest on these data are wrong: exit status 2."""
WARNING = "warning"
"""May be meant or be found by a diagnosis: said, and kept in the JSON."""

EXCHANGED_CHANNELS = "exchanged channels"
REVERSED_CHANNEL = "reversed channel"
CHANNEL_FACTOR = "channel factor"
SILENT_CHANNEL = "silent channel"
REVERSED_CELL = "reversed cell"
REVERSED_LOAD = "reversed load"
EXCHANGED_LOADS = "exchanged loads"
LOAD_FACTOR = "load factor"
REVERSED_CHANNELS = "all channels reversed"
CHANNELS_FACTOR = "all channels factor"
HUB_POSITION = "hub position"
STIFFNESS = "stiffness"
FREQUENCIES = "frequencies"
LEVEL = "level"
DIFFERENT_RIG = "different rig"
ANTI_ALIAS = "anti-alias filter"
STATIC_RESPONSE = "static response"
NOISE_LEVEL = "noise level"
LOADED_TARE = "loaded tare"
DELAY = "delay"
COPIED_RECORD = "copied record"
LARGE_RESIDUAL = "large residual"

KINDS = (
    EXCHANGED_CHANNELS,
    REVERSED_CHANNEL,
    CHANNEL_FACTOR,
    SILENT_CHANNEL,
    REVERSED_CELL,
    REVERSED_LOAD,
    EXCHANGED_LOADS,
    LOAD_FACTOR,
    REVERSED_CHANNELS,
    CHANNELS_FACTOR,
    HUB_POSITION,
    STIFFNESS,
    FREQUENCIES,
    LEVEL,
    DIFFERENT_RIG,
    ANTI_ALIAS,
    STATIC_RESPONSE,
    NOISE_LEVEL,
    LOADED_TARE,
    DELAY,
    COPIED_RECORD,
    LARGE_RESIDUAL,
)


@dataclass(frozen=True)
class ConsistencyFinding:
    """A contradiction between the runs of a campaign, or between them and the geometry.

    `kind` is one of KINDS and `severity` FAULT or WARNING; `text` says it in words. `runs` are those that show it, and
    `in_all_runs` whether all runs do that could. `factor` is what the readings (or loads) are multiplied by, None where
    there is no factor; `position` the hub that the runs show [m]; `trims` of a calibration that show it.
    """

    kind: str
    severity: str
    text: str
    runs: tuple[str, ...] = ()
    in_all_runs: bool = False
    channels: tuple[str, ...] = ()
    components: tuple[str, ...] = ()
    cells: tuple[str, ...] = ()
    factor: float | None = field(default=None, metadata={"omit_if_none": True})
    position: tuple[float, ...] = ()
    trims: tuple[str, ...] = ()

    @property
    def is_fault(self) -> bool:
        """Whether loads that rest on these data are wrong."""
        return self.severity == FAULT

    @property
    def sentence(self) -> str:
        """The text with the runs that show it."""
        return f"{self.text} {describe_runs(self.runs, self.in_all_runs)}".rstrip()


MOST_NAMES = 6
"""Runs that a message names one by one: as many as fit on a line."""


def describe_runs(runs: tuple[str, ...], in_all_runs: bool) -> str:
    """Return `in RUN, RUN`; `in all N runs that can show it` where no run says otherwise."""
    if not runs:
        return ""
    if in_all_runs and len(runs) > 1:
        return f"in all {len(runs)} runs that show it"
    shown = ", ".join(runs[:MOST_NAMES])
    return f"in {shown}" if len(runs) <= MOST_NAMES else f"in {shown} and {len(runs) - MOST_NAMES} more"
