"""Derivatives of the channels' lines by the parameters, at the loads of every line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.cell_forces import RunCellForces
from balance_cli.estimation.channel_distortions import RunDistortions
from balance_cli.estimation.inner_products import LINES_AT_ONCE
from balance_cli.estimation.recorded_loads import attached_exciters, recorded_load_columns
from balance_cli.model.exciter_loads import true_load_derivatives, true_loads
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, response

ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

MAX_DISTINCT_SHARE = 0.7
"""Share of distinct frequencies and components among the lines above which derivatives per unit load do not pay."""


def channel_derivatives(
    batch: Batch,
    system: System,
    solution: Solution,
    loads: ComplexArray,
    nonlinear: Sequence[RunCellForces | RunDistortions],
) -> ComplexArray:
    """Derivatives dY (K, c, p) at the estimated exciter loads (K, 6).

    What the exciters' force cells do not measure, offsets and nonlinear forces are included.
    """
    derivatives = _load_derivatives(batch, system, solution, loads)
    for run in nonlinear:
        run.add_derivatives(system, derivatives[run.lines])
    _add_offset_derivatives(derivatives, batch, system, solution)
    return derivatives


def _load_derivatives(batch: Batch, system: System, solution: Solution, loads: ComplexArray) -> ComplexArray:
    """Derivatives (K, c, p) at the exciter loads (K, 6), to which they are proportional.

    Runs at two levels share those per unit load, where one component at a time is excited.
    """
    index, attached = batch.lines.index, attached_exciters(batch)
    if batch.lines.components.shape[1] != 1:
        return _derivatives_for_loads(system, solution, index, loads, attached, batch.is_static)
    component = batch.lines.components[:, 0]
    pairs, line_pairs = np.unique(6 * index + component, return_inverse=True)
    if len(pairs) > MAX_DISTINCT_SHARE * len(index):
        return _derivatives_for_loads(system, solution, index, loads, attached, batch.is_static)
    unit = np.eye(6, dtype=bool)[pairs % 6]
    per_load = _derivatives_for_loads(system, solution, pairs // 6, unit.astype(complex), unit, batch.is_static)
    derivatives = np.empty((len(index), *per_load.shape[1:]), complex)
    for start in range(0, len(index), LINES_AT_ONCE):
        lines = slice(start, start + LINES_AT_ONCE)
        load = np.take_along_axis(loads[lines], component[lines, None], axis=1)
        np.multiply(per_load[line_pairs[lines]], load[:, :, None], out=derivatives[lines])
    return derivatives


def _derivatives_for_loads(
    system: System, solution: Solution, index: Index, loads: ComplexArray, attached: Mask, is_static: bool
) -> ComplexArray:
    """Derivatives (K, c, p) at exciter loads (K, 6) and lines `index` (K,) of the solution."""
    place = (system, solution, index, loads, attached, is_static)
    derivatives = output_jacobian(system, solution, index, true_loads(*place))
    change = true_load_derivatives(*place)
    if change is not None:
        acting, of_loads = change
        derivatives[:, :, acting] += np.matmul(response(system, solution)[index], of_loads)
    return derivatives


def _add_offset_derivatives(derivatives: ComplexArray, batch: Batch, system: System, solution: Solution) -> None:
    """Add those by the offsets to `derivatives` (K, c, p), in place; an offset of a load lowers the load that acts."""
    if np.any(system.equations.channel_offset.derivative):
        lines = np.flatnonzero(batch.lines.constant_volts)
        derivatives[lines] += (
            batch.lines.constant_volts[lines, None, None] * system.equations.channel_offset.derivative.T
        )
    if np.any(system.equations.load_offset.derivative):
        lines = np.flatnonzero(np.any(batch.lines.constant_loads, axis=1))
        components = batch.lines.components[lines]
        columns = recorded_load_columns(batch, system, solution)[lines]
        offset = system.equations.load_offset.derivative.T[components] * batch.lines.constant_loads[lines, :, None]
        derivatives[lines] -= np.matmul(columns, offset)
