"""Numbers among the root attributes of a run file that the format does not know: the conditions of the run."""

from __future__ import annotations

import math

import h5py
import numpy as np

from balance_cli.campaign.recording.additions_file import AZIMUTH_ERROR

RUN_ATTRIBUTES = (
    *("format", "kind", "run", "rig", "sample_rate", "rotor_speed", "excited", "excitation", "level", "period", "trim"),
    *("recorded", "note"),
)
KNOWN_ATTRIBUTES = (*RUN_ATTRIBUTES, AZIMUTH_ERROR)
"""Attributes that the format knows, with those that are optional."""
MOST_CONDITIONS = 64
"""Attributes that are kept, the first by name."""


def read_conditions(file: h5py.File) -> dict[str, float]:
    """Return the attributes with one number that the format does not know; texts are for people."""
    conditions: dict[str, float] = {}
    for name in sorted(name for name in file.attrs if name not in KNOWN_ATTRIBUTES):
        value = _condition(file, name)
        if value is not None and len(conditions) < MOST_CONDITIONS:
            conditions[name] = value
    return conditions


def _condition(file: h5py.File, name: str) -> float | None:
    """The value of an attribute, None where it is no single finite number."""
    try:
        if math.prod(file.attrs.get_id(name).shape or ()) > 1:
            return None
        value = file.attrs[name]
    except (OSError, RuntimeError, LookupError, ValueError, TypeError):
        return None  # of a type that h5py does not read; nothing depends on it
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size == 1 else None
    if isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating):
        return float(value) if math.isfinite(value) else None
    return None
