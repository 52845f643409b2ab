"""Poles of measured responses: the modes that ring at the start of a record, where no model tells them.

The local models that interpolate a response have poles. Those of a mode are determined much better than its width;
those that describe noise or the flank of a mode elsewhere are not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from balance_cli.signals.local.window import denominator_errors, poles
from balance_cli.signals.response.window_models import LOCAL_LINES, WindowModel, window_models
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_SIGMA = 0.1
"""Standard deviation of a pole over its decay rate, up to which it is that of a mode: on five rigs poles of modes had
0.0002 to 0.1, others 0.1 to 200. A decay with a pole that is off by that much leaves 4 % of itself."""
SAME_MODE = 0.5
"""Distance of two poles over the smaller decay rate, below which they are two estimates of one mode."""
WINDOW_STEP = LOCAL_LINES // 2
"""Lines for whose poles a window is used, in its middle."""


def response_poles(responses: Sequence[FrequencyResponse]) -> tuple[complex, ...]:
    """Return the eigenvalues s [1/s] of the modes, in the upper half plane, that measured responses of a rig show.

    Each mode is taken from the response that determines it best. A mode that none determines is missing.
    """
    found = [pole for response in responses for pole in _determined_poles(response)]
    modes: list[complex] = []
    for _, s in sorted(found, key=lambda pole: pole[0]):
        if all(abs(s - other) > SAME_MODE * min(-s.real, -other.real) for other in modes):
            modes.append(s)
    return tuple(modes)


def _determined_poles(response: FrequencyResponse) -> Iterator[tuple[float, complex]]:
    """Yield the relative standard deviation and the value [1/s] of each pole of a mode."""
    lines, count = response.frequency, min(LOCAL_LINES, len(response.frequency))
    starts = np.arange(0, len(lines), WINDOW_STEP)
    first = np.clip(starts + WINDOW_STEP // 2 - count // 2, 0, len(lines) - count)
    ends = np.append(lines[starts[1:]], np.inf)
    models = window_models(response, first[:, None] + np.arange(count))
    for low, high, model in zip(lines[starts], ends, models, strict=True):
        s, sigma = _poles_of_window(response, model)
        inside = (s.imag >= 2.0 * np.pi * low) & (s.imag < 2.0 * np.pi * high)
        for k in np.flatnonzero(inside & (sigma < -LARGEST_SIGMA * s.real)):
            yield float(-sigma[k] / s[k].real), complex(s[k])


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
