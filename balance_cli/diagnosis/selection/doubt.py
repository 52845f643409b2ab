"""Effects that parts of the records disagree on, where a residual stays unexplained.

The gain of an effect beside a residual that no effect explains rests on that residual too: an exciter's mass took up
what a support that hardens had left. Its standard deviation takes the model for right. The parts of the records tell
more: each run, cut into bands, pulls the parameters of an effect by its own efficient score

    s_k = -J' g_k,      V_k = J' I_k J,      V = sum V_k

(J: the derivative of all parameters by those of the effect, the others following), and the scatter of the pulls is the
covariance of the estimate whatever the residual is (Huber, Proc. 5th Berkeley Symp. (1967) 221; White, Econometrica 50
(1982) 1):

    cov = V^-1 (sum u_k u_k') V^-1,      u_k = s_k - V_k V^-1 sum s

An effect that does not differ from nothing by this covariance is one that other parts of the records would not show.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.candidates import parameters_of_interest
from balance_cli.diagnosis.search.extended_models import free_names
from balance_cli.diagnosis.selection.cross_validation import parameter_sensitivity
from balance_cli.diagnosis.selection.fit import Fit
from balance_cli.diagnosis.settings import SelectionSettings
from balance_cli.estimation.batch import Batch, select_lines, split_by_run
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_curvature
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

Array = NDArray[np.float64]


def doubtful_effects(
    fit: Fit, labels: Collection[str], batches: Sequence[Batch], settings: SelectionSettings
) -> tuple[str, ...]:
    """Return those of the effects with these labels that the parts of the records do not agree on."""
    effects = [effect for effect in declared_effects(fit.geometry) if effect.label in labels]
    if not effects:
        return ()
    system = fit.system()
    parts = [data_curvature([part], system) for part in _parts(batches, settings.doubt_bands)]
    total = sum(parts, prior_curvature(fit.model.parameters, fit.theta))
    return tuple(effect.label for effect in effects if _is_doubtful(fit, effect, parts, total, settings))


def _parts(batches: Sequence[Batch], bands: int) -> Iterator[Batch]:
    """Each run in so many bands of about as many lines, fewer where it has few."""
    for batch in split_by_run(batches):
        lines = np.arange(len(batch.lines.index))
        for part in np.array_split(lines, min(bands, len(lines))):
            yield select_lines(batch, np.isin(lines, part))


def _is_doubtful(
    fit: Fit, effect: PlacedEffect, parts: Sequence[Curvature], total: Curvature, settings: SelectionSettings
) -> bool:
    items, free = parameters_of_interest(effect.parameters), free_names(fit.model)
    items = tuple(item for item in items if effect.full_name(item) in free)
    names = [effect.full_name(item) for item in items]
    J = parameter_sensitivity(total, np.array([free.index(name) for name in names], np.intp))
    s, V = np.array([-J.T @ part.gradient for part in parts]), np.array([J.T @ part.information @ J for part in parts])
    inverse = covariance_from_information(V.sum(axis=0))
    pull = s - V @ (inverse @ s.sum(axis=0))
    covariance = inverse @ (pull.T @ pull) @ inverse
    value = dict(zip(fit.model.parameters.names, fit.theta.tolist(), strict=True))
    departure = np.array([value[name] - item.fitted_null for name, item in zip(names, items, strict=True)])
    wald = float(departure @ covariance_from_information(covariance) @ departure)
    return wald < settings.doubt_sigma**2 * len(names)
