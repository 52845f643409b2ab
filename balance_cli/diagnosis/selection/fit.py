"""A maximum likelihood on all lines, and how much of the residual it leaves that noise does not make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.levenberg_marquardt import Minimum, prior_curvature
from balance_cli.estimation.maximum_likelihood import fit_maximum_likelihood, take_first_steps
from balance_cli.estimation.measurements import Batch
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

# Chi-square per degree of freedom that the uncertainty of the measured noise itself can make.
MAX_NOISE_CHI2_PER_DOF = 1.05
# Chi-square that a further step must promise where fits are compared.
COMPARISON_TOLERANCE = 0.1
# First steps of a fit, the scales that a parameter without a prior is held within, and what a step must promise.
START_STEPS = 10
MAX_START_SCALES = 3.0
MIN_STEP_GAIN = 0.3


@dataclass(frozen=True)
class Fit:
    """A model and its maximum likelihood on all lines."""

    model: BalanceModel
    minimum: Minimum

    @property
    def theta(self) -> Array:
        """The estimate."""
        return self.minimum.theta

    @property
    def chi2(self) -> float:
        """Chi-square of data and priors."""
        return self.minimum.total.chi2


def fit_all_lines(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], tolerance: float = COMPARISON_TOLERANCE
) -> Fit:
    """The maximum likelihood from `theta`, as near as a comparison of chi-squares needs it."""
    return Fit(model, fit_maximum_likelihood(model, batches, theta, tolerance=tolerance))


def start_fit(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> Fit:
    """The first steps of a fit, in which parameters without a prior stay near `theta`."""
    minimum = take_first_steps(model, theta, batches, START_STEPS, MAX_START_SCALES, MIN_STEP_GAIN)
    return Fit(model, replace(minimum, total=minimum.data + prior_curvature(model.parameters, minimum.theta)))


def unexplained_chi2(fit: Fit, batches: Sequence[Batch], noise_alone: bool) -> float:
    """Chi-square of the data that their noise does not make, and no effect of the model; zero where there is none.

    Under weights that carry a model error (not `noise_alone`) that is all of it.
    """
    if not noise_alone:
        return fit.minimum.data.chi2
    expected = sum(float(batch.efficiency @ batch.count) for batch in batches)
    return max(0.0, fit.minimum.data.chi2 - MAX_NOISE_CHI2_PER_DOF * expected)
