"""Channels of one spring against each other: what is left of them once the force that all read has been fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.regression_residual import (
    RegressionResidual,
    batched_least_squares,
    every_nth_line,
    precision,
)
from balance_cli.model.channel_gains import channel_gains, log_gain_derivatives
from balance_cli.model.system import System

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def alignment_residual(batch: Batch, stride: int) -> Callable[[System], RegressionResidual]:
    """What is left of the channels of each spring once its force has been fitted to them, over their noise."""
    lines = every_nth_line(batch, stride)
    weight = np.sqrt(precision(batch)[lines])
    index, measured = batch.lines.index[lines], batch.lines.channels[lines] * weight

    def residual(system: System) -> RegressionResidual:
        gains = channel_gains(system.equations.paths, batch.frequency)[index]
        groups = _channels_of_springs(system)
        matrices = [weight[:, mine, None] * gains[:, mine, None] for mine in groups]
        forces = [batched_least_squares(M, measured[:, mine, None]) for M, mine in zip(matrices, groups, strict=True)]
        errors = [measured[:, mine] - (M @ f)[:, :, 0] for M, f, mine in zip(matrices, forces, groups, strict=True)]

        def derivatives() -> ComplexArray:
            changes = gains[:, :, None] * log_gain_derivatives(system.equations.paths, batch.frequency)[index]
            parts = [
                _project_out(M, -weight[:, mine, None] * changes[:, mine] * f)
                for M, f, mine in zip(matrices, forces, groups, strict=True)
            ]
            return _concatenate_columns([np.zeros((len(lines), 0, system.parameters), complex), *parts])

        return RegressionResidual(_concatenate_columns([np.zeros((len(lines), 0), complex), *errors]), derivatives)

    return residual


def _channels_of_springs(system: System) -> list[list[int]]:
    springs = [path.spring for path in system.equations.paths]
    groups = [[i for i, spring in enumerate(springs) if spring == one] for one in dict.fromkeys(springs)]
    return [group for group in groups if len(group) > 1]


def _project_out(matrix: ComplexArray, change: ComplexArray) -> ComplexArray:
    """Slopes (K, m, p) of what no force explains: the part of the change that is none of the force's."""
    return np.asarray(change - np.matmul(matrix, batched_least_squares(matrix, change)))


def _concatenate_columns(parts: Sequence[ComplexArray]) -> ComplexArray:
    return np.concatenate(parts, axis=1)
