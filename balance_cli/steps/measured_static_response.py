"""The static part of measured responses, extrapolated from their lowest lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from balance_cli.reduction.measured_response import TransferSource
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]

LINES_WITHIN = 3.0
"""The lines up to this multiple of the lowest one are used."""
BELOW_LOWEST_MODE = 0.5
"""Share of the computed lowest frequency up to which lines are used: there T(0) + a f^2 leaves the fourth power of it,
6 % of T(0), and by far less where the lines begin lower."""
LEAST_LINES = 3
"""One more than the two coefficients of a channel, so that no single line decides."""


def measured_static_response(source: TransferSource, geometry: Geometry) -> tuple[Array, Array, Array] | None:
    """Return T(0) (c, 6), its standard deviation, and what the extrapolation changed, of measured responses.

    T(f) = T(0) + a f^2 is fitted to the real part at the lowest lines. None where there are too few lines below the
    modes that are computed from the geometry, or these are not known.
    """
    highest = BELOW_LOWEST_MODE * _lowest_frequency(geometry)
    value, sigma, slack = np.zeros((3, len(source.channel_names), len(COMPONENTS)))
    for measured in source.responses:
        used = measured.frequency <= min(highest, LINES_WITHIN * measured.frequency[0])
        if np.sum(used) < LEAST_LINES:
            return None
        rows = [source.channel_names.index(name) for name in measured.channel_names]
        place = np.ix_(rows, [COMPONENTS.index(name) for name in measured.components])
        value[place], sigma[place], slack[place] = _extrapolate(measured, np.flatnonzero(used))
    return value, sigma, slack


def _extrapolate(measured: FrequencyResponse, used: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return T(0) (c, u), its standard deviation, and its difference from the lowest line."""
    square = measured.frequency[used] ** 2
    at_zero = np.linalg.pinv(np.stack([np.ones_like(square), square], axis=1))[0]
    T = measured.response[used].real
    channel, load = (
        np.diagonal(part[used], axis1=1, axis2=2).real
        for part in (measured.channel_covariance, measured.load_covariance)
    )
    variance = np.einsum("k,kc,ku->cu", at_zero**2, channel, load) / 2.0  # of the real part
    value = np.einsum("k,kcu->cu", at_zero, T)
    return value, np.sqrt(variance), np.abs(value - T[0])


def _lowest_frequency(geometry: Geometry) -> float:
    """Return the computed lowest eigenfrequency [Hz]; zero where the geometry does not determine it."""
    try:
        frequency = modes(balance_model(geometry).system()).frequency
    except (UserError, np.linalg.LinAlgError):
        return 0.0
    return float(np.min(frequency, initial=np.inf))
