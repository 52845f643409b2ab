"""The physical parameters of the declared rig, with priors from its tolerances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.mass_properties import metric_side
from balance_cli.model.plate import cell_stiffness, free_index

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterSet:
    """p parameters: name, unit, declared value, one standard deviation of it, and bounds.

    `sigma` 0 means exact (never fitted), infinite means without a prior; `scale` (p,) is the size of a change that
    matters, the unit in which a fit works.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    sigma: Array
    scale: Array
    lower: Array
    upper: Array

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Position of a parameter in the vector."""
        return self.names.index(name)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters a fit may move."""
        return self.sigma > 0

    def __add__(self, other: ParameterSet) -> ParameterSet:
        arrays = (
            np.concatenate([getattr(self, name), getattr(other, name)])
            for name in ("value", "sigma", "scale", "lower", "upper")
        )
        return ParameterSet(self.names + other.names, self.units + other.units, *arrays)


@dataclass(frozen=True)
class _ParameterRow:
    """A parameter before it becomes a row of the table: its declared value and tolerance, and its lower bound."""

    name: str
    unit: str
    value: float
    sigma: float
    lower: float = -np.inf


INERTIA_NAMES = ("xx", "yy", "zz", "xy", "xz", "yz")


def parameter_set(rows: list[_ParameterRow]) -> ParameterSet:
    """Rows as arrays; the scale of a parameter is its sigma, or its size where it has none."""
    value, sigma, lower = (np.array([getattr(row, key) for row in rows]) for key in ("value", "sigma", "lower"))
    size = np.where(value == 0, 1.0, np.abs(value))
    scale = np.where((sigma > 0) & np.isfinite(sigma), sigma, 0.01 * size)
    names, units = tuple(row.name for row in rows), tuple(row.unit for row in rows)
    return ParameterSet(names, units, value, sigma, scale, lower, np.full(len(rows), np.inf))


def declared_parameters(geometry: Geometry) -> ParameterSet:
    """All physical parameters of the rigid balance: declared value and prior sigma (`tolerances` in docs/files.md)."""
    rows = _stiffness_rows(geometry) + _inertia_rows(geometry) + _damping_rows(geometry) + _sensitivity_rows(geometry)
    return parameter_set(rows)


def _stiffness_rows(geometry: Geometry) -> list[_ParameterRow]:
    tolerance = geometry.tolerances.stiffness
    rows = [
        _ParameterRow(f"stiffness.{cell.name}", "N/m", k, tolerance * k, 0.0)
        for cell, k in zip(geometry.cells, cell_stiffness(geometry), strict=True)
    ]
    for meter in geometry.shaft_meters:
        k = meter.stiffness
        rows.append(_ParameterRow(f"{meter.parameter}.stiffness", "N m/rad", k, tolerance * k, 0.0))
    return rows


def _inertia_rows(geometry: Geometry) -> list[_ParameterRow]:
    part, tolerances = metric_side(geometry), geometry.tolerances
    rows = [_ParameterRow("mass", "kg", part.mass, tolerances.mass * part.mass, 0.0)]
    rows += [
        _ParameterRow(f"centre_of_gravity.{axis}", "m", float(value), tolerances.centre_of_gravity)
        for axis, value in zip("xyz", part.centre_of_gravity, strict=True)
    ]
    tensor, axes = part.inertia, "xyz"
    for name in INERTIA_NAMES:
        i, j = axes.index(name[0]), axes.index(name[1])
        value = tensor[i, j] if i == j else -tensor[i, j]
        sigma = tolerances.inertia * float(np.sqrt(tensor[i, i] * tensor[j, j]))
        rows.append(_ParameterRow(f"inertia.{name}", "kg m2", float(value), sigma, 0.0 if i == j else -np.inf))
    for meter in geometry.shaft_meters:
        sigma = tolerances.inertia * meter.inertia
        rows.append(_ParameterRow(f"{meter.parameter}.inertia", "kg m2", meter.inertia, sigma, 0.0))
    return rows


def _damping_rows(geometry: Geometry) -> list[_ParameterRow]:
    zeta = geometry.modal_damping_ratio
    sigma = geometry.tolerances.damping_ratio * zeta
    rows = [_ParameterRow(f"damping_ratio.{i + 1}", "1", zeta, sigma, 0.0) for i in range(len(free_index(geometry)))]
    rows += [
        _ParameterRow(f"{meter.parameter}.damping_ratio", "1", zeta, sigma, 0.0) for meter in geometry.shaft_meters
    ]
    return rows


def _sensitivity_rows(geometry: Geometry) -> list[_ParameterRow]:
    tolerance = geometry.tolerances.sensitivity
    rows = []
    for channel in geometry.channels:
        sigma = tolerance * abs(channel.sensitivity)
        rows.append(_ParameterRow(f"sensitivity.{channel.name}", channel.sensitivity_unit, channel.sensitivity, sigma))
    return rows
