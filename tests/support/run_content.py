"""A small run for tests of files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from balance_cli.campaign.recording.run import MemorySource, Run


def a_run(kind: str = "check", **changes: Any) -> Run:
    """A sound run of 100 samples and three channels at 100 Hz."""
    rng = np.random.default_rng(1)
    loads = rng.normal(size=(100, 6)) if kind in ("static", "sweep", "check") else None
    of_kind: dict[str, dict[str, Any]] = {
        "static": {"trim": "bare"},
        "sweep": {"excited": ("Fx",), "excitation": "multisine", "level": (2.0,), "period": 0.5},
    }
    moving = {} if kind == "static" else {"sample_rate": 100.0, "rotor_speed": 10.0}
    pulses = np.arange(9) * 0.1 + 0.02 if kind in ("check", "wind") else None
    run = Run(
        name="r",
        rig="RTS-6",
        kind=kind,
        channel_names=("x.strain", "y1.strain", "torque"),
        samples=100,
        source=MemorySource(rng.normal(size=(100, 3)), loads),
        has_loads=loads is not None,
        pulse_times=pulses,
        **{**moving, **of_kind.get(kind, {})},
    )
    return replace(run, **changes)
