"""Where a model leaves a residual: rms over its noise, by run, band of frequency and channel."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.result import ResidualMap
from balance_cli.estimation.fit_quality import residual_variance
from balance_cli.estimation.likelihood import evaluate_batch, exciter_response
from balance_cli.estimation.measurements import Batch
from balance_cli.model.balance import BalanceModel
from balance_cli.model.system import System, solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAP_BANDS = 30
# Rms of a run, band or channel that is more than noise, and that of a single field of the map; real values that a field
# holds at least, and sigma by which chance may lift their mean square.
CLEAR_RMS = 1.1
CLEAR_FIELD = 2.5
FEWEST_VALUES = 2
SIGMA = 4.0
# Of the largest excess in its direction, what makes a run, band or channel one of those where the residual is; and how
# many of them are named.
NAMED_SHARE = 0.3
MOST_NAMED = 3


def residual_map(
    batches: Sequence[Batch], before: tuple[BalanceModel, Array], after: tuple[BalanceModel, Array]
) -> ResidualMap:
    """The residual about the measured loads under two models, each with its parameters.

    Free motion, offsets and forces along the springs are taken out of it; its variance is that of the channels' noise
    and of the loads' through the model. The first band holds what is at frequency zero, where anything is.
    """
    edges = _edges(batches)
    names = tuple(name for batch in batches for name in batch.runs)
    maps = [_rms(batches, model.system(theta), edges) for model, theta in (before, after)]
    return ResidualMap(names, before[0].geometry.channel_names, edges, maps[0], maps[1])


def _edges(batches: Sequence[Batch]) -> Array:
    """Edges (bands + 1,) [Hz] between which about equally many different frequencies lie."""
    frequency = np.unique(np.concatenate([batch.frequency[batch.index] for batch in batches]))
    moving = frequency[frequency > 0]
    edges = np.empty(0)
    if len(moving):
        groups = np.array_split(moving, min(MAP_BANDS, len(moving)))
        inner = [0.5 * (one[-1] + other[0]) for one, other in pairwise(groups)]
        edges = np.array([moving[0], *inner, np.nextafter(moving[-1], np.inf)])
    at_rest = [0.0] if len(edges) else [0.0, np.finfo(float).tiny]
    return np.concatenate([at_rest, edges]) if frequency[0] == 0.0 else edges


def _rms(batches: Sequence[Batch], system: System, edges: Array) -> Array:
    """Rms (runs, bands, channels); NaN where there is nothing."""
    runs = sum(len(batch.runs) for batch in batches)
    bands, c = len(edges) - 1, len(system.channel_names)
    total, count = np.zeros((runs * bands, c)), np.zeros((runs * bands, c))
    first = 0
    for batch in batches:
        power, heard = _whitened_power(batch, system)
        band = np.searchsorted(edges, batch.frequency[batch.index], side="right") - 1
        place = (first + batch.run) * bands + band
        np.add.at(total, place, power)
        np.add.at(count, place, heard)
        first += len(batch.runs)
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
    return np.asarray(np.sqrt(mean).reshape(runs, bands, c))


def _whitened_power(batch: Batch, system: System) -> tuple[Array, Array]:
    """|residual|^2 over its variance (K, c), and which (K, c) channels tell something."""
    solution = solve(system, batch.frequency, batch.spin)
    fit = evaluate_batch(batch, system, solution)
    heard = np.real(np.diagonal(batch.precision, axis1=1, axis2=2)[:, : batch.channels.shape[1]]) > 0
    columns = exciter_response(system, solution)[batch.index[:, None], :, batch.components].swapaxes(1, 2)
    variance = residual_variance(batch, columns, heard)
    # Means are real: their noise, as that of complex lines, counts double.
    real = np.where(batch.frequency[batch.index] == 0.0, 2.0, 1.0)[:, None]
    power = np.where(heard, real * np.abs(fit.residual) ** 2 / np.where(heard, variance, 1.0), 0.0)
    return power, heard.astype(float)


def location(found: ResidualMap) -> str:
    """Where `after` leaves a residual: the runs, bands and channels that hold most of it, in one sentence."""
    power = found.after**2
    if not np.isfinite(power).any():
        return "No lines."
    whole = float(np.sqrt(np.nanmean(power)))
    by = [_marginal(power, axis) for axis in range(3)]
    if not any(_is_clear(power, axis, one) for axis, one in enumerate(by)) and np.nanmax(found.after) < CLEAR_FIELD:
        return f"Nothing beyond the noise (rms {whole:.2f} of it)."
    runs = [found.runs[i] for i in _largest_excess(by[0])]
    channels = [found.channels[i] for i in _largest_excess(by[2])]
    chosen = _largest_excess(by[1])
    bands = (
        "all bands"
        if len(chosen) == len(found.edges) - 1
        else ", ".join(_describe_bands(found.edges, chosen)[:MOST_NAMED])
    )
    return (
        f"Rms {whole:.2f} of the noise; most in {_list_names(runs, len(found.runs), 'runs')}, "
        f"{bands}, {_list_names(channels, len(found.channels), 'channels')}."
    )


def _is_clear(power: Array, axis: int, marginal: Array) -> bool:
    """Whether any of the marginal rms is more than chance, too, would have it."""
    others = tuple(i for i in range(3) if i != axis)
    values = FEWEST_VALUES * np.maximum(np.isfinite(power).sum(axis=others), 1)
    bound = np.maximum(CLEAR_RMS, np.sqrt(1.0 + SIGMA * np.sqrt(2.0 / values)))
    return bool(np.any(np.nan_to_num(marginal) > bound))


def _marginal(power: Array, axis: int) -> Array:
    """Rms over the two other directions; NaN where there is nothing."""
    others = tuple(i for i in range(3) if i != axis)
    count = np.isfinite(power).sum(axis=others)
    return np.asarray(np.sqrt(np.where(count > 0, np.nansum(power, axis=others) / np.maximum(count, 1), np.nan)))


def _largest_excess(marginal: Array) -> list[int]:
    """Those that hold the excess over the noise, the largest first."""
    excess = np.nan_to_num(marginal**2 - 1.0, nan=-1.0)
    order = np.argsort(-excess)
    return [int(i) for i in order if excess[i] >= NAMED_SHARE * max(excess[order[0]], 0.0) and excess[i] > 0]


def _describe_bands(edges: Array, chosen: Sequence[int]) -> list[str]:
    """Bands in words, those of the largest excess first, neighbours as one."""
    groups: list[list[int]] = []
    for i in sorted(chosen):
        if groups and groups[-1][-1] == i - 1 and edges[i - 1] > 0.0:
            groups[-1].append(i)
        else:
            groups.append([i])
    groups.sort(key=lambda group: min(chosen.index(i) for i in group))
    return [
        "at rest" if edges[one[0]] == 0.0 else f"{edges[one[0]]:.4g} to {edges[one[-1] + 1]:.4g} Hz" for one in groups
    ]


def _list_names(names: Sequence[str], count: int, what: str) -> str:
    """Some names; `all runs`, `most runs` where there are many of them."""
    if len(names) in (0, count) and count > 1:
        return f"all {what}"
    if len(names) > max(count // 2, MOST_NAMED):
        return f"most {what}"
    shown = ", ".join(names[:MOST_NAMED])
    return shown if len(names) <= MOST_NAMED else f"{shown} and {len(names) - MOST_NAMED} more {what}"
