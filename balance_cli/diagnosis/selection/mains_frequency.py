"""The frequency of a pick-up of the mains: along it chi-square has a minimum for every lobe of a record's spectrum.

A record of length T tells a frequency by a main lobe 2/T wide and lobes of half that beside it. A fit that begins with
an amplitude far too small steps over the main one and settles in another, for there chi-square falls, too. So the tone
is looked for at all frequencies near it, each with the amplitude that suits it best and the rest of the fit as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.estimation.likelihood import evaluate_batch as fitted_lines
from balance_cli.estimation.mains_interference import tone_magnitudes
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.estimation.measurements import Batch
from balance_cli.model.placed_effects import PlacedEffect, declared_effects
from balance_cli.model.system import solve

Array = NDArray[np.float64]

MAINS_EFFECT_NAME = "mains-pickup"
# How far from where a fit has settled [Hz], and how near each other: grids keep within 0.2 Hz, and the main lobe of a
# record of a minute is 0.03 Hz wide.
SEARCH_RANGE, SPACING = 0.5, 0.005
# Amplitudes that are tried at each, as factors of the one found.
FACTORS = np.geomspace(1 / 30, 30, 60)


def refit_at_best_frequency(fit: Fit, effects: Sequence[PlacedEffect], batches: Sequence[Batch]) -> Fit:
    """The fit itself, or a better one from the best frequency and amplitude of each of these pick-ups of the mains."""
    for label in [one.label for one in effects if one.effect.name == MAINS_EFFECT_NAME]:
        fit = _search_frequency(fit, label, batches)
    return fit


def _search_frequency(fit: Fit, label: str, batches: Sequence[Batch]) -> Fit:
    power, place = (fit.model.parameters.index(f"{label}.{name}") for name in ("amplitude^2", "frequency"))
    if not fit.model.parameters.free[[power, place]].all():
        return fit
    frequency = fit.theta[place] + np.arange(-SEARCH_RANGE, SEARCH_RANGE + 0.5 * SPACING, SPACING)
    amplitude = np.sqrt(max(float(fit.theta[power]), np.finfo(float).tiny)) * FACTORS
    chi2 = _chi2_grid(fit, label, batches, frequency, amplitude)
    at, size = np.unravel_index(np.argmin(chi2), chi2.shape)
    start = fit.theta.copy()
    start[place], start[power] = frequency[at], amplitude[size] ** 2
    if not penalized_chi2(fit.model, start, batches) < fit.chi2:
        return fit
    new = fit_all_lines(fit.model, start, batches)
    return new if new.chi2 < fit.chi2 else fit


def _chi2_grid(fit: Fit, label: str, batches: Sequence[Batch], frequency: Array, amplitude: Array) -> Array:
    """Chi-square (f, a) of all runs, less that without the tone: sum of a^2 n - 2 ln I0(a |b|)."""
    from scipy.special import i0e

    labels = [one.label for one in declared_effects(fit.model.geometry) if one.effect.name == MAINS_EFFECT_NAME]
    system = fit.model.system(fit.theta)
    pickup = system.interference_tones[labels.index(label)]
    total = np.zeros((len(frequency), len(amplitude)))
    for batch in batches:
        found = fitted_lines(batch, system, solve(system, batch.frequency, batch.spin))
        for tone in (one for one in found.mains_tones if one.interference is pickup):
            n, size = tone_magnitudes(batch, tone, found.residual[tone.form.lines], frequency)
            x = size[:, None] * amplitude
            total += n[:, None] * amplitude**2 - 2.0 * (x + np.log(i0e(x)))
    return total
