"""Which harmonic loads of a record change slowly within it, as beside a tone that drifts through a harmonic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.result_view import plural
from balance_cli.reduction.harmonic_loads import window_harmonic_loads
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.rotor.harmonics import count_regressed_harmonics
from balance_cli.signals.rotor.steadiness import MATERIAL_CHANGE, slow_change_error, windowed_amplitudes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MATERIAL_SHARE = 0.05
"""Change of a mean load, as a share of its size or that of its largest harmonic, from which the mean over the record
is no operating point.

A balance engineer repeats a point whose load moved by a few per cent; smaller drifts are the tunnel's own.
"""
MATERIAL_SHARE_OF_HARMONIC = 0.5
"""The same for the amplitude of a harmonic, which follows the rotor speed and gusts much more than the mean does."""
MATERIAL_SHARE_OF_LARGEST = 0.1
"""A harmonic below this share of the largest one of its component is too small for its drift to matter."""
SMALL_LOAD = 0.02
"""Of the largest harmonic of a component with the same unit: one that carries less counts as that large. What changes
in a component without loads is noise of others, and in sigma."""
TINY = float(np.finfo(float).tiny)
"""Least divisor: a component without loads has no change that matters."""


@dataclass(frozen=True)
class SlowChanges:
    """What slow changes leave in the harmonic loads (n, m), which of them it matters to, and `note`, where it does."""

    error: Array
    material: NDArray[np.bool_]
    note: str = ""


def slow_changes(
    record: RotorRecord,
    geometry: Geometry,
    source: ResponseSource,
    values: ComplexArray,
    sigma: Array,
    constant_response: ComplexArray | None,
) -> SlowChanges:
    """Return the slow changes of the harmonic loads (w, n, m) of windows, whose means have the `sigma` (n, m).

    Where they seem to change, windows of which all harmonics are regressed tell whether the higher ones only leaked.
    A record of tones at given frequencies is not examined, because each is beside the others.
    """
    none = SlowChanges(np.zeros(sigma.shape), np.zeros(sigma.shape, bool))
    dof, n = record.spectra.dof[1:, None], len(sigma)
    if record.fixed_frequency or not slow_change_error(values, sigma, dof).any():
        return none
    regressed = count_regressed_harmonics(record.run, record.azimuth, n, record.spectra.interval)
    live, turns = record.health.live, record.spectra.revolutions
    windows = windowed_amplitudes(record.run, record.azimuth, live, n, turns, regressed)
    values = window_harmonic_loads(windows, record, geometry, source, constant_response)
    error = slow_change_error(values, sigma, dof)
    size = np.abs(np.concatenate([np.zeros((1, sigma.shape[1])), np.abs(values.mean(axis=0))]))
    size = _at_least_small(size, record.components)
    share = MATERIAL_CHANGE * error / np.maximum(material_change(size)[1:], TINY)
    return SlowChanges(error, share > 1.0, _describe(error, share, record.components))


def _at_least_small(size: Array, components: tuple[str, ...]) -> Array:
    """Return the size (n+1, m) of loads, at least SMALL_LOAD of the largest harmonic of the components of one unit."""
    units = [UNIT_OF[name] for name in components]
    largest = [max(size[1:, m].max() for m, other in enumerate(units) if other == unit) for unit in units]
    return np.maximum(size, SMALL_LOAD * np.array(largest))


def _describe(error: Array, share: Array, components: tuple[str, ...]) -> str:
    """Say which load changes by the largest share (n, m) of what matters; empty where none exceeds that."""
    if share.max(initial=0.0) <= 1.0:
        return ""
    h, m = divmod(int(np.argmax(share)), len(components))
    others = int(np.count_nonzero(share > 1.0)) - 1
    further = f" and {plural(others, 'other harmonic load')}" if others else ""
    change = f"{error[h, m]:.2g} {UNIT_OF[components[m]]}"
    said = f"{components[m]} at {h + 1}/rev{further} changes within the record, which leaves {change} in its mean"
    return f"{said}: does a tone drift through it?"


def material_change(size: Array) -> Array:
    """Return the change (n+1, m) of loads of this size that matters."""
    change = np.maximum(
        MATERIAL_SHARE_OF_HARMONIC * size, MATERIAL_SHARE_OF_LARGEST * size[1:].max(axis=0, initial=0.0)
    )
    change[0] = MATERIAL_SHARE * size.max(axis=0)
    return np.asarray(change)
