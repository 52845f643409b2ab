"""What a model misses of the measured responses: its error by frequency, component and channel, beyond the noise.

A model that does not fit its data has no claim on uncertainties that come from noise alone. The residual of each sweep
line, divided by the load that drove it, is the error of the model's response there, seen through the noise of the line:

    R_j(f) = (y - T u) / u_j

Around each frequency the mean of R_j R_j* over the lines less that of the noise estimates the covariance E_j(f) of the
error. In hub loads the errors of all channels act together, so the leading directions of E_j are kept, not a standard
deviation for each channel. A model that misses its data somewhere may miss them elsewhere by less than their noise:
what a few lines exceed their expected noise by counts in full, so that E is an upper value where noise dominates. A
model that describes all of its data to within their noise has no E; `identify` does not ask for it. A load that no
sweep applied tells nothing: the model is taken to miss its response by the same share as those of the others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.fit_quality import live_mask, residual_variance
from balance_cli.estimation.likelihood import evaluate_batch
from balance_cli.estimation.recorded_loads import recorded_load_columns
from balance_cli.estimation.response_error import ResponseError
from balance_cli.model.system import System
from balance_cli.model.system_response import load_response, solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BAND_RATIO = 1.06
"""Ratio of the centers of neighboring bands: a mode of 1 to 3 % damping is resolved, and a band holds several lines."""
FEWEST_LINES = 4
"""Lines of a band below which it takes in those of its neighbors."""
RANK = 3
"""Directions of E that are kept: one for a wrong mode, and two for what else is wrong near it."""


UNSWEPT_REACH = 1.5
"""Ratio of frequencies within which a load that no run applied may have modes like those that the model misses: the
lowest three of the rigs that were simulated lie within a factor of 1.1 to 2."""


@dataclass(frozen=True)
class Residuals:
    """Residual responses (k, c) of lines at (k,) [Hz] and their noise variance (k, c).

    The variance is zero where a row of the response was not measured.
    """

    frequency: Array
    response: ComplexArray
    variance: Array


def estimate_response_error(
    batches: Sequence[Batch], system: System, channel_names: tuple[str, ...]
) -> ResponseError | None:
    """Return the error of the system's response to each load in the lines of the batches; None where there is none."""
    parts = [part for batch in batches for part in _residuals_by_component(batch, system)]
    error = response_error_of_residuals(parts, channel_names)
    if error is None:
        return None
    return with_unswept_loads(error, load_response(system, error.frequency), {component for component, _ in parts})


def with_unswept_loads(error: ResponseError, response: ComplexArray, swept: Collection[int]) -> ResponseError:
    """Return the error with that of the loads that no run applied, by the `response` (b, c, 6) of the model.

    In each band it is the largest share of a response that is missed in the bands around it, because the modes that
    other loads excite lie elsewhere, and at least the rms of that share over all bands. Each channel has its own such
    error: nothing tells the direction.
    """
    unswept = [j for j in range(response.shape[2]) if j not in swept]
    if not unswept:
        return error
    size = np.linalg.norm(response, axis=1)
    missed = np.sqrt(np.sum(np.abs(error.factor) ** 2, axis=(2, 3)))
    share = (missed / np.where(size > 0.0, size, np.inf))[:, list(swept)].max(axis=1)
    around = np.abs(np.log(error.frequency[:, None] / error.frequency)) <= np.log(UNSWEPT_REACH)
    share = np.maximum(np.where(around, share, 0.0).max(axis=1), np.sqrt(np.mean(share**2)))
    bands, _, channels, _ = error.factor.shape
    assumed = np.zeros((bands, response.shape[2], channels, channels), complex)
    for j in unswept:
        assumed[:, j] = np.abs(response[:, :, j] * share[:, None])[:, :, None] * np.eye(channels)
    return replace(error, factor=np.concatenate([error.factor, assumed], axis=-1))


def response_error_of_residuals(
    parts: Sequence[tuple[int, Residuals]], row_names: tuple[str, ...]
) -> ResponseError | None:
    """Return the error of the rows of a response from the residuals of runs, each with the index of its load.

    None where no band exceeds its noise.
    """
    applied = sorted({component for component, _ in parts})
    if not applied:
        return None
    residuals = {j: _join([part for component, part in parts if component == j]) for j in applied}
    low = min(float(part.frequency.min()) for part in residuals.values())
    high = max(float(part.frequency.max()) for part in residuals.values())
    centers = low * BAND_RATIO ** np.arange(max(1, int(np.ceil(np.log(high / low) / np.log(BAND_RATIO))) + 1))
    factor = np.zeros((len(centers), 6, len(row_names), RANK), complex)
    for j, part in residuals.items():
        for i, center in enumerate(centers):
            factor[i, j] = _band_factor(part, center)
    return ResponseError(row_names, np.asarray(centers), factor) if np.any(factor) else None


def _residuals_by_component(batch: Batch, system: System) -> list[tuple[int, Residuals]]:
    """Return component and residual responses for each excited load of a batch.

    Where several loads act at once, the residual is divided among them in proportion to what each contributes.
    """
    solution = solve(system, batch.frequency, batch.spin)
    residual = evaluate_batch(batch, system, solution).residual
    columns = recorded_load_columns(batch, system, solution)
    live = live_mask(batch)
    variance = np.where(live, residual_variance(batch, columns, live), 0.0)
    power = np.abs(batch.lines.loads) ** 2
    share = power * np.sum(np.abs(columns) ** 2, axis=1)
    share = np.sqrt(share / np.maximum(share.sum(axis=1, keepdims=True), np.finfo(float).tiny))
    parts = []
    for column in range(batch.lines.components.shape[1]):
        for j in np.unique(batch.lines.components[:, column]):
            selection = (batch.lines.components[:, column] == j) & (batch.line_frequency > 0) & (power[:, column] > 0)
            if not selection.any():
                continue
            scale = (share[selection, column] / np.sqrt(power[selection, column]))[:, None]
            response = np.where(live[selection], residual[selection], 0.0) * scale
            parts.append((int(j), Residuals(batch.line_frequency[selection], response, variance[selection] * scale**2)))
    return parts


def _join(parts: Sequence[Residuals]) -> Residuals:
    return Residuals(
        np.concatenate([part.frequency for part in parts]),
        np.concatenate([part.response for part in parts]),
        np.concatenate([part.variance for part in parts]),
    )


def _band_factor(part: Residuals, center: float) -> ComplexArray:
    """Return the leading directions (c, r) of the error in the band about a frequency."""
    distance = np.abs(np.log(part.frequency / center))
    inside = distance <= max(0.5 * np.log(BAND_RATIO), float(np.sort(distance)[min(FEWEST_LINES, len(distance)) - 1]))
    response, variance = part.response[inside], part.variance[inside]
    lines = np.maximum((variance > 0).sum(axis=0), 1)
    sigma = np.sqrt(variance.sum(axis=0) / lines)
    directions = _directions_beyond_noise(response / np.where(sigma > 0, sigma, np.inf), lines)
    return np.asarray(directions * sigma[:, None])


def _directions_beyond_noise(whitened: ComplexArray, lines: Array) -> ComplexArray:
    """Return the directions (c, r) in which lines (k, c) in units of their noise exceed its mean, and by how much.

    The eigenvalues of noise alone reach (1 + sqrt(c / k))^2 (Marchenko and Pastur, 1967). To count from there would
    leave out errors as large as the noise of a line, which hub loads then have without any sigma.
    """
    values, vectors = np.linalg.eigh(whitened.T @ whitened.conj() / np.sqrt(np.outer(lines, lines)))
    size = np.sqrt(np.maximum(values - 1.0, 0.0))[::-1][:RANK]
    directions = np.zeros((whitened.shape[1], RANK), complex)
    directions[:, : len(size)] = vectors[:, ::-1][:, :RANK] * size
    return directions
