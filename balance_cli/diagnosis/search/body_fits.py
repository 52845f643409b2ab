"""Whole fits of a non-metric side that begin with the modes which its measured motion shows.

The motion is what the rigid balance with the measured forces of the cells leaves (`estimation.non_metric_motion`). It
is a few percent wrong with the declared masses and cells, and shows the larger motions first; with the balance as the
first fit has it the others stand out, too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.refit import SearchState, regress_in_bands, whole_fit
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.non_metric_motion import body_modes, non_metric_motion
from balance_cli.model.balance import Estimate
from balance_cli.model.effects.search_hints import Start


def fit_by_measured_motion(
    candidate: Candidate, base: SearchState, lines: SearchLines, settings: SearchSettings
) -> SearchState | None:
    """Return the whole fit with a body from the modes that its motion shows; None where cells do not determine it.

    Of a support in four motions the first fit had three right, so that a second one begins with the balance as it is
    there.
    """
    first = _fit_under(base.model.at(), candidate, base, lines, settings)
    if first is None or first.error <= settings.rounds.large_error or settings.fit.is_over:
        return first
    second = _fit_under(extend_model(first, base.geometry), candidate, base, lines, settings)
    return first if second is None else min(first, second, key=lambda end: end.fit_criterion)


def _fit_under(
    balance: Estimate, candidate: Candidate, base: SearchState, lines: SearchLines, settings: SearchSettings
) -> SearchState | None:
    """The whole fit from the modes of the body under a balance; None where its motion is not determined."""
    start = _measured_start(candidate, balance, lines)
    return None if start is None else whole_fit(base, [replace(candidate, starts=(start,))], lines, settings)


def _measured_start(candidate: Candidate, balance: Estimate, lines: SearchLines) -> Start | None:
    """The first start of a candidate with the modes of the body under a balance without it."""
    body_start, first = candidate.effect.search.body_start, candidate.starts[0]
    motion = non_metric_motion(lines.fitted, balance.system(derivatives=False), len(balance.geometry.cells))
    if body_start is None or motion is None:
        return None
    center = np.array([first.get(axis, 0.0) for axis in "xyz"])
    return body_start(first, body_modes(motion.at(center), candidate.placed_effect.where))


def fit_by_bands(candidate: Candidate, base: SearchState, lines: SearchLines, settings: SearchSettings) -> SearchState:
    """Return the whole fit with a body that is regressed in widening bands, from its first start."""
    return whole_fit(base, [candidate], lines, settings, regress_in_bands)
