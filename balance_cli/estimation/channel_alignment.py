"""Alignment of the channels of one spring: their residual after the force that all of them read has been fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.regression_residual import (
    RegressionResidual,
    batched_least_squares,
    every_nth_line,
)
from balance_cli.model.channel_gains import channel_gains, log_gain_derivatives
from balance_cli.model.system import System

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def alignment_residual(batch: Batch, stride: int) -> Callable[[System], RegressionResidual]:
    """The residual of the channels of each spring, divided by their noise, with the force of the spring fitted."""
    lines = every_nth_line(batch, stride)
    weight = np.sqrt(batch.lines.channel_precision[lines])
    index, measured = batch.lines.index[lines], batch.lines.channels[lines] * weight

    def residual(system: System) -> RegressionResidual:
        gains = channel_gains(system.equations.paths, batch.frequency)[index]
        groups = _channels_of_springs(system)
        matrices = [weight[:, group, None] * gains[:, group, None] for group in groups]
        forces = [batched_least_squares(M, measured[:, group, None]) for M, group in zip(matrices, groups, strict=True)]
        errors = [measured[:, group] - (M @ f)[:, :, 0] for M, f, group in zip(matrices, forces, groups, strict=True)]

        def derivatives() -> ComplexArray:
            changes = gains[:, :, None] * log_gain_derivatives(system.equations.paths, batch.frequency)[index]
            parts = [
                _project_out(M, -weight[:, group, None] * changes[:, group] * f)
                for M, f, group in zip(matrices, forces, groups, strict=True)
            ]
            return _concatenate_columns([np.zeros((len(lines), 0, system.parameters), complex), *parts])

        return RegressionResidual(_concatenate_columns([np.zeros((len(lines), 0), complex), *errors]), derivatives)

    return residual


def _channels_of_springs(system: System) -> list[list[int]]:
    springs = system.springs_of_channels
    groups = [[i for i, spring in enumerate(springs) if spring == unique] for unique in dict.fromkeys(springs)]
    return [group for group in groups if len(group) > 1]


def _project_out(matrix: ComplexArray, change: ComplexArray) -> ComplexArray:
    """Derivatives (K, m, p) of the residual: the part of the change that is orthogonal to the force's columns."""
    return np.asarray(change - np.matmul(matrix, batched_least_squares(matrix, change)))


def _concatenate_columns(parts: Sequence[ComplexArray]) -> ComplexArray:
    return np.concatenate(parts, axis=1)
