"""Load points that are labeled as tares, unloaded, and have a load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF

LARGEST_TARE_SHARE = 0.1
"""Of the largest load of a component: hangers, pans and the noise of a load cell stay below."""
SMALLEST_APPLIED_SHARE = 0.02
"""Of the largest load of the run, moments over an arm: components below are not applied, and hold noise."""
MOST_LISTED = 10
"""Load points in a message."""


def describe_loaded_tares(run: Run, arm: float) -> str:
    """Return in words which load points of a static run are tares with a load; empty where there is none.

    `arm` [m] makes moments comparable with forces. Tares that all have one load, as about a trim, are the zero of the
    others.
    """
    loaded = _loaded_tares(run, arm)
    if not loaded:
        return ""
    loads = run.read().loads
    assert loads is not None
    shown = ", ".join(f"{row + 1} ({_load_text(loads[row])})" for row in loaded[:MOST_LISTED])
    more = f" and {len(loaded) - MOST_LISTED} more" if len(loaded) > MOST_LISTED else ""
    noun, verb, what = ("point", "is", "a tare") if len(loaded) == 1 else ("points", "are", "tares")
    return f"load {noun} {shown}{more} {verb} labeled as {what}, which is unloaded: correct `point`, or the loads,"


def _loaded_tares(run: Run, arm: float) -> list[int]:
    """Return the rows that are labeled as tares and have a load that the run applies."""
    loads = run.read().loads if run.kind == "static" and run.point_kinds else None
    if loads is None:
        return []
    is_tare = np.array([kind == "tare" for kind in run.point_kinds or ()], bool)
    size = np.nan_to_num(np.abs(loads)).max(axis=0, initial=0.0)
    force = size / np.repeat([1.0, arm], 3)
    applied = force > SMALLEST_APPLIED_SHARE * force.max()
    if not is_tare.any() or not applied.any():
        return []
    share = np.nan_to_num(loads[:, applied]) / size[applied]
    tares = share[is_tare]
    if len(tares) > 1 and np.all(np.ptp(tares, axis=0) <= LARGEST_TARE_SHARE):
        return []
    return np.flatnonzero(is_tare & np.any(np.abs(share) > LARGEST_TARE_SHARE, axis=1)).tolist()


def _load_text(loads: NDArray[np.float64]) -> str:
    """Return the largest force or moment of a load point."""
    j = int(np.argmax(np.nan_to_num(np.abs(loads))))
    return f"{COMPONENTS[j]} {loads[j]:.4g} {UNIT_OF[COMPONENTS[j]]}"
