"""A calibration from a matrix that is stated, not measured here: one trim, the model of the matrix, no runs."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import Drift, GageCalibration, checked, rows_of
from balance_cli.calibration.math_model import GageModel
from balance_cli.calibration.matrix import model_of
from balance_cli.calibration.matrix_reader import StatedMatrix
from balance_cli.calibration.matrix_text import CHANNEL, COMPONENT, RIG
from balance_cli.calibration.noise import NoiseParts
from balance_cli.calibration.result import Calibration, Hysteresis, TrimCalibration
from balance_cli.calibration.static_matrices import inverse_matrix
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.plate import carried_components
from balance_cli.steps.calibrate import channel_full_range

Array = NDArray[np.float64]

MATRIX = "matrix"
"""Label of the one trim."""
ABSENT = "absent from the matrix"


def stated_calibration(stated: StatedMatrix, geometry: Geometry, hold_out: Sequence[Run] = ()) -> Calibration:
    """The calibration that a matrix states: C0 and T0 its straight part at zero load, and the model with all terms.

    What the matrix does not state is unknown: standard errors NaN, and no part of any sigma. The static runs of
    `hold_out` check it. Raises UserError where the matrix is of another rig, components or channels than the geometry.
    """
    _check_rig(stated, geometry)
    _check_components(stated, geometry)
    _check_channels(stated, geometry)
    model = model_of(stated.matrix)
    return Calibration(geometry, {MATRIX: _trim(model, geometry)}, _gage(model, hold_out))


def _check_rig(stated: StatedMatrix, geometry: Geometry) -> None:
    rig = stated.matrix.rig
    if rig and rig != geometry.rig:
        fault = f"is of rig `{rig[:60]}`, but the geometry `{geometry.name}` is of rig `{geometry.rig}`"
        raise _error(stated, RIG, fault, "Give the geometry of that rig, or a matrix of this one")


def _check_components(stated: StatedMatrix, geometry: Geometry) -> None:
    carried = carried_components(geometry)
    if stated.matrix.components != carried:
        fault = f"has {', '.join(stated.matrix.components)}, but the rig carries {', '.join(carried)}"
        raise _error(stated, COMPONENT, fault, "Write the matrix for these, in this order")


def _check_channels(stated: StatedMatrix, geometry: Geometry) -> None:
    constant = [channel.name for channel in geometry.channels if channel.measures_dc]
    for name in stated.matrix.channel_names:
        if name in constant:
            continue
        fault = f"`{name[:60]}` is no strain or torque channel of the geometry `{geometry.name}`"
        near = difflib.get_close_matches(name[:60], constant, n=1)
        remedy = f"Did you mean `{near[0]}`?" if near else f"It has {', '.join(constant)}"
        raise _error(stated, CHANNEL, fault, remedy)


def _error(stated: StatedMatrix, name: str, fault: str, remedy: str) -> UserError:
    return UserError(fault, place=f"line {stated.line[name]}, `{name}`", remedy=remedy)


def _trim(model: GageModel, geometry: Geometry) -> TrimCalibration:
    """The straight part about zero load, counted from the zeros."""
    k, c = len(model.components), len(model.channel_names)
    C0 = model.coefficients[:k].T / model.full_range
    S = model.residual_covariance
    T0 = inverse_matrix(C0, S)[0]
    unit = 1.0 / np.sqrt(np.diagonal(S))
    constant = [channel.name for channel in geometry.channels if channel.measures_dc]
    return TrimCalibration(
        trim=MATRIX,
        runs=(),
        rows=0,
        channel_names=model.channel_names,
        components=model.components,
        C0=C0,
        C0_sigma=np.full((c, k), np.nan),
        C0_covariance=np.zeros((c, k, c, k)),
        T0=T0,
        T0_sigma=np.full((k, c), np.nan),
        offsets=model.zeros,
        mean_load=np.zeros(k),
        mean_channels=model.zeros[0],
        residual_covariance=S,
        dof=int(model.dof.min()),
        noise_covariance=S,
        lack_of_fit=float("nan"),
        full_range=model.full_range,
        channel_full_range=channel_full_range(geometry, model.channel_names, model.components, model.full_range),
        residual=np.sqrt(np.diagonal(T0 @ S @ T0.T)),
        channel_residual=np.sqrt(np.diagonal(S)),
        hysteresis=Hysteresis(*(np.full(shape, np.nan) for shape in ((c, k), (c, k), (k,), (k,)))),
        condition=float(np.linalg.cond(unit[:, None] * C0 * model.full_range)),
        left_out={name: ABSENT for name in constant if name not in model.channel_names},
    )


def _gage(model: GageModel, hold_out: Sequence[Run]) -> GageCalibration:
    """The model without rows behind it; no noise of load readings is known."""
    k, c = len(model.components), len(model.channel_names)
    noise = NoiseParts(model.residual_covariance, np.zeros(k))
    names = (model.channel_names, model.components)
    return GageCalibration(
        model=model,
        runs=(),
        run=np.zeros(0, np.intp),
        loads=np.zeros((0, k)),
        residuals=np.zeros((0, c)),
        left_out=np.zeros((0, c)),
        drift=Drift(*(np.full(c, np.nan) for _ in range(3))),
        noise=noise,
        outliers=(),
        bad_sequences=(),
        checks=tuple(checked(model, noise, run.name, *rows_of(run, *names)) for run in hold_out),
    )
