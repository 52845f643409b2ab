"""Maximum-likelihood fits on all lines, and the part of their chi-square that the noise does not explain."""

from __future__ import annotations

import operator
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.fit_settings import FitSettings
from balance_cli.estimation.batch import Batch, select_lines
from balance_cli.estimation.levenberg_marquardt import Minimum, predicted_decrease
from balance_cli.estimation.maximum_likelihood import ITERATIONS, fit_maximum_likelihood, take_first_steps
from balance_cli.model.balance import BalanceModel, Estimate


@dataclass(frozen=True)
class Fit(Estimate):
    """A model with its maximum-likelihood estimate on all lines, at which a minimization has ended.

    `reduced`: refits without one of its effects, by label, that were made of this fit, each with its lines and
    settings. Removal and comparison of effects ask for the same ones, which may take a minute each.
    """

    minimum: Minimum
    reduced: dict[str, ReducedFit] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def at_minimum(cls, model: BalanceModel, minimum: Minimum) -> Fit:
        """The fit of a model that has ended at this minimum."""
        return cls(model, minimum.theta, minimum)

    @property
    def chi2(self) -> float:
        """Chi-square of data and priors."""
        return self.minimum.total.chi2


@dataclass(frozen=True)
class ReducedFit:
    """A refit without an effect, and the lines and settings it was made with."""

    fit: Fit
    batches: tuple[Batch, ...]
    settings: FitSettings

    def is_of(self, batches: Sequence[Batch], settings: FitSettings) -> bool:
        """Whether it was made of these very lines, with the same settings."""
        is_same = len(batches) == len(self.batches) and all(map(operator.is_, batches, self.batches))
        return is_same and settings == self.settings


def fit_all_lines(
    start: Estimate, batches: Sequence[Batch], settings: FitSettings, iterations: int = ITERATIONS
) -> Fit:
    """Return the maximum-likelihood fit from a start, to the tolerance of chi-square in the settings."""
    model, tolerance, deadline = start.model, settings.comparison_tolerance, settings.deadline
    minimum = fit_maximum_likelihood(model, batches, start.theta, iterations, tolerance, deadline=deadline)
    return Fit.at_minimum(model, minimum)


def approach_on_some_lines(start: Estimate, batches: Sequence[Batch], settings: FitSettings) -> Estimate:
    """Return the end of a few steps from a start on every n-th line: a fit of all lines then takes few itself.

    It is the start itself where there are not many lines.
    """
    some = select_every_nth_line(batches, settings.coarse_lines)
    if all(map(operator.is_, some, batches)):
        return start
    steps, tolerance = settings.steps_before_valley, settings.min_step_gain
    minimum = fit_maximum_likelihood(start.model, some, start.theta, steps, tolerance, deadline=settings.deadline)
    return start.model.at(minimum.theta)


def select_every_nth_line(batches: Sequence[Batch], count: int) -> tuple[Batch, ...]:
    """Return about `count` lines, spread over the batches, or all where there are fewer than twice as many."""
    stride = sum(len(batch.lines.index) for batch in batches) // count
    if stride < 2:
        return tuple(batches)
    return tuple(select_lines(batch, _every_nth_line(batch, stride)) for batch in batches)


def _every_nth_line(batch: Batch, stride: int) -> NDArray[np.bool_]:
    """Every n-th line, but all of static runs and all means, whose information no other line has."""
    every_nth = np.arange(len(batch.lines.index)) % stride == 0
    return np.asarray(every_nth | batch.is_static | (batch.line_frequency == 0))


def continue_fit(fit: Fit, batches: Sequence[Batch], settings: FitSettings) -> Fit:
    """Return a fit of these lines, which has ended early, continued to the tolerance of chi-square in the settings."""
    tolerance, known = settings.comparison_tolerance, fit.minimum.data
    minimum = fit_maximum_likelihood(
        fit.model, batches, fit.theta, tolerance=tolerance, known=known, deadline=settings.deadline
    )
    return Fit.at_minimum(fit.model, minimum)


def fit_contenders(
    starts: Sequence[Estimate], batches: Sequence[Batch], limit: float, margin: float, settings: FitSettings
) -> list[Fit]:
    """Return the fits from several starts, finished only where they may be the best ones.

    After their first steps they are continued in the order of chi-square, each as far as the decrease that its
    linearization predicts would lead below `limit` and below the best one plus `margin`. Along a curved valley the
    prediction is far too large, so that no fit is given up too early that has taken its first steps.
    """
    fits = [fit_all_lines(start, batches, settings, settings.contender_steps) for start in starts]
    for i in sorted(range(len(fits)), key=lambda i: fits[i].chi2):
        within_reach = fits[i].chi2 - predicted_decrease(fits[i].minimum.total) <= limit
        if within_reach and not fits[i].minimum.converged:
            fits[i] = continue_fit(fits[i], batches, settings)
        limit = min(limit, fits[i].chi2 + margin)
    return fits


def start_fit(start: Estimate, batches: Sequence[Batch], settings: FitSettings) -> Fit:
    """Return the first steps of a fit, in which parameters without a prior stay near the start."""
    steps, scales, min_gain = settings.start_steps, settings.max_start_scales, settings.min_step_gain
    minimum = take_first_steps(start, batches, steps, scales, min_gain, deadline=settings.deadline)
    return Fit.at_minimum(start.model, minimum)


def unexplained_chi2(fit: Fit, batches: Sequence[Batch], error_runs: Collection[str], settings: FitSettings) -> float:
    """Return the part of chi-square that neither the noise nor the model explains; zero where there is none.

    Of `error_runs`, whose weights carry a model error, it is all of chi-square.
    """
    expected = sum(_expected_chi2(batch, error_runs) for batch in batches)
    return max(0.0, fit.minimum.data.chi2 - settings.max_noise_chi2_per_dof * expected)


def _expected_chi2(batch: Batch, error_runs: Collection[str]) -> float:
    """What the noise alone makes of the chi-square of the other runs."""
    has_noise_alone = ~np.isin(np.asarray(batch.run_names)[batch.lines.run], list(error_runs))
    return float(batch.lines.efficiency[has_noise_alone] @ batch.lines.count[has_noise_alone])
