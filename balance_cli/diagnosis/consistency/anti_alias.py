"""An anti-alias cutoff that the recorded loads of the sweeps contradict.

The filter cancels in every response, and on measured records the noise lies behind it. But the load signals pass it: a
sweep that goes beyond the cutoff must be recorded smaller there. One that is not was never filtered so. The reverse, a
cutoff that is lower than declared, looks like an exciter that grows weaker, and is not told.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency.findings import ANTI_ALIAS, WARNING, ConsistencyFinding
from balance_cli.signals.anti_alias import CONTRADICTED_CUTOFF, anti_alias_response
from balance_cli.signals.response_rows import ResponseRows

PASSED, STOPPED = 0.9, 0.35
"""Gains of the declared filter between which it says too little; at the second, a third of a load is left."""
LEAST_RATIO = 0.7
"""Recorded density of a load where the filter stops it over that where it passes, in every sweep: twice what the filter
lets pass, so that exciters would have to become twice as strong there, all of them."""
FEWEST_BANDS = 4
"""Bands on either side from which a median is not that of one or two lines."""
FEWEST_SWEEPS = 2
"""Sweeps that must agree: one alone may have a faulty load cell."""


def filter_findings(rows: Sequence[ResponseRows], geometry: Geometry) -> list[ConsistencyFinding]:
    """Return a warning where all sweeps beyond the declared cutoff are recorded as if it were not there."""
    ratios = {run.run: ratio for run in rows if run.kind == "sweep" for ratio in _stopped_over_passed(run, geometry)}
    if len(ratios) < FEWEST_SWEEPS or min(ratios.values()) < LEAST_RATIO:
        return []
    share = f"{min(ratios.values()):.2g} of their size below it"
    text = f"{CONTRADICTED_CUTOFF} are recorded with {share}: is the cutoff higher?"
    return [ConsistencyFinding(ANTI_ALIAS, WARNING, text, tuple(ratios), True)]


def _stopped_over_passed(run: ResponseRows, geometry: Geometry) -> Iterator[float]:
    """Yield the density of the load where the declared filter stops it over that where it passes it, if known."""
    for j in np.unique(run.reference):
        of_component = run.reference == j
        frequency = run.frequency[of_component]
        density = np.abs(run.loads[of_component, j]) / np.sqrt(frequency)  # bands are proportional to their frequency
        gain = np.abs(anti_alias_response(geometry.acquisition, frequency))
        passed, stopped = gain > PASSED, gain < STOPPED
        if passed.sum() >= 2 * FEWEST_BANDS and stopped.sum() >= FEWEST_BANDS:
            near = passed & (frequency >= np.median(frequency[passed]))
            yield float(np.median(density[stopped]) / np.median(density[near]))
