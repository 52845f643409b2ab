"""The residual of a model: rms over its noise, by run, frequency band and channel."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.result import ResidualMap
from balance_cli.diagnosis.settings import ResidualMapSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.fit_quality import residual_variance
from balance_cli.estimation.likelihood import evaluate_batch
from balance_cli.estimation.recorded_loads import recorded_load_columns
from balance_cli.model.balance import Estimate
from balance_cli.model.system import System
from balance_cli.model.system_response import solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]


def residual_map(
    batches: Sequence[Batch], before: Estimate, after: Estimate, settings: ResidualMapSettings
) -> ResidualMap:
    """Return the residual of two estimates, given the measured loads.

    Transients, offsets and nonlinear forces are removed from it. Its variance is that of the channel noise and of the
    load noise through the model. Where there are means, the first band holds frequency zero. White residuals have no
    correlation between lines (Pintelon and Schoukens, System Identification, 2nd ed., chapter 11).
    """
    edges = _band_edges(batches, settings.bands)
    names = tuple(name for batch in batches for name in batch.run_names)
    stages = [_whiten(batches, estimate.system(derivatives=False)) for estimate in (before, after)]
    maps = [_rms(batches, whitened, edges) for whitened in stages]
    correlations = [_line_correlation(batches, whitened, settings.lags) for whitened in stages]
    return ResidualMap(
        names,
        before.geometry.channel_names,
        edges,
        before=maps[0],
        after=maps[1],
        excited=tuple(_excited_text(batch, part) for batch in batches for part in batch.parts),
        correlation_before=correlations[0][0],
        correlation_after=correlations[1][0],
        pairs=correlations[1][1],
    )


def _excited_text(batch: Batch, lines: slice) -> str:
    """The components that were excited in a run, joined by `+`; empty for a static run."""
    if batch.is_static:
        return ""
    loaded = np.any(batch.lines.loads[lines] != 0, axis=0)
    columns = batch.lines.components[lines][:1]
    return "+".join(COMPONENTS[i] for i in columns[:, loaded].ravel())


def _band_edges(batches: Sequence[Batch], bands: int) -> Array:
    """Edges (bands + 1,) [Hz] of bands with about equally many different frequencies, of lines that include sweeps."""
    frequency = np.unique(np.concatenate([batch.line_frequency for batch in batches]))
    moving = frequency[frequency > 0]
    groups = np.array_split(moving, min(bands, len(moving)))
    inner = [0.5 * (lower[-1] + upper[0]) for lower, upper in pairwise(groups)]
    at_rest = [0.0] if frequency[0] == 0.0 else []
    return np.array([*at_rest, moving[0], *inner, np.nextafter(moving[-1], np.inf)])


def _whiten(batches: Sequence[Batch], system: System) -> list[tuple[ComplexArray, Mask]]:
    return [_whitened_residual(batch, system) for batch in batches]


def _rms(batches: Sequence[Batch], whitened: Sequence[tuple[ComplexArray, Mask]], edges: Array) -> Array:
    """Rms (runs, bands, channels); NaN where there is nothing."""
    runs = sum(len(batch.run_names) for batch in batches)
    bands, c = len(edges) - 1, whitened[0][0].shape[1]
    total, count = np.zeros((runs * bands, c)), np.zeros((runs * bands, c))
    first = 0
    for batch, (residual, informed) in zip(batches, whitened, strict=True):
        band = np.searchsorted(edges, batch.line_frequency, side="right") - 1
        place = (first + batch.lines.run) * bands + band
        # A mean is real: the variance of a complex line is twice that of its real part.
        real = np.where(batch.line_frequency == 0.0, 2.0, 1.0)[:, None]
        np.add.at(total, place, real * np.abs(residual) ** 2)
        np.add.at(count, place, informed.astype(float))
        first += len(batch.run_names)
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
    return np.asarray(np.sqrt(mean).reshape(runs, bands, c))


def _line_correlation(
    batches: Sequence[Batch], whitened: Sequence[tuple[ComplexArray, Mask]], lags: int
) -> tuple[Array, Array]:
    """Size of the correlation (c, lags) between lines of one run, and the number of pairs; static runs have none."""
    c = whitened[0][0].shape[1]
    products, squares, pairs = np.zeros((c, lags), complex), np.zeros((c, lags)), np.zeros((c, lags))
    for batch, (residual, informed) in zip(batches, whitened, strict=True):
        for part in [] if batch.is_static else batch.parts:
            # An error of the model turns with the phase of the excitation, which a multisine draws by chance.
            values, known = residual[part] * _excitation_phase(batch, part).conj()[:, None], informed[part]
            for lag in range(1, min(lags, len(values) - 1) + 1):
                both = known[lag:] & known[:-lag]
                first, second = values[:-lag], values[lag:]
                products[:, lag - 1] += np.sum(np.where(both, first.conj() * second, 0.0), axis=0)
                power = 0.5 * (np.abs(first) ** 2 + np.abs(second) ** 2)
                squares[:, lag - 1] += np.sum(np.where(both, power, 0.0), axis=0)
                pairs[:, lag - 1] += both.sum(axis=0)
    correlation = np.divide(np.abs(products), squares, out=np.full((c, lags), np.nan), where=squares > 0)
    return correlation, pairs


def _excitation_phase(batch: Batch, lines: slice) -> ComplexArray:
    """Phase factor (k,) of the largest load of a run; loads in N and N m are compared as they are."""
    loads = batch.lines.loads[lines]
    largest = loads[:, int(np.argmax(np.sum(np.abs(loads) ** 2, axis=0)))]
    size = np.abs(largest)
    return np.asarray(np.where(size > 0, largest / np.where(size > 0, size, 1.0), 1.0))


def _whitened_residual(batch: Batch, system: System) -> tuple[ComplexArray, Mask]:
    """Residual over its standard deviation (K, c), and which channels (K, c) carry information."""
    solution = solve(system, batch.frequency, batch.spin)
    fit = evaluate_batch(batch, system, solution)
    informed = np.real(np.diagonal(batch.lines.precision, axis1=1, axis2=2)[:, : batch.lines.channels.shape[1]]) > 0
    columns = recorded_load_columns(batch, system, solution)
    variance = residual_variance(batch, columns, informed)
    whitened = np.where(informed, fit.residual / np.sqrt(np.where(informed, variance, 1.0)), 0.0)
    return np.asarray(whitened, complex), np.asarray(informed)


def describe_residual_location(residual: ResidualMap, settings: ResidualMapSettings) -> str:
    """Return one sentence with the runs, bands and channels that hold most of the residual `after`."""
    power = residual.after**2
    rms = float(np.sqrt(np.nanmean(power)))
    marginals = [_marginal(power, axis) for axis in range(3)]
    clear = any(_is_clear(power, axis, marginal, settings) for axis, marginal in enumerate(marginals))
    if not clear and np.nanmax(residual.after) < settings.clear_field:
        return f"Nothing beyond the noise (rms {rms:.2f} of it)."
    runs, bands, channels = (_largest_excess(marginal, settings.named_share) for marginal in marginals)
    all_bands = len(bands) == len(residual.edges) - 1
    described = ["all bands"] if all_bands else _describe_bands(residual.edges, bands)[: settings.max_named]
    run_names = _list_names([residual.runs[i] for i in runs], len(residual.runs), "runs", settings.max_named)
    channel_names = _list_names(
        [residual.channels[i] for i in channels], len(residual.channels), "channels", settings.max_named
    )
    return f"Rms {rms:.2f} of the noise; most in {run_names}, {', '.join(described)}, {channel_names}."


def _is_clear(power: Array, axis: int, marginal: Array, settings: ResidualMapSettings) -> bool:
    """Whether any of the marginal rms is larger than chance makes it."""
    others = tuple(i for i in range(3) if i != axis)
    values = settings.field_values * np.maximum(np.isfinite(power).sum(axis=others), 1)
    bound = np.maximum(settings.clear_rms, np.sqrt(1.0 + settings.sigma * np.sqrt(2.0 / values)))
    return bool(np.any(np.nan_to_num(marginal) > bound))


def _marginal(power: Array, axis: int) -> Array:
    """Rms over the two other axes; NaN where there is nothing."""
    others = tuple(i for i in range(3) if i != axis)
    count = np.isfinite(power).sum(axis=others)
    return np.asarray(np.sqrt(np.where(count > 0, np.nansum(power, axis=others) / np.maximum(count, 1), np.nan)))


def _largest_excess(marginal: Array, named_share: float) -> list[int]:
    """Indices of the largest excesses over the noise, in descending order."""
    excess = np.nan_to_num(marginal**2 - 1.0, nan=-1.0)
    order = np.argsort(-excess)
    return [int(i) for i in order if excess[i] >= named_share * max(excess[order[0]], 0.0) and excess[i] > 0]


def _describe_bands(edges: Array, bands: Sequence[int]) -> list[str]:
    """The bands in words, those of the largest excess first, adjacent ones joined."""
    groups: list[list[int]] = []
    for i in sorted(bands):
        if groups and groups[-1][-1] == i - 1 and edges[i - 1] > 0.0:
            groups[-1].append(i)
        else:
            groups.append([i])
    groups.sort(key=lambda group: min(bands.index(i) for i in group))
    return [
        "at rest" if edges[group[0]] == 0.0 else f"{edges[group[0]]:.4g} to {edges[group[-1] + 1]:.4g} Hz"
        for group in groups
    ]


def _list_names(names: Sequence[str], count: int, plural: str, max_named: int) -> str:
    """Some names of `count`; `all runs`, `most runs` where there are many of them."""
    if len(names) in (0, count) and count > 1:
        return f"all {plural}"
    if len(names) > max(count // 2, max_named):
        return f"most {plural}"
    shown = ", ".join(names[:max_named])
    return shown if len(names) <= max_named else f"{shown} and {len(names) - max_named} more {plural}"
