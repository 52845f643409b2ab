"""Whether the declared anti-alias filter, which is taken out of the harmonics, can be the one that a record passed.

It cancels in a response, and no channel contradicts it wind-on. But the filters of many acquisitions follow the sample
rate, and a geometry declares one for all runs.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.reduction.result import RunLoads

SAME_RATE = 0.01
"""Relative difference of two sample rates up to which they are one: clocks differ by less, and the rates between which
an acquisition is switched by far more."""


def flag_assumed_filter(loads: RunLoads, run: Run, geometry: Geometry, sweep_rates: Collection[float]) -> RunLoads:
    """Return loads whose harmonics are flagged where the filter of the geometry does not go with their sample rate.

    They have a note where that is another than the `sweep_rates` [Hz], those at which the response was measured, and
    the filter is possible at both.
    """
    declared, rate = geometry.acquisition.filter, run.sample_rate
    if declared is None or rate is None:
        return loads
    if declared.cutoff >= rate / 2.0:
        note = (
            f"recorded at {rate:g} Hz, where the declared filter of {declared.cutoff:g} Hz lets pass what is aliased: "
            "if another filter was there, the harmonics are wrong in size and phase"
        )
        harmonics = np.arange(len(loads.amplitude))[:, None] > 0
        return loads.with_flag(MODEL_CONTRADICTED, note, where=harmonics)
    if not sweep_rates or any(abs(rate / other - 1.0) <= SAME_RATE for other in sweep_rates):
        return loads
    others = " and ".join(f"{other:g}" for other in sorted(sweep_rates))
    note = (
        f"recorded at {rate:g} Hz, the sweeps at {others} Hz: the declared filter of {declared.cutoff:g} Hz is taken "
        "out, and one that follows the rate would turn the harmonics"
    )
    return loads.with_flag("", note)
