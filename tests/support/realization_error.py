"""How far a state space is from the response of the system that it realizes."""

import numpy as np

from balance_cli.model.system_response import response, solve


def realization_error(space, system, frequency):
    """Rms of the difference of the two responses over the rms of the system's own, at `frequency` (k,) [Hz].

    The responses of each load, then of each channel, are scaled to an rms of one, so that all have equal weight.
    """
    exact = response(system, solve(system, np.asarray(frequency, float)))
    load = _rms(exact, (0, 1))
    weight = load * _rms(exact / load, (0, 2))
    return float(np.linalg.norm((space.response(frequency) - exact) / weight) / np.linalg.norm(exact / weight))


def _rms(values, axes):
    """Root mean square over the axes; one where it vanishes."""
    rms = np.sqrt(np.mean(np.abs(values) ** 2, axis=axes, keepdims=True))
    return np.where(rms > 0, rms, 1.0)
