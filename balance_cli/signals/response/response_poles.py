"""Poles of measured responses: the modes that ring at the start of a record, where no model tells them.

The local models that interpolate a response have poles. Those of a mode are determined much better than its width;
those that describe noise or the flank of a mode elsewhere are not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from balance_cli.signals.local.window import denominator_errors, poles
from balance_cli.signals.response.window_models import LOCAL_LINES, WindowModel, window_models
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

LARGEST_SIGMA = 0.1
"""Standard deviation of a pole over its decay rate, up to which it is that of a mode: on five rigs poles of modes had
0.0002 to 0.1, others 0.1 to 200. A decay with a pole that is off by that much leaves 4 % of itself."""
SAME_MODE = 0.5
"""Distance of two poles over the smaller decay rate, below which they are two estimates of one mode."""
WINDOW_STEP = LOCAL_LINES // 2
"""Lines for whose poles a window is used, in its middle."""


@dataclass(frozen=True)
class ResponsePole:
    """An eigenvalue s [1/s] in the upper half plane, its standard deviation `sigma` [1/s], and its residue (c, u)."""

    s: complex
    sigma: float
    residue: ComplexArray


def response_poles(responses: Sequence[FrequencyResponse]) -> tuple[complex, ...]:
    """Return the eigenvalues s [1/s] of the modes, in the upper half plane, that measured responses of a rig show.

    Each mode is taken from the response that determines it best. A mode that none determines is missing.
    """
    return tuple(pole.s for _, pole in best_poles(responses))


def best_poles(responses: Sequence[FrequencyResponse]) -> tuple[tuple[FrequencyResponse, ResponsePole], ...]:
    """Return the pole of each mode with the response that determines it best."""
    found = [(response, pole) for response in responses for pole in determined_poles(response)]
    modes: list[tuple[FrequencyResponse, ResponsePole]] = []
    for response, pole in sorted(found, key=lambda item: -item[1].sigma / item[1].s.real):
        if all(abs(pole.s - other.s) > SAME_MODE * min(-pole.s.real, -other.s.real) for _, other in modes):
            modes.append((response, pole))
    return tuple(modes)


def determined_poles(response: FrequencyResponse, wanted: Index | None = None) -> Iterator[ResponsePole]:
    """Yield the poles of the modes that a response determines, by frequency; with `wanted`, those about these lines."""
    lines, count = response.frequency, min(LOCAL_LINES, len(response.frequency))
    starts = np.arange(0, len(lines), WINDOW_STEP)
    ends = np.append(lines[starts[1:]], np.inf)
    if wanted is not None:
        near = np.unique(np.clip(wanted // WINDOW_STEP + np.array([[-1], [0], [1]]), 0, len(starts) - 1))
        starts, ends = starts[near], ends[near]
    first = np.clip(starts + WINDOW_STEP // 2 - count // 2, 0, len(lines) - count)
    models = window_models(response, first[:, None] + np.arange(count))
    for low, high, model in zip(lines[starts], ends, models, strict=True):
        s, sigma = _poles_of_window(response, model)
        inside = (s.imag >= 2.0 * np.pi * low) & (s.imag < 2.0 * np.pi * high)
        for k in np.flatnonzero(inside & (sigma < -LARGEST_SIGMA * s.real)):
            residue = _residue(model, complex(s[k])).reshape(response.response.shape[1:])
            yield ResponsePole(complex(s[k]), float(sigma[k]), residue)


def _residue(model: WindowModel, s: complex) -> ComplexArray:
    """The residue (c u,) of the outputs of a window at a pole s [1/s], per 1/s."""
    position = (s / (2j * np.pi) - model.center) / model.half
    slope = legendre.legval(position, legendre.legder(model.fit.denominator))
    numerator = legendre.legval(position, model.fit.coefficients[: model.fit.orders.response + 1])
    return np.asarray(model.sigma * numerator / slope * (2j * np.pi * model.half))


def _poles_of_window(response: FrequencyResponse, model: WindowModel) -> tuple[ComplexArray, Array]:
    """Return the poles s (n,) [1/s] of a window, and their standard deviations."""
    fit, index, outputs = model.fit, model.index, len(model.sigma)
    position = poles(fit)
    if not len(position):
        return position, np.zeros(0)
    noise = np.einsum("kce,kuv->kcuev", response.channel_covariance[index], response.load_covariance[index])
    noise = noise.reshape(len(index), outputs, outputs) / (model.sigma[:, None] * model.sigma)
    slope = legendre.legval(position, legendre.legder(fit.denominator))
    rows = legendre.legvander(position, fit.orders.denominator) / slope[:, None]
    sigma = np.linalg.norm(rows @ denominator_errors(fit, noise).root, axis=1)
    return 2j * np.pi * (model.center + model.half * position), 2.0 * np.pi * model.half * sigma
