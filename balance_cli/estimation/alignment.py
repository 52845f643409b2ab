"""Channels of one spring against each other: what is left of them once the force that all read has been fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.linear_residual import Residual, every, precision, solved
from balance_cli.estimation.measurements import Batch
from balance_cli.model.channel_gains import channel_gains, log_gain_slopes
from balance_cli.model.system import System

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def alignment(batch: Batch, stride: int) -> Callable[[System], Residual]:
    """What is left of the channels of each spring once its force has been fitted to them, over their noise."""
    lines = every(batch, stride)
    weight = np.sqrt(precision(batch)[lines])
    index, measured = batch.index[lines], batch.channels[lines] * weight

    def residual(system: System) -> Residual:
        gains = channel_gains(system.paths, batch.frequency)[index]
        slopes = gains[:, :, None] * log_gain_slopes(system.paths, batch.frequency)[index]
        parts = [
            _projected(
                weight[:, mine, None] * gains[:, mine, None], measured[:, mine], weight[:, mine], slopes[:, mine]
            )
            for mine in _channels_of_springs(system)
        ]
        return _joined(parts, len(lines), system.parameters)

    return residual


def _channels_of_springs(system: System) -> list[list[int]]:
    springs = [path.spring for path in system.paths]
    groups = [[i for i, spring in enumerate(springs) if spring == one] for one in dict.fromkeys(springs)]
    return [group for group in groups if len(group) > 1]


def _projected(matrix: ComplexArray, measured: ComplexArray, weight: Array, slopes: ComplexArray) -> Residual:
    """The part of `measured` (K, m) that no force explains, and its slopes: the force times those of the gains."""
    force = solved(matrix, measured[:, :, None])[:, :, 0]
    error = measured - np.matmul(matrix, force[:, :, None])[:, :, 0]
    change = -weight[:, :, None] * slopes * force[:, :, None]
    return Residual(error, change - np.matmul(matrix, solved(matrix, change)))


def _joined(parts: Sequence[Residual], lines: int, p: int) -> Residual:
    nothing = Residual(np.zeros((lines, 0), complex), np.zeros((lines, 0, p), complex))
    whole = [nothing, *parts]
    return Residual(
        np.concatenate([item.error for item in whole], axis=1), np.concatenate([item.slope for item in whole], axis=1)
    )
