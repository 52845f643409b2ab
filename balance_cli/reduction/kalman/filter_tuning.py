"""From a record to the sizes that a filter needs: noise of the channels, fluctuation and drift of the loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from balance_cli.model.state_space import StateSpace
from balance_cli.reduction.kalman.load_models import Flat, Gust, LoadLayer, Wandering
from balance_cli.reduction.kalman.whittle_likelihood import most_likely_variances
from balance_cli.signals.azimuth import Azimuth
from balance_cli.signals.channel_noise import WINDOW, Clean
from balance_cli.signals.cross_spectra import MAIN_LOBE, CrossSpectra, cross_spectra

Array = NDArray[np.float64]
Kind = Callable[[Array], LoadLayer]
"""A layer by its sizes (m,)."""

WANDERING = (0.1, 5.0)
"""Corner frequencies [Hz] of the layer that wanders."""
SLOW_FIRST = 100.0
"""How much more of a load at rest is taken to wander than to fluctuate, at least."""
ROTOR_BAND = 40.0
"""Band [Hz] of a second layer that fluctuates, where the rotor's harmonics are to be held by random loads."""
BANDS = (30.0, 70.0, 150.0)
"""Bands [Hz] of the layer that fluctuates, about the likeliest of which the best is looked for."""
CORNERS = (10.0, 40.0, 160.0)
"""Corner frequencies [Hz] of one that has no band, instead."""
STEPS = 4
"""Further bands or corners that are tried."""
FREE_BAND = 150.0
"""Band [Hz] of loads of which nothing is known."""
LONGER = 4.0
"""Length over that of windows for the lines below the first harmonic."""
BELOW_FIRST = 0.7
"""Of the rotor's speed: lines below hold no harmonic."""
UNINFORMED = 10.0
"""How much larger than it is a load of which nothing is to be known is said to be."""


def random_loads(clean: Clean, space: StateSpace, columns: Sequence[int], noise: Array) -> tuple[LoadLayer, ...]:
    """Layers of random loads that stand for all that the rotor does, its harmonics too."""
    spectra = cross_spectra(clean.parts(), clean.step, clean.window(WINDOW))
    return _layers(spectra, space, columns, noise, clean.step, (ROTOR_BAND,))


def free_loads(random: Sequence[LoadLayer]) -> tuple[LoadLayer, ...]:
    """Loads of which nothing is said: white up to `FREE_BAND`, and far larger than they are."""
    sigma = UNINFORMED * np.sqrt(np.sum([layer.sigma**2 for layer in random], axis=0))
    return (Flat(np.maximum(sigma, 1e-3 * sigma.max()), FREE_BAND),)


def loads_between_harmonics(
    clean: Clean, space: StateSpace, columns: Sequence[int], noise: Array, azimuth: Azimuth
) -> tuple[LoadLayer, ...]:
    """Layers of random loads for what the harmonics leave: of long windows the lines below the first harmonic, of

    short ones those that lie between the harmonics, as these are in that window.
    """
    short, long = clean.window(WINDOW), clean.window(LONGER * WINDOW)
    above = cross_spectra(clean.parts(), clean.step, short, lambda first, f: _between(first, f, short, clean, azimuth))
    low = cross_spectra(clean.parts(), clean.step, long)
    slowest = float(np.min(azimuth.speed(np.linspace(azimuth.first, azimuth.last, 256))))
    low = low.at(low.frequency < BELOW_FIRST * slowest - MAIN_LOBE / (long * clean.step))
    together = CrossSpectra(
        np.concatenate([low.frequency, above.frequency]),
        np.concatenate([low.density, above.density]),
        np.concatenate([low.averages, above.averages]),
    )
    return _layers(together, space, columns, noise, clean.step, ())


def _between(first: int, frequency: Array, length: int, clean: Clean, azimuth: Azimuth) -> NDArray[np.bool_]:
    """Lines of a window that are apart from all harmonics, however far the speed moves within it."""
    time = np.clip((first + length * np.array([0.0, 0.5, 1.0])) * clean.step, azimuth.first, azimuth.last)
    speed = azimuth.speed(time)
    order = np.maximum(np.rint(frequency / speed[1]), 1.0)
    reach = MAIN_LOBE / (length * clean.step) + order * np.abs(speed - speed[1]).max()
    return np.asarray((np.abs(frequency - order * speed[1]) > reach) & (frequency > BELOW_FIRST * speed[1]))


def _layers(
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
        kinds = (_wandering, *(_flat(band) for band in bands), fluctuating(float(np.exp(ln_scale))))
        shapes = np.stack([kind(np.ones(1)).spectrum(spectra.frequency)[:, 0] for kind in kinds])
        one = most_likely_variances(spectra, response, shapes, step, noise, last[-1] if last else None)
        last.append(one.values)
        layers = tuple(kind(size) for kind, size in zip(kinds, np.sqrt(one.values), strict=True))
        found.append((one.misfit, layers))
        return one.misfit

    for kind, scales in ((_flat, BANDS), (_gust, CORNERS)):
        _searched(partial(misfit, kind), np.log(scales))
    return _believed(min(found, key=lambda one: one[0])[1])


def _wandering(sigma: Array) -> LoadLayer:
    return Wandering(sigma, *WANDERING)


def _flat(band: float) -> Kind:
    return lambda sigma: Flat(sigma, band)


def _gust(corner: float) -> Kind:
    return lambda sigma: Gust(sigma, corner)


def _searched(misfit: Callable[[float], float], tried: Array) -> None:
    """The likeliest of these, and then about it."""
    best = int(np.argmin([misfit(float(one)) for one in tried]))
    around = [float(tried[min(max(i, 0), len(tried) - 1)]) for i in (best - 1, best + 1)]
    minimize_scalar(misfit, bounds=(around[0], around[1]), method="bounded", options={"maxiter": STEPS})


def _believed(layers: tuple[LoadLayer, ...]) -> tuple[LoadLayer, ...]:
    """The same, what wanders made so large that a load at rest belongs to it, and not to what fluctuates.

    What fluctuates is forgotten within its band; a step that was taken for it would be, too.
    """
    wandering, *flats = layers
    at_rest = np.zeros(1)
    least = SLOW_FIRST * np.sum([one.spectrum(at_rest)[0] for one in flats], axis=0)
    unit = Wandering(np.ones(1), *WANDERING).spectrum(at_rest)[0, 0]
    return (Wandering(np.maximum(wandering.sigma, np.sqrt(least / unit)), *WANDERING), *flats)
