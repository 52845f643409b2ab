"""What the effects of a model are worth in chi-square, without a refit, and what cannot be told beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from balance_cli.diagnosis.search.candidates import parameters_of_interest
from balance_cli.diagnosis.selection.fit import Fit
from balance_cli.estimation.coordinates import coordinates
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.measurements import Batch
from balance_cli.model.placed_effects import PlacedEffect, declared_effects


def wald_statistic(fit: Fit, names: Iterable[str], nulls: Iterable[float]) -> tuple[float, int]:
    """Chi-square of parameters against their nulls, the others free to follow (Wald), and how many are known.

    In the coordinates of the fit, where no stiffness owes its sigma to the scale of the rig, which only priors know.
    """
    parameters, theta = fit.model.parameters, fit.theta
    null, tested_at = theta.copy(), [parameters.index(name) for name in names]
    null[tested_at] = list(nulls)
    to = coordinates(parameters, null)
    J = to.jacobian(theta)[np.ix_(parameters.free, parameters.free)]
    covariance = covariance_from_information(J.T @ fit.minimum.total.information @ J)
    departure = (to.to_coordinates(theta) - to.to_coordinates(null))[parameters.free]
    known = np.isin(np.flatnonzero(parameters.free), tested_at) & (np.diag(covariance) > 0)
    if not known.any():
        return 0.0, 0
    block, d = covariance[np.ix_(known, known)], departure[known]
    return float(d @ np.linalg.lstsq(block, d, rcond=1e-10)[0]), int(known.sum())


def effect_wald_statistic(fit: Fit, one: PlacedEffect) -> tuple[float, int]:
    """The same for all of an effect's parameters that do something by themselves."""
    items = parameters_of_interest(one.parameters)
    return wald_statistic(fit, [one.full_name(item) for item in items], [item.fitted_null for item in items])


def confounding_limit(fit: Fit, batches: Sequence[Batch]) -> tuple[float, str]:
    """Chi-square that an effect of the model may leave where it is known to a share of itself only, and its label.

    What gains no more beside it may be what is wrong with it.
    """
    waveforms = [waveform for batch in batches for waveform in batch.waveforms if waveform is not None]
    which = int(any(waveform.lines_are_bin_sums for waveform in waveforms))
    effects = [(one.effect.search.inaccuracy[which], one) for one in declared_effects(fit.model.geometry)]
    unknown = [(share**2 * effect_wald_statistic(fit, one)[0], one.label) for share, one in effects if share > 0]
    return max(unknown, default=(0.0, ""))
