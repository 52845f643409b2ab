"""The frequency of a tone: along it chi-square has a minimum for every lobe of a record's spectrum.

A record of length T resolves a frequency by a main lobe 2/T wide and side lobes of half that width. A fit that begins
with far too small an amplitude steps over the main lobe and converges in a side lobe, where chi-square is lower than at
the start, too. Therefore the tone is searched at all frequencies near the fitted one, each with its best amplitude and
with all other parameters held.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.diagnosis.settings import MainsFrequencySettings, SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.likelihood import evaluate_batch
from balance_cli.estimation.mains_interference import MainsTone, tone_magnitudes, tone_noise_spread
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.model.effects.search_hints import ToneParameters
from balance_cli.model.placed_effects import PlacedEffect, declared_effects
from balance_cli.model.system_response import solve

Array = NDArray[np.float64]


def frequency_looks(fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], settings: SearchSettings) -> float:
    """Return by how many times the gain of a tone at its best frequency is likelier by chance; one for other effects.

    The frequency is not identifiable without the tone, and the gain is the largest of all that were looked at (Davies,
    Biometrika 64 (1977) 247): near each of its starts as many as a record resolves.
    """
    search = effect.effect.search
    if search.tone is None:
        return 1.0
    starts = len(search.starts(fit.geometry, effect.where)) if search.starts else 1
    lobes = 2.0 * settings.mains.search_range * _longest_record(batches)
    return max(1.0, starts * settings.mains.looks_per_lobe * lobes)


def independent_gain(gain: float, fit: Fit, effect: PlacedEffect, batches: Sequence[Batch]) -> float:
    """Return the gain of an effect of a fit as far as the noise of the lines is independent; less of a tone.

    In lines that share bins, noise in one bin agrees with a tone in all of them: a composite likelihood is divided by
    the variance of its score over its information (Varin, Reid and Firth, Statistica Sinica 21 (2011) 5).
    """
    if effect.effect.search.tone is None:
        return gain
    total, spread = 0.0, 0.0
    for batch, tone in _tones(fit, effect.label, batches):
        total += tone.n
        spread += tone.n * tone_noise_spread(batch, tone)
    return gain / max(1.0, spread / total) if total > 0.0 else gain


def _tones(fit: Fit, label: str, batches: Sequence[Batch]) -> Iterator[tuple[Batch, MainsTone]]:
    """The tone of an effect in each run, with its batch."""
    labels = [item.label for item in declared_effects(fit.geometry) if item.effect.search.tone is not None]
    system = fit.system()
    interference = system.equations.interference_tones[labels.index(label)]
    for batch in batches:
        lines = evaluate_batch(batch, system, solve(system, batch.frequency, batch.spin))
        yield from ((batch, tone) for tone in lines.mains_tones if tone.interference is interference)


def _longest_record(batches: Sequence[Batch]) -> float:
    """The longest time [s] over which a line was sampled; zero without a time axis."""
    longest = 0.0
    for batch in batches:
        for run in batch.runs:
            frequency = batch.line_frequency[run.lines]
            sampling = None if run.waveform is None else run.waveform.bin_sampling(frequency, run.window)
            if sampling is not None:
                longest = max(longest, float(sampling.step * sampling.count.max(initial=0)))
    return longest


def refit_at_best_frequency(
    fit: Fit, effects: Sequence[PlacedEffect], batches: Sequence[Batch], settings: SearchSettings
) -> Fit:
    """The fit, or a better one from the best frequency and amplitude of each tone among `effects`."""
    for placed_effect in effects:
        tone = placed_effect.effect.search.tone
        if tone is not None:
            fit = _search_frequency(fit, placed_effect, tone, batches, settings)
    return fit


def frequency_grid(fitted: float, effect: PlacedEffect, fit: Fit, settings: MainsFrequencySettings) -> Array:
    """Return the grid of frequencies (f,) [Hz] around the fitted one, and its start where a fit has left that.

    Where the noise of short records contains the tone, a fit from the start may end several lobes away.
    """
    centers, starts = [fitted], effect.effect.search.starts
    tone = effect.effect.search.tone
    if starts is not None and tone is not None:
        frequencies = [start[tone.frequency] for start in starts(fit.geometry, effect.where)]
        nearest = min(frequencies, key=lambda frequency: abs(frequency - fitted))
        centers += [nearest] if abs(nearest - fitted) > settings.max_departure else []
    reach = settings.search_range
    around = np.arange(-reach, reach + 0.5 * settings.spacing, settings.spacing)
    return np.concatenate([center + around for center in centers])


def _search_frequency(
    fit: Fit, effect: PlacedEffect, tone: ToneParameters, batches: Sequence[Batch], settings: SearchSettings
) -> Fit:
    """The fit, or the better one from the best point of the grid of frequencies and amplitudes of one tone."""
    label, grid = effect.label, settings.mains
    power, place = (fit.model.parameters.index(f"{label}.{name}") for name in (tone.power, tone.frequency))
    if not fit.model.parameters.free[[power, place]].all():
        return fit
    factors = np.geomspace(1 / grid.amplitude_range, grid.amplitude_range, grid.amplitude_count)
    frequency = frequency_grid(float(fit.theta[place]), effect, fit, grid)
    amplitude = np.sqrt(max(float(fit.theta[power]), np.finfo(float).tiny)) * factors
    chi2 = _chi2_grid(fit, label, batches, frequency, amplitude)
    best_frequency, best_amplitude = np.unravel_index(np.argmin(chi2), chi2.shape)
    theta = fit.theta.copy()
    theta[place], theta[power] = frequency[best_frequency], amplitude[best_amplitude] ** 2
    start = fit.model.at(theta)
    if not penalized_chi2(start, batches) < fit.chi2:
        return fit
    refit = fit_all_lines(start, batches, settings.fit)
    return refit if refit.chi2 < fit.chi2 else fit


def _chi2_grid(fit: Fit, label: str, batches: Sequence[Batch], frequency: Array, amplitude: Array) -> Array:
    """Chi-square (f, a) of all runs, less that without the tone: sum of a^2 n - 2 ln I0(a |b|)."""
    from scipy.special import i0e

    tones = [item.label for item in declared_effects(fit.geometry) if item.effect.search.tone is not None]
    system = fit.system()
    interference = system.equations.interference_tones[tones.index(label)]
    total = np.zeros((len(frequency), len(amplitude)))
    for batch in batches:
        lines = evaluate_batch(batch, system, solve(system, batch.frequency, batch.spin))
        for tone in lines.mains_tones:
            if tone.interference is not interference:
                continue
            n, magnitude = tone_magnitudes(batch, tone, lines.residual[tone.form.lines], frequency)
            x = magnitude[:, None] * amplitude
            total += n[:, None] * amplitude**2 - 2.0 * (x + np.log(i0e(x)))
    return total
