"""What the description of an effect leaves uncertain beside the noise of the lines.

A force that is computed from measured motion contains the noise of that motion (`SearchHints.inaccuracy`): a contact
reverses early or late. The likelihood does not contain it, so the size of such an effect is less certain than the lines
say.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.model.balance import BalanceModel
from balance_cli.model.effects.base import Effect
from balance_cli.model.placed_effects import declared_effects

Array = NDArray[np.float64]


def effect_inaccuracy(effect: Effect, batches: Sequence[Batch]) -> float:
    """Return the share of an effect's own signature that noise of the measured motion leaves uncertain in these runs.

    It is that of records that do not repeat as soon as there is one.
    """
    waveforms = [run.waveform for batch in batches for run in batch.runs if run.waveform is not None]
    return effect.search.inaccuracy[int(any(waveform.lines_are_bin_sums for waveform in waveforms))]


def effect_inaccuracy_variance(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> Array:
    """Return the variance (p,) that inaccurate descriptions add to the parameters `theta` (p,).

    It is that share of each size, squared; zero for nuisance parameters, which shape an effect and do not size it.
    """
    variance, free = np.zeros(len(theta)), model.parameters.free
    for effect in declared_effects(model.geometry):
        share = effect_inaccuracy(effect.effect, batches)
        for item in effect.parameters if share > 0 else ():
            place = model.parameters.index(effect.full_name(item))
            if free[place] and not item.nuisance:
                variance[place] = (share * (theta[place] - item.fitted_null)) ** 2
    return variance
