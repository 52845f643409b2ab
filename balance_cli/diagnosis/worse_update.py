"""An update that describes the data worse than the model it began with is refused.

While a model has an error, its lines are weighted with it, run by run. Effects may then lose in some runs more than
they gain in others; against the measured noise they have explained nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from balance_cli.diagnosis.model_update import UpdateResult, effect_labels
from balance_cli.diagnosis.search.trials import last_round, refit_trial
from balance_cli.diagnosis.selection.confirm import score_again
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.model.balance import Estimate

REASON_WORSE = "with it the data are described worse than before the search"


def refuse_worse_update(
    start: Estimate, batches: Sequence[Batch], update: UpdateResult, settings: SearchSettings
) -> UpdateResult:
    """Return an update, without its effects where chi-square against the noise is larger with them than at the start.

    `start` is the estimate that was updated; `batches`: all lines, weighted by the noise.
    """
    added = sorted(effect_labels(update.fit) - effect_labels(start))
    before = data_chi2(batches, start.system(derivatives=False))
    after = data_chi2(batches, update.fit.system(derivatives=False))
    if not added or after <= before:
        return update
    fit = fit_all_lines(start, batches, settings.fit, settings.fit.contender_steps)
    number, loss = last_round(update.trials) + 1, before - after
    removed = tuple(refit_trial(number, label, loss, "removed", REASON_WORSE, 0, loss) for label in added)
    confirmation = score_again(update.confirmation, fit, batches, settings)
    return replace(
        update, fit=fit, effect_support={}, trials=(*update.trials, *removed), confirmation=confirmation, is_good=False
    )
