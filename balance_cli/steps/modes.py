"""Computed natural frequencies of the declared balance, and their sensitivity to each stiffness (paper, figure 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identified_model import ModeTable
from balance_cli.estimation.mode_table import mode_table
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ComputedModes:
    """Modes of the geometry, with sigma from its tolerances.

    `sensitivity` (m, s): relative change of each natural frequency per relative change of each of the s `stiffnesses`.
    The values of one mode add up to 1/2 where all springs of the balance are listed.
    """

    modes: ModeTable
    stiffnesses: tuple[str, ...]
    sensitivity: Array


def computed_modes(geometry: Geometry) -> ComputedModes:
    """Compute natural frequencies, shapes and their sensitivity to each cell and to each torque meter."""
    model = balance_model(geometry).with_exact_effects()
    parameters = model.parameters
    covariance = np.diag(parameters.sigma[parameters.free] ** 2)
    table = mode_table(model, parameters.value, covariance)
    names = tuple(name for name in parameters.names if "stiffness" in name)
    computed = modes(model.free_all_parameters().system())
    index = [parameters.index(name) for name in names]
    relative = computed.frequency_derivative[:, index] * parameters.value[index] / computed.frequency[:, None]
    return ComputedModes(table, tuple(_stiffness_place(name) for name in names), relative)


def _stiffness_place(name: str) -> str:
    """`stiffness.z1` -> `z1`, `torque_meter.stiffness` -> `torque_meter`."""
    return name.removeprefix("stiffness.").removesuffix(".stiffness")
