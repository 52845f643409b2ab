"""Responses of the channels per unit of the recorded loads, with all that lies between these and the true ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.estimation.batch import Batch
from balance_cli.model.exciter_loads import true_load_matrices
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, response

ComplexArray = NDArray[np.complex128]


def recorded_load_columns(batch: Batch, system: System, solution: Solution) -> ComplexArray:
    """T (K, c, u) of each line per unit of its recorded loads, with all that lies between these and the true ones."""
    index, components = batch.lines.index, batch.lines.components
    T = response(system, solution)
    matrices = true_load_matrices(system, solution, index, attached_exciters(batch), batch.is_static)
    if matrices.ndim == 2:
        return np.asarray((T @ matrices)[index[:, None], :, components].swapaxes(1, 2))
    return np.asarray(T[index] @ np.take_along_axis(matrices, components[:, None, :], axis=2))


def attached_exciters(batch: Batch) -> NDArray[np.bool_]:
    """Return the components (K, 6) whose exciters are attached: those that are excited in the run of each line."""
    attached = np.zeros((len(batch.lines.index), 6), bool)
    np.put_along_axis(attached, batch.lines.components, True, axis=1)
    return attached


def swept_components(batches: Sequence[Batch]) -> frozenset[str]:
    """Return the load components that some sweep applied."""
    columns = set[int]()
    for batch in batches:
        is_applied = (np.abs(batch.lines.loads) > 0) & (batch.line_frequency > 0)[:, None]
        columns.update(np.unique(batch.lines.components[is_applied]).tolist())
    return frozenset(COMPONENTS[j] for j in columns)
