"""`saturation`: a channel compresses large readings.

The channel reads v where a linear one would read u:

    v = tanh(u sqrt(c)) / sqrt(c),        u - v = c v^3 h(c v^2),        h(x) = (artanh(sqrt x) / sqrt x - 1) / x

with the compression c: the reading never exceeds 1 / sqrt(c), and a reading v is too small by c v^2 / 3 of itself while
that is small. Since v is recorded, u - v is known at every instant.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import channel_range
from balance_cli.model.effects.places import Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import ChannelDistortion, Equations

Array = NDArray[np.float64]

SMALL = 0.01
"""Compression that matters, relative to the reading at full range: a reading there is too small by 0.3 %."""
SERIES_LIMIT = 0.01
"""c v^2 below which h is summed as a power series: six terms of it leave 1e-13."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    scale = SMALL / channel_range(geometry, where[0]) ** 2
    description = "Inverse square of the largest reading."
    return (EffectParameter("compression", "1/V2", 0.0, scale, description, lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    channel = geometry.channel_names.index(where[0])
    return equations.with_distortion(ChannelDistortion(channel, stack([values["compression"]]), _lost_reading))


def _lost_reading(v: Array, values: Dual) -> Dual:
    """What the channel lacks (n,) over its compression. Raises LinAlgError where it reads more than it can."""
    square = v * v  # powers of arrays are a hundred times as slow
    x = values.value[0] * square
    if not np.all(x < 1.0):
        raise np.linalg.LinAlgError("a channel reads more than the largest reading of its saturation")
    h, slope = _loss_series(x), _loss_series_slope(x)
    cube = square * v
    return Dual(-cube * h, -(cube * square * slope) * values.derivative[:, :1])


def _loss_series(x: Array) -> Array:
    """h(x) (n,) = 1/3 + x/5 + x^2/7 + ..., for x >= 0."""
    if not x.any():  # the null, at which every channel is scored
        return np.full(x.shape, 1.0 / 3.0)
    series = sum(x**k / (2 * k + 3) for k in range(6))
    root = np.sqrt(np.maximum(x, SERIES_LIMIT))
    return np.asarray(np.where(x < SERIES_LIMIT, series, (np.arctanh(root) / root - 1.0) / root**2))


def _loss_series_slope(x: Array) -> Array:
    """Derivative of h (n,)."""
    if not x.any():
        return np.full(x.shape, 1.0 / 5.0)
    series = sum(k * x ** (k - 1) / (2 * k + 3) for k in range(1, 7))
    safe = np.maximum(x, SERIES_LIMIT)
    # x h + 1 = artanh(sqrt x) / sqrt x, whose derivative is (1 / (1 - x) - artanh(sqrt x) / sqrt x) / (2 x).
    closed = ((1.0 / (1.0 - safe) - (1.0 + safe * _loss_series(safe))) / (2.0 * safe) - _loss_series(safe)) / safe
    return np.asarray(np.where(x < SERIES_LIMIT, series, closed))


EFFECT = Effect(
    name="saturation",
    summary="A channel compresses large readings.",
    validity="Symmetric and without memory; soft, the reading follows a hyperbolic tangent. Samples at the end of a "
    "range are not compressed but clipped: such a channel is left out.",
    reference="Schoukens and Ljung, Nonlinear system identification, IEEE Control Systems 39 (2019) 28 (static "
    "nonlinearity of a sensor).",
    signature="One channel reads too little at high levels, in sweeps and static runs alike, and distortion appears "
    "in it alone.",
    separated_by="The other channel of the same cell, or sweeps at two levels: a cell that is nonlinear shows in all "
    "of its channels.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
)
