"""Runs that have the same loads in every digit: one record under several names, of which one at most is right."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.reduction.result import RunLoads, replace_runs

MOST_NAMES = 6
"""Runs that a warning names one by one."""


def copied_runs(runs: Mapping[str, RunLoads]) -> tuple[tuple[str, ...], ...]:
    """Return the names of the runs of each record that is there under several names, in the order given.

    Noise makes the last digits of two records differ, whatever their loads.
    """
    by_loads: dict[bytes, list[str]] = {}
    for name, loads in runs.items():
        if np.any(np.nan_to_num(loads.amplitude)):
            by_loads.setdefault(loads.amplitude.tobytes() + loads.sigma_cosine.tobytes(), []).append(name)
    return tuple(tuple(names) for names in by_loads.values() if len(names) > 1)


def copy_warning(names: tuple[str, ...]) -> str:
    """Return what is to be known of runs with the same loads, in words."""
    shown = ", ".join(names[:MOST_NAMES]) + (f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else "")
    return f"{shown} have the same loads in every digit: is one record there under these names?"


def flag_copied_runs(runs: Mapping[str, RunLoads], copies: Iterable[tuple[str, ...]]) -> Mapping[str, RunLoads]:
    """Return the loads with those of copied runs flagged: which name is that of the record, the runs do not tell."""
    flagged = {
        name: runs[name].with_flag(MODEL_CONTRADICTED, copy_warning(names)) for names in copies for name in names
    }
    return replace_runs(runs, flagged)
