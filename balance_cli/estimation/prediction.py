"""What a model predicts of the lines of a batch, before these are weighted: it does not depend on their precision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.cell_forces import RunCellForces, cell_forces
from balance_cli.estimation.channel_distortions import RunDistortions, channel_distortions
from balance_cli.estimation.recorded_loads import recorded_load_columns
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class BatchPrediction:
    """The predicted lines of a batch at one parameter vector, transients and interference not yet subtracted.

    `columns` T (K, c, u) per unit of the recorded loads; `loads` (K, u) are the measured ones without their offsets;
    `residual` (K, c) that of the channels about them; `nonlinear` as in `likelihood.BatchEvaluation`.
    """

    columns: ComplexArray
    loads: ComplexArray
    residual: ComplexArray
    nonlinear: tuple[RunCellForces | RunDistortions, ...]


def predict_batch(
    batch: Batch, system: System, solution: Solution, derivatives: bool, shared: SharedSolutions
) -> BatchPrediction:
    """Return what a system predicts; with `derivatives` the nonlinear forces come with theirs."""
    columns = recorded_load_columns(batch, system, solution)
    nonlinear: tuple[RunCellForces | RunDistortions, ...] = (
        *cell_forces(batch, system, solution, derivatives, shared),
        *channel_distortions(batch, system, derivatives),
    )
    loads = _subtract_load_offset(batch, system)
    residual = batch.lines.channels - np.matmul(columns, loads[:, :, None])[:, :, 0]
    if np.any(system.equations.channel_offset.value):
        residual -= batch.lines.constant_volts[:, None] * system.equations.channel_offset.value
    for run in nonlinear:
        residual[run.lines] -= run.volts(system)
    return BatchPrediction(columns, loads, residual, nonlinear)


def _subtract_load_offset(batch: Batch, system: System) -> ComplexArray:
    """The measured loads (K, u) without the offsets of the force cells."""
    if not np.any(system.equations.load_offset.value):
        return batch.lines.loads
    return np.asarray(
        batch.lines.loads - batch.lines.constant_loads * system.equations.load_offset.value[batch.lines.components]
    )
