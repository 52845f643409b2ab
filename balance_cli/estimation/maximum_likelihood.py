"""Maximum likelihood of a balance model: output error with noise on channels and loads, and Gaussian priors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.gauss_newton import Minimum, minimise
from balance_cli.estimation.likelihood import data_chi2, data_curvature
from balance_cli.estimation.measurements import Batch
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]


def maximum_likelihood(model: BalanceModel, batches: Sequence[Batch], start: Array) -> Minimum:
    """Maximise the likelihood of the lines (errors on channels and loads) times the priors, from `start`."""
    return minimise(
        model.parameters,
        start,
        lambda theta: data_curvature(batches, model.system(theta)),
        lambda theta: data_chi2(batches, model.system(theta)),
    )
