"""Modes of an identified model with their uncertainty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.identified_model import ModeTable
from balance_cli.model.balance import BalanceModel
from balance_cli.model.modes import modes

Array = NDArray[np.float64]


def mode_table(model: BalanceModel, theta: Array, covariance: Array) -> ModeTable:
    """Modes at `theta` with sigma from the covariance of the free parameters."""
    computed = modes(model.system(theta))
    return ModeTable(
        coordinates=computed.coordinates,
        frequency=computed.frequency,
        damping_ratio=computed.damping_ratio,
        sigma_frequency=_propagate_sigma(computed.frequency_derivative, covariance),
        sigma_damping_ratio=_propagate_sigma(computed.damping_derivative, covariance),
        shape=computed.shape,
    )


def _propagate_sigma(jacobian: Array, covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.einsum("mp,pq,mq->m", jacobian, covariance, jacobian), 0.0)))
