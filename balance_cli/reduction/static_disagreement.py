"""What calibration and model disagree on at rest: one load has two mean values.

The mean loads x follow from the readings C x by the calibration, whose weights hang at rest. The model of the response
gives the loads

    x' = (T' W T)^-1 T' W C x,        W = (covariance of a row of the calibration)^-1

for the same readings, with its own response T at rest. A gauge that creeps, a gain that was changed between
calibration and sweeps, or force cells of exciters that do not agree with the weights make them differ, and nobody knows
which of the two holds in the wind-on run. A significant difference is in sigma of the mean loads.

Only linear terms are compared: those of higher order, of the calibration and of the model, have no slope without load.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.model.system_response import response, solve
from balance_cli.reduction.mean_loads import MeanLoads
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.response_sources import ResponseSource

Array = NDArray[np.float64]

SIGNIFICANT = 4.0
"""Difference over its standard deviation from which it is none of chance: of six loads 1 in 2600 runs has more."""


@dataclass(frozen=True)
class _LinearReadings:
    """Readings of the calibration's channels (rows): C (c, k) per load, covariance (c, c) of a row and of C x."""

    channel_names: tuple[str, ...]
    C: Array
    row_covariance: Array
    covariance: Array


def add_static_disagreement(
    loads: MeanLoads, health: ChannelHealth, calibration: Calibration, source: ResponseSource
) -> MeanLoads:
    """Return mean loads with the difference from those by the model at rest in sigma, where it is significant."""
    if not isinstance(source, ModelSource) or not calibration.errors_known or not np.isfinite(loads.loads).all():
        return loads
    compared = _difference(loads, _linear_readings(loads, health, calibration), source)
    if compared is None or not np.any(np.abs(compared[0]) > SIGNIFICANT * compared[1]):
        return loads
    difference, sigma = compared
    worst = int(np.argmax(np.abs(difference) / np.hypot(sigma, loads.sigma)))
    name, by_model = loads.components[worst], loads.loads[worst] + difference[worst]
    note = (
        f"calibration and model differ at rest, the mean {name} by {difference[worst]:.2g} {UNIT_OF[name]} "
        f"({by_model:.5g} by the model): the differences are in sigma of the mean loads. Compare the weights with the "
        "force cells of the exciters, and check whether a gain was changed"
    )
    notes = "; ".join(filter(None, [loads.note, note]))
    return replace(loads, sigma=np.hypot(loads.sigma, difference), note=notes)


def _difference(loads: MeanLoads, readings: _LinearReadings, source: ModelSource) -> tuple[Array, Array] | None:
    """Mean loads by the model less those by the calibration, and sigma (k,); None where channels do not tell them."""
    columns = [COMPONENTS.index(name) for name in loads.components]
    rows = [source.model.geometry.channel_names.index(name) for name in readings.channel_names]
    T = response(source.system, solve(source.system, np.zeros(1)))[0].real[np.ix_(rows, columns)]
    if not has_independent_columns(T):
        return None
    W = np.linalg.inv(readings.row_covariance)
    G = np.linalg.solve(T.T @ W @ T, T.T @ W)
    applied = np.zeros((1, len(COMPONENTS)), complex)
    applied[0, columns] = loads.loads
    of_model = source.covariance(np.zeros(1), 0.0, applied)[0][np.ix_(rows, rows)]
    sigma = np.sqrt(np.diag(G @ (readings.covariance + of_model) @ G.T))
    return G @ (readings.C @ loads.loads) - loads.loads, sigma


def _linear_readings(loads: MeanLoads, health: ChannelHealth, calibration: Calibration) -> _LinearReadings:
    """The linear readings of the usable channels for the mean loads, by the model that gave these."""
    x, trim = loads.loads, calibration.trims.get(loads.trim)
    if trim is not None:
        rows = [i for i, name in enumerate(trim.channel_names) if name in health.live]
        names = tuple(trim.channel_names[i] for i in rows)
        of_C = np.einsum("ijkl,j,l->ik", trim.C0_covariance, x, x)
        at = np.ix_(rows, rows)
        return _LinearReadings(names, trim.C0[rows], trim.residual_covariance[at], of_C[at])
    assert calibration.all_trims is not None
    model = calibration.all_trims.loads_model
    rows = [i for i, name in enumerate(model.channel_names) if name in health.live]
    names, k = tuple(model.channel_names[i] for i in rows), len(model.components)
    scaled = x / model.calibrated_range
    variance = np.einsum("cij,i,j->c", model.covariance[rows, :k, :k], scaled, scaled)
    C = (model.coefficients[:k, rows] / model.calibrated_range[:, None]).T
    return _LinearReadings(names, C, model.residual_covariance[np.ix_(rows, rows)], np.diag(variance))
