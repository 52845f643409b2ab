"""Records of check and wind runs that are too short for harmonics, or have pulses that give no azimuth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.run_samples import sample_rate

if TYPE_CHECKING:
    from balance_cli.signals.rotor.azimuth import Azimuth

FEWEST_REVOLUTIONS = 10
"""Revolutions of the shortest interval; fewer leave too few lines between two harmonics for the noise."""


def revolution_faults(run: Run) -> Iterator[UserError]:
    """Yield what `reduce` refuses a run with pulses for: too few revolutions, or pulses that cannot be repaired."""
    if run.kind not in ("check", "wind") or run.pulse_times is None:
        return
    duration = run.samples / sample_rate(run)
    recorded = run.pulse_times[run.pulse_times <= duration]
    try:
        # The pulses agree with the stated speed, or have a fault of their own: only short records are counted.
        if run.rotor_speed * duration > 2 * FEWEST_REVOLUTIONS:
            from balance_cli.signals.rotor.pulse_repair import repair_pulses

            repair_pulses(recorded)
        else:
            from balance_cli.signals.rotor.azimuth import azimuth_from_pulses

            require_revolutions(run, azimuth_from_pulses(recorded))
    except UserError as error:
        yield UserError(error.fault, run.file, "rotor/pulse_times", error.remedy)


def require_revolutions(run: Run, azimuth: Azimuth) -> None:
    """Raise UserError where a record has fewer revolutions than harmonics with their noise need."""
    if azimuth.turns < FEWEST_REVOLUTIONS:
        fault = f"holds {azimuth.turns} revolutions; at least {FEWEST_REVOLUTIONS} are needed"
        raise UserError(fault, run.file, "rotor/pulse_times", "Record more revolutions")
