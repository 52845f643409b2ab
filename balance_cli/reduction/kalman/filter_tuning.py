"""Tuning of the filters: variances and bandwidths of random loads, estimated from the spectra of the record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.state_space import StateSpace
from balance_cli.reduction.kalman.load_models import BandLimitedNoise, FirstOrderMarkov, LoadLayer, LowPassDrift
from balance_cli.reduction.kalman.whittle_likelihood import estimate_layer_variances
from balance_cli.signals.channel_noise import WINDOW_TIME, CleanRecord
from balance_cli.signals.cross_spectra import MAIN_LOBE, CrossSpectra, cross_spectra
from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]
Kind = Callable[[Array], LoadLayer]
"""Returns a layer for standard deviations (m,)."""

DRIFT_CORNERS = (0.1, 5.0)
"""Corner frequencies [Hz] of the low-pass drift: slow changes of some seconds, and no rotor harmonic above 5 Hz."""
MIN_DRIFT_RATIO = 100.0
"""Least ratio of the densities of drift and fluctuation at zero frequency: 99 % of a constant load is then drift."""
ROTOR_BAND = 40.0
"""Band [Hz] of a second layer where random loads must represent the rotor harmonics: 1/rev and 2/rev of 17.5 Hz."""
NOISE_BANDS = (30.0, 70.0, 150.0)
"""Bands [Hz] of the fluctuating layer; the search starts at the likeliest of them."""
MARKOV_CORNERS = (10.0, 40.0, 160.0)
"""Corner frequencies [Hz] of a fluctuating layer without band limit; the search starts at the likeliest."""
SEARCH_STEPS = 4
"""Further bands or corners that are tried: the likelihood is flat, and each costs a scoring."""
UNINFORMATIVE_BAND = 150.0
"""Band [Hz] of uninformative loads: 8/rev of a rotor at 17.5 Hz is 140 Hz."""
LOW_FREQUENCY_WINDOW_FACTOR = 4.0
"""Length of the windows for frequency bins below the first harmonic, over that of the others."""
LEAST_REVOLUTIONS = 16.0
"""Revolutions in a window: the main lobes of two harmonics, 4 bins to each side, then take half of the bins."""
BELOW_FIRST_HARMONIC = 0.7
"""Share of the rotor speed below which frequency bins contain no harmonic, for a speed that varies by up to 30 %."""
UNINFORMATIVE_FACTOR = 10.0
"""Standard deviation of uninformative loads over that of the loads: the prior then carries 1 % of the information."""


def fit_random_loads(
    clean_record: CleanRecord, space: StateSpace, columns: Sequence[int], noise: Array
) -> tuple[LoadLayer, ...]:
    """Return layers of random loads that represent all loads, the rotor harmonics included."""
    spectra = cross_spectra(clean_record.parts(), clean_record.step, clean_record.window(WINDOW_TIME))
    return _fit_layers(spectra, space, columns, noise, clean_record.step, (ROTOR_BAND,))


def uninformative_loads(random: Sequence[LoadLayer]) -> tuple[LoadLayer, ...]:
    """Return an uninformative prior: loads white up to `UNINFORMATIVE_BAND`, much larger than the random ones."""
    sigma = UNINFORMATIVE_FACTOR * np.sqrt(np.sum([layer.sigma**2 for layer in random], axis=0))
    return (BandLimitedNoise(np.maximum(sigma, 1e-3 * sigma.max()), UNINFORMATIVE_BAND),)


def fit_loads_between_harmonics(
    clean_record: CleanRecord, space: StateSpace, columns: Sequence[int], noise: Array, azimuth: Azimuth
) -> tuple[LoadLayer, ...]:
    """Return layers of random loads for the spectrum between the rotor harmonics.

    Below the first harmonic it comes from long windows, above from short ones, each without the frequency bins at the
    harmonics of the speed in that window.
    """
    slowest = float(np.min(azimuth.speed(np.linspace(azimuth.first, azimuth.last, 256))))
    window_time = max(WINDOW_TIME, LEAST_REVOLUTIONS / slowest)
    short, long = (clean_record.window(factor * window_time) for factor in (1.0, LOW_FREQUENCY_WINDOW_FACTOR))
    above = cross_spectra(
        clean_record.parts(),
        clean_record.step,
        short,
        lambda first, f: _bins_between_harmonics(first, f, short, clean_record, azimuth),
    )
    low = cross_spectra(clean_record.parts(), clean_record.step, long)
    low = low.at(low.frequency < BELOW_FIRST_HARMONIC * slowest - MAIN_LOBE / (long * clean_record.step))
    combined = CrossSpectra(
        np.concatenate([low.frequency, above.frequency]),
        np.concatenate([low.density, above.density]),
        np.concatenate([low.averages, above.averages]),
    )
    return _fit_layers(combined, space, columns, noise, clean_record.step, ())


def _bins_between_harmonics(
    first: int, frequency: Array, length: int, clean_record: CleanRecord, azimuth: Azimuth
) -> NDArray[np.bool_]:
    """Return which frequency bins of a window lie outside all harmonics for every speed within the window."""
    time = np.clip((first + length * np.array([0.0, 0.5, 1.0])) * clean_record.step, azimuth.first, azimuth.last)
    speed = azimuth.speed(time)
    order = np.maximum(np.rint(frequency / speed[1]), 1.0)
    reach = MAIN_LOBE / (length * clean_record.step) + order * np.abs(speed - speed[1]).max()
    return np.asarray((np.abs(frequency - order * speed[1]) > reach) & (frequency > BELOW_FIRST_HARMONIC * speed[1]))


def _fit_layers(
    spectra: CrossSpectra,
    space: StateSpace,
    columns: Sequence[int],
    noise: Array,
    step: float,
    bands: Sequence[float],
) -> tuple[LoadLayer, ...]:
    """Return a drift, layers of these bands, and one fluctuating layer of the likeliest kind and bandwidth."""
    response = space.response(spectra.frequency)[:, :, list(columns)]
    candidates: list[tuple[float, tuple[LoadLayer, ...]]] = []
    last: list[Array] = []

    def misfit(fluctuating: Callable[[float], Kind], ln_scale: float) -> float:
        kinds = (_low_pass_drift, *(_band_limited_noise(band) for band in bands), fluctuating(float(np.exp(ln_scale))))
        shapes = np.stack([kind(np.ones(1)).spectrum(spectra.frequency)[:, 0] for kind in kinds])
        variances = estimate_layer_variances(spectra, response, shapes, step, noise, last[-1] if last else None)
        last.append(variances.values)
        layers = tuple(kind(size) for kind, size in zip(kinds, np.sqrt(variances.values), strict=True))
        candidates.append((variances.misfit, layers))
        return variances.misfit

    for kind, scales in ((_band_limited_noise, NOISE_BANDS), (_first_order_markov, MARKOV_CORNERS)):
        _search_scale(partial(misfit, kind), np.log(scales))
    return _assign_mean_to_drift(min(candidates, key=lambda item: item[0])[1])


def _low_pass_drift(sigma: Array) -> LoadLayer:
    return LowPassDrift(sigma, *DRIFT_CORNERS)


def _band_limited_noise(band: float) -> Kind:
    return lambda sigma: BandLimitedNoise(sigma, band)


def _first_order_markov(corner: float) -> Kind:
    return lambda sigma: FirstOrderMarkov(sigma, corner)


def _search_scale(misfit: Callable[[float], float], ln_scales: Array) -> None:
    """Evaluate the misfit at these scales, and then at further ones between the neighbors of the best."""
    from scipy.optimize import minimize_scalar  # no other part of a reduction needs it

    best = int(np.argmin([misfit(float(ln_scale)) for ln_scale in ln_scales]))
    lower, upper = (float(ln_scales[min(max(i, 0), len(ln_scales) - 1)]) for i in (best - 1, best + 1))
    minimize_scalar(misfit, bounds=(lower, upper), method="bounded", options={"maxiter": SEARCH_STEPS})


def _assign_mean_to_drift(layers: tuple[LoadLayer, ...]) -> tuple[LoadLayer, ...]:
    """Return the layers with the drift so large that a constant load belongs to it, not to the fluctuation.

    A fluctuating layer decays within its correlation time, and so would a step of the load that is assigned to it.
    """
    drift, *fluctuations = layers
    zero_frequency = np.zeros(1)
    least = MIN_DRIFT_RATIO * np.sum([layer.spectrum(zero_frequency)[0] for layer in fluctuations], axis=0)
    unit = LowPassDrift(np.ones(1), *DRIFT_CORNERS).spectrum(zero_frequency)[0, 0]
    return (LowPassDrift(np.maximum(drift.sigma, np.sqrt(least / unit)), *DRIFT_CORNERS), *fluctuations)
