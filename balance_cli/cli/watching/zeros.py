"""The zero runs of a watched folder, and from which of them the mean loads of a run count."""

from __future__ import annotations

from dataclasses import dataclass, field

from balance_cli.campaign.recording.recorded_time import recorded_time, unreadable_time
from balance_cli.campaign.recording.run import Run
from balance_cli.reduction.wind_off import ZeroRecord


@dataclass(frozen=True)
class ZeroRun:
    """A zero run, and what mean loads count from; None where they are not measured."""

    run: Run
    record: ZeroRecord | None

    @property
    def time(self) -> float | None:
        """When it was recorded [s], where its file states it."""
        return recorded_time(self.run.recorded)


@dataclass
class ZeroRuns:
    """The zero runs in the order of the times of their files."""

    zeros: list[ZeroRun] = field(default_factory=list)

    def add(self, zero: ZeroRun) -> None:
        """Add the newest zero run, in place of one of this name."""
        self.zeros = [*(item for item in self.zeros if item.run.name != zero.run.name), zero]

    @property
    def newest(self) -> ZeroRun | None:
        """The newest by the times of files; None where there is none."""
        return self.zeros[-1] if self.zeros else None

    def of_time(self, recorded: str | None) -> ZeroRun | None:
        """Return the zero of a run with this attribute `recorded`: the last that was recorded before it.

        A copy may change the times of files: these decide only where the run or all zero runs do not state their own.
        """
        time = recorded_time(recorded)
        if time is None or not self.decide(recorded):
            return self.newest
        before = [zero for zero in self.zeros if zero.time is not None and zero.time <= time]
        if before:
            return max(before, key=lambda zero: zero.time or 0.0)
        return next((zero for zero in reversed(self.zeros) if zero.time is None), None)

    def decide(self, recorded: str | None) -> bool:
        """Whether stated times decide: the run with this attribute `recorded` and a zero run state theirs."""
        return recorded_time(recorded) is not None and any(zero.time is not None for zero in self.zeros)

    def warning(self, run: str, recorded: str | None) -> str:
        """Return that the times of files give a run another zero than its attribute `recorded`, or that it is no time.

        Empty where neither is so.
        """
        chosen, newest = self.of_time(recorded), self.newest
        if newest is not None and (unreadable := unreadable_time(recorded)):
            return f"{run}: {unreadable}, and its zero is {newest.run.name}, the newest file"
        if newest is None or chosen is newest:
            return ""
        if chosen is None:
            return f"{run}: was recorded before all zero runs, as they state it: mean loads have no zero"
        name = newest.run.name
        return f"{run}: its zero is {chosen.run.name}, the last recorded before it, not {name}, the newest file"
