"""Whether anything but the table itself verifies the scale of the loads of a calibration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration

EARLIER_CALIBRATION = "earlier calibration"


def scale_evidence_of(calibration: Calibration, is_compared: bool = False) -> list[str]:
    """What the scale of the loads is held against; `is_compared`: with an earlier calibration too."""
    from balance_cli.calibration.load_units import scale_evidence

    evidence = scale_evidence(calibration.geometry, next(iter(calibration.trims.values())))
    return [*evidence, *([EARLIER_CALIBRATION] if is_compared else [])]


def scale_text(calibration: Calibration, is_compared: bool = False) -> Iterator[str]:
    """A line that says so where nothing verifies the scale."""
    if not scale_evidence_of(calibration, is_compared):
        yield (
            "scale not verified by anything: loads in lbf that the table calls N would look the same "
            "(`rated_loads` in the geometry, or `calibrate --against` an earlier calibration, would show it)"
        )
