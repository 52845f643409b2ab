"""From a record to the sizes that a filter needs: noise of the channels, fluctuation and drift of the loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from balance_cli.model.state_space import StateSpace
from balance_cli.reduction.kalman.load_models import BandLimitedNoise, FirstOrderMarkov, LoadLayer, LowPassDrift
from balance_cli.reduction.kalman.whittle_likelihood import estimate_layer_variances
from balance_cli.signals.channel_noise import WINDOW_TIME, CleanRecord
from balance_cli.signals.cross_spectra import MAIN_LOBE, CrossSpectra, cross_spectra
from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]
Kind = Callable[[Array], LoadLayer]
"""A layer by its sizes (m,)."""

DRIFT_CORNERS = (0.1, 5.0)
"""Corner frequencies [Hz] of the layer that wanders."""
MIN_DRIFT_RATIO = 100.0
"""How much more of a load at rest is taken to wander than to fluctuate, at least."""
ROTOR_BAND = 40.0
"""Band [Hz] of a second layer that fluctuates, where the rotor's harmonics are to be held by random loads."""
NOISE_BANDS = (30.0, 70.0, 150.0)
"""Bands [Hz] of the layer that fluctuates, about the likeliest of which the best is looked for."""
MARKOV_CORNERS = (10.0, 40.0, 160.0)
"""Corner frequencies [Hz] of one that has no band, instead."""
SEARCH_STEPS = 4
"""Further bands or corners that are tried."""
UNINFORMATIVE_BAND = 150.0
"""Band [Hz] of loads of which nothing is known."""
LOW_FREQUENCY_WINDOW_FACTOR = 4.0
"""Length over that of windows for the lines below the first harmonic."""
BELOW_FIRST_HARMONIC = 0.7
"""Of the rotor's speed: lines below hold no harmonic."""
UNINFORMATIVE_FACTOR = 10.0
"""How much larger than it is a load of which nothing is to be known is said to be."""


def fit_random_loads(
    clean_record: CleanRecord, space: StateSpace, columns: Sequence[int], noise: Array
) -> tuple[LoadLayer, ...]:
    """Layers of random loads that stand for all that the rotor does, its harmonics too."""
    spectra = cross_spectra(clean_record.parts(), clean_record.step, clean_record.window(WINDOW_TIME))
    return _fit_layers(spectra, space, columns, noise, clean_record.step, (ROTOR_BAND,))


def uninformative_loads(random: Sequence[LoadLayer]) -> tuple[LoadLayer, ...]:
    """Loads of which nothing is said: white up to `UNINFORMATIVE_BAND`, and far larger than they are."""
    sigma = UNINFORMATIVE_FACTOR * np.sqrt(np.sum([layer.sigma**2 for layer in random], axis=0))
    return (BandLimitedNoise(np.maximum(sigma, 1e-3 * sigma.max()), UNINFORMATIVE_BAND),)


def fit_loads_between_harmonics(
    clean_record: CleanRecord, space: StateSpace, columns: Sequence[int], noise: Array, azimuth: Azimuth
) -> tuple[LoadLayer, ...]:
    """Layers of random loads for what the harmonics leave: of long windows the lines below the first harmonic, of

    short ones those that lie between the harmonics, as these are in that window.
    """
    short, long = clean_record.window(WINDOW_TIME), clean_record.window(LOW_FREQUENCY_WINDOW_FACTOR * WINDOW_TIME)
    above = cross_spectra(
        clean_record.parts(),
        clean_record.step,
        short,
        lambda first, f: _bins_between_harmonics(first, f, short, clean_record, azimuth),
    )
    low = cross_spectra(clean_record.parts(), clean_record.step, long)
    slowest = float(np.min(azimuth.speed(np.linspace(azimuth.first, azimuth.last, 256))))
    low = low.at(low.frequency < BELOW_FIRST_HARMONIC * slowest - MAIN_LOBE / (long * clean_record.step))
    together = CrossSpectra(
        np.concatenate([low.frequency, above.frequency]),
        np.concatenate([low.density, above.density]),
        np.concatenate([low.averages, above.averages]),
    )
    return _fit_layers(together, space, columns, noise, clean_record.step, ())


def _bins_between_harmonics(
    first: int, frequency: Array, length: int, clean_record: CleanRecord, azimuth: Azimuth
) -> NDArray[np.bool_]:
    """Lines of a window that are apart from all harmonics, however far the speed moves within it."""
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
    """A layer that wanders, layers of these bands, and one that fluctuates, of the likeliest kind and scale."""
    response = space.response(spectra.frequency)[:, :, list(columns)]
    found: list[tuple[float, tuple[LoadLayer, ...]]] = []
    last: list[Array] = []

    def misfit(fluctuating: Callable[[float], Kind], ln_scale: float) -> float:
        kinds = (_low_pass_drift, *(_band_limited_noise(band) for band in bands), fluctuating(float(np.exp(ln_scale))))
        shapes = np.stack([kind(np.ones(1)).spectrum(spectra.frequency)[:, 0] for kind in kinds])
        one = estimate_layer_variances(spectra, response, shapes, step, noise, last[-1] if last else None)
        last.append(one.values)
        layers = tuple(kind(size) for kind, size in zip(kinds, np.sqrt(one.values), strict=True))
        found.append((one.misfit, layers))
        return one.misfit

    for kind, scales in ((_band_limited_noise, NOISE_BANDS), (_first_order_markov, MARKOV_CORNERS)):
        _search_scale(partial(misfit, kind), np.log(scales))
    return _assign_mean_to_drift(min(found, key=lambda one: one[0])[1])


def _low_pass_drift(sigma: Array) -> LoadLayer:
    return LowPassDrift(sigma, *DRIFT_CORNERS)


def _band_limited_noise(band: float) -> Kind:
    return lambda sigma: BandLimitedNoise(sigma, band)


def _first_order_markov(corner: float) -> Kind:
    return lambda sigma: FirstOrderMarkov(sigma, corner)


def _search_scale(misfit: Callable[[float], float], tried: Array) -> None:
    """The likeliest of these, and then about it."""
    best = int(np.argmin([misfit(float(one)) for one in tried]))
    around = [float(tried[min(max(i, 0), len(tried) - 1)]) for i in (best - 1, best + 1)]
    minimize_scalar(misfit, bounds=(around[0], around[1]), method="bounded", options={"maxiter": SEARCH_STEPS})


def _assign_mean_to_drift(layers: tuple[LoadLayer, ...]) -> tuple[LoadLayer, ...]:
    """The same, what wanders made so large that a load at rest belongs to it, and not to what fluctuates.

    What fluctuates is forgotten within its band; a step that was taken for it would be, too.
    """
    drift_layer, *flats = layers
    at_rest = np.zeros(1)
    least = MIN_DRIFT_RATIO * np.sum([one.spectrum(at_rest)[0] for one in flats], axis=0)
    unit = LowPassDrift(np.ones(1), *DRIFT_CORNERS).spectrum(at_rest)[0, 0]
    return (LowPassDrift(np.maximum(drift_layer.sigma, np.sqrt(least / unit)), *DRIFT_CORNERS), *flats)
