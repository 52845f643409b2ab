"""The effect in one channel that describes what a channel reads, where all other data need no effect.

Without the channel the model describes the rest (`exclusions`), so that the channel's readings are known but for what
it does to them itself. The search, which begins with all data, fits the mechanics to a large distortion of one channel
before it can name it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from balance_cli.diagnosis.model_update import model_quality
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.model.balance import Estimate


def likely_channel_cause(
    rest: Estimate,
    channel: str,
    batches: Sequence[Batch],
    announce: Callable[[str], bool],
    settings: SearchSettings,
) -> str:
    """Return the label of the effect in one channel that describes its misfit; empty without any.

    `rest`: the model that describes all data but those of the channel; `batches`: all data. Effects are compared with
    the mechanics held, so that only a cause in the channel itself can take the misfit.
    """
    pool = [c for c in candidates(rest.geometry, excluded=settings.excluded) if c.placed_effect.where == (channel,)]
    fits = dict[str, Fit]()
    for candidate in pool:
        if announce(f"{candidate.label} beside all other data"):
            return ""
        fits[candidate.label] = _fit_effect_alone(rest, candidate, batches, settings)
    if not fits:
        return ""
    label = min(fits, key=lambda name: fits[name].chi2)
    start = extend_model(rest, fits[label].geometry).model.at(fits[label].theta)
    fit = fit_all_lines(start, batches, settings.fit)
    before, after = (model_quality(item, batches).chi2_per_dof for item in (rest, fit))
    largest = max(GOOD_FIT_CHI2_PER_DOF, settings.data_tests.exclusions.max_share_left * before)
    return label if after <= largest else ""


def _fit_effect_alone(rest: Estimate, candidate: Candidate, batches: Sequence[Batch], settings: SearchSettings) -> Fit:
    """The fit of the effect's parameters, with all others as the other data have them."""
    geometry = add_candidates(rest.geometry, [(candidate, 0)], at_start_values=True)
    start = extend_model(rest, geometry)
    parameters = start.model.parameters
    own = ~np.isin(parameters.names, rest.model.parameters.names)
    alone = start.model.with_sigma(np.where(own, parameters.sigma, 0.0))
    return fit_all_lines(alone.at(start.theta), batches, settings.fit, settings.fit.contender_steps)
