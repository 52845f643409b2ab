"""Measured lines of many runs, stacked and weighted, as the estimators use them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.estimation.static_lines import static_lines
from balance_cli.signals.covariance_pooling import inverse_bias_factor
from balance_cli.signals.run_spectrum import NoisePart, RunSpectrum, StaticPoints
from balance_cli.signals.waveform_types import AnalysisWindow, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Degrees of freedom per signal that make the inverse of an estimated covariance worth having.
MIN_DOF_PER_SIGNAL = 2.0
# Batches that are worked on at once.
WORKERS = 2
# Bytes above which memory is taken from the system, and its pages filled with zeros, for every array anew.
MAX_DERIVATIVE_BYTES = 2**25


@dataclass(frozen=True)
class Batch:
    """Lines of one rotor speed, all with the same number u of excited components and the same kind of weight.

    frequency (f,) are the different ones, `index` (K,) says which each line has; channels (K, c) [V]; loads (K, u);
    components (K, u) which of the six they are; precision (K, c+u, c+u), the inverse covariance of [channels, loads],
    zero where a channel is not live; `exact` where the loads carry no noise of their own; count (K,) real degrees of
    freedom of a line; run (K,) index into `runs`.

    `efficiency` (K,) is what weights from an estimated covariance are worth beside the true ones (see `_efficiency`).
    The precision holds it as a factor, so that the information says what the estimate is worth; chi-square against
    the noise is that of the precision divided by it.

    `noise_dof`: of each run, real degrees of freedom with which its noise is known. `noise_parts`: of each run, what
    that is made up of where its parts are not known alike, all channels in their order.
    `windows`: of each run, where a periodic record's lines come from; None where no free motion can be in them.
    constant_volts (K,), constant_loads (K, u) and `waveforms` as in `RunSpectrum`, all channels in their order.
    """

    runs: tuple[str, ...]
    spin: float
    frequency: Array
    index: Index
    channels: ComplexArray
    loads: ComplexArray
    components: Index
    precision: ComplexArray
    exact: bool
    count: Array
    run: Index
    efficiency: Array
    windows: tuple[AnalysisWindow | None, ...]
    constant_volts: Array
    constant_loads: Array
    waveforms: tuple[Waveform | None, ...]
    noise_dof: tuple[float, ...]
    noise_parts: tuple[tuple[NoisePart, ...], ...]

    @property
    def parts(self) -> tuple[slice, ...]:
        """The lines of each run; they stand together."""
        ends = np.cumsum(np.bincount(self.run, minlength=len(self.runs)))
        return tuple(slice(int(a), int(b)) for a, b in zip([0, *ends[:-1]], ends, strict=True))


def select_lines(batch: Batch, mask: NDArray[np.bool_]) -> Batch:
    """The batch with the `chosen` lines (K,) alone; every run keeps at least its name."""
    windows: list[AnalysisWindow | None] = []
    waveforms: list[Waveform | None] = []
    for part, window, waveform in zip(batch.parts, batch.windows, batch.waveforms, strict=True):
        kept = mask[part]
        windows.append(window.select(kept) if window is not None and kept.any() else None)
        waveforms.append(waveform.select(kept) if waveform is not None and kept.any() else None)
    noise_parts = zip(batch.parts, batch.noise_parts, strict=True)
    return replace(
        batch,
        **_per_line_fields(batch, mask),
        index=batch.index[mask],
        run=batch.run[mask],
        windows=tuple(windows),
        waveforms=tuple(waveforms),
        noise_parts=tuple(tuple(one.select(mask[part]) for one in several) for part, several in noise_parts),
    )


def _per_line_fields(batch: Batch, mask: NDArray[np.bool_] | slice) -> dict[str, Any]:
    """What the chosen lines hold; of a slice no copy is made."""
    values = ("channels", "loads", "constant_volts", "constant_loads")
    weights = ("components", "precision", "count", "efficiency")
    return {name: getattr(batch, name)[mask] for name in (*values, *weights)}


def split_by_run(batches: Sequence[Batch]) -> tuple[Batch, ...]:
    """Each run a batch of its own: smaller arrays where there are many derivatives."""
    return tuple(_batch_of_run(batch, i) for batch in batches for i in range(len(batch.runs)))


def split_large_batches(batches: Sequence[Batch], parameters: int) -> tuple[Batch, ...]:
    """The batches, run by run where the derivatives of one by so many parameters are too large to be kept at hand."""
    sizes = [batch.channels.nbytes * parameters for batch in batches]
    return tuple(
        part
        for batch, size in zip(batches, sizes, strict=True)
        for part in ([batch] if size <= MAX_DERIVATIVE_BYTES else split_by_run([batch]))
    )


def _batch_of_run(batch: Batch, i: int) -> Batch:
    lines = batch.parts[i]
    frequency, index = np.unique(batch.frequency[batch.index[lines]], return_inverse=True)
    return replace(
        batch,
        **_per_line_fields(batch, lines),
        runs=(batch.runs[i],),
        frequency=frequency,
        index=index.reshape(-1),
        run=np.zeros_like(index.reshape(-1)),
        windows=(batch.windows[i],),
        waveforms=(batch.waveforms[i],),
        noise_dof=(batch.noise_dof[i],),
        noise_parts=(batch.noise_parts[i],),
    )


def stack_runs(
    lines: Sequence[RunSpectrum], statics: Sequence[StaticPoints], channel_names: tuple[str, ...]
) -> tuple[Batch, ...]:
    """All runs as few batches: lines of alike runs share their frequencies and so the model's inversions.

    Of the static runs it is the straight part of the rows, or all of them where the points come with `share`.
    """
    everything = [*lines, *(static_lines(points) for points in statics)]
    groups: dict[tuple[float, int, bool], list[RunSpectrum]] = {}
    for run in everything:
        key = (run.rotor_speed, len(run.components), _has_exact_loads(run))
        groups.setdefault(key, []).append(run)
    parts = [(key, part) for key, group in groups.items() for part in _split_among_workers(group)]
    return tuple(_build_batch(part, key, channel_names) for key, part in parts)


def _split_among_workers(group: list[RunSpectrum]) -> list[list[RunSpectrum]]:
    """The runs in as many parts as there are workers, so that each has its own batch."""
    size = -(-len(group) // WORKERS)
    return [group[start : start + size] for start in range(0, len(group), size)]


def _has_exact_loads(lines: RunSpectrum) -> bool:
    c = len(lines.channel_names)
    return not np.any(lines.covariance[:, c:, c:])


def _build_batch(group: Sequence[RunSpectrum], key: tuple[float, int, bool], channel_names: tuple[str, ...]) -> Batch:
    spin, _, exact = key
    frequency, index = np.unique(np.concatenate([run.frequency for run in group]), return_inverse=True)
    run = np.repeat(np.arange(len(group)), [len(item.frequency) for item in group])
    counts = [_count_values(item) for item in group]
    efficiency = [np.full(len(item.frequency), _efficiency(item)) for item in group]
    return Batch(
        runs=tuple(item.run for item in group),
        spin=spin,
        frequency=frequency,
        index=index.reshape(-1),
        channels=np.concatenate([_expand_channels(item, channel_names) for item in group]),
        loads=np.concatenate([item.loads for item in group]),
        components=np.concatenate([_component_indices(item) for item in group]),
        precision=np.concatenate([_precision(item, channel_names, exact) for item in group]),
        exact=exact,
        count=np.concatenate(counts),
        run=run,
        efficiency=np.concatenate(efficiency),
        windows=tuple(item.window for item in group),
        constant_volts=np.concatenate([_constant_volts(item) for item in group]),
        constant_loads=np.concatenate([_constant_loads(item) for item in group]),
        waveforms=tuple(_expand_waveform(item, channel_names) for item in group),
        noise_dof=tuple(_noise_dof(item) for item in group),
        noise_parts=tuple(_expand_noise_parts(item, channel_names) for item in group),
    )


def _expand_noise_parts(lines: RunSpectrum, channel_names: tuple[str, ...]) -> tuple[NoisePart, ...]:
    """The parts of a run's noise, spread over all channels."""
    places, c = np.array(_channel_indices(lines, channel_names), np.intp), len(channel_names)
    found = []
    for part in lines.noise_parts:
        wide = np.zeros((c, c))
        wide[np.ix_(places, places)] = part.shape
        found.append(replace(part, shape=wide))
    return tuple(found)


def _noise_dof(lines: RunSpectrum) -> float:
    """Real degrees of freedom of all that a run tells of its noise: at rest those of its rows, else of every line."""
    return lines.dof if not lines.frequency.any() else 2.0 * max(lines.dof, len(lines.frequency))


def _count_values(lines: RunSpectrum) -> Array:
    per_channel = np.where(lines.frequency > 0, 2.0, 1.0)
    return np.asarray(
        per_channel * np.sum(_has_finite_variance(lines.covariance)[:, : len(lines.channel_names)], axis=1)
    )


def _has_finite_variance(covariance: ComplexArray) -> NDArray[np.bool_]:
    """Which signals (K, n) tell something at a line: their variance is finite."""
    return np.isfinite(np.diagonal(covariance, axis1=1, axis2=2))


def _constant_volts(lines: RunSpectrum) -> Array:
    return np.zeros(len(lines.frequency)) if lines.constant_volts is None else lines.constant_volts


def _constant_loads(lines: RunSpectrum) -> Array:
    return np.zeros(lines.loads.shape) if lines.constant_loads is None else lines.constant_loads


def _expand_waveform(lines: RunSpectrum, channel_names: tuple[str, ...]) -> Waveform | None:
    waveform = lines.waveform
    if waveform is None:
        return None
    volts = np.zeros((len(waveform.volts), len(channel_names)), complex)
    share = np.zeros(volts.shape)
    places = _channel_indices(lines, channel_names)
    volts[:, places], share[:, places] = waveform.volts, waveform.share
    return waveform.with_channels(volts, share)


def _component_indices(lines: RunSpectrum) -> Index:
    index = np.array([COMPONENTS.index(name) for name in lines.components], dtype=np.intp)
    return np.broadcast_to(index, (len(lines.frequency), len(index)))


def _channel_indices(lines: RunSpectrum, channel_names: tuple[str, ...]) -> list[int]:
    return [channel_names.index(name) for name in lines.channel_names]


def _expand_channels(lines: RunSpectrum, channel_names: tuple[str, ...]) -> ComplexArray:
    wide = np.zeros((len(lines.frequency), len(channel_names)), complex)
    wide[:, _channel_indices(lines, channel_names)] = lines.channels
    return wide


def _precision(lines: RunSpectrum, channel_names: tuple[str, ...], exact: bool) -> ComplexArray:
    """Inverse covariance, spread over all channels and the u loads."""
    live, c, u = len(lines.channel_names), len(channel_names), len(lines.components)
    used = slice(0, live) if exact else slice(0, live + u)
    noise = lines.window or lines
    inverse = _invert_covariance(
        _replace_infinite_variances(noise.covariance[:, used, used]), noise.dof, live
    ) * _efficiency(lines)
    inverse = np.where(_has_finite_variance(noise.covariance)[:, used, None], inverse, 0.0)
    wide = np.zeros((len(inverse), c + u, c + u), complex)
    places = np.array(_channel_indices(lines, channel_names) + ([] if exact else list(range(c, c + u))))
    wide[:, places[:, None], places[None, :]] = inverse
    return wide


def _replace_infinite_variances(covariance: ComplexArray) -> ComplexArray:
    """Covariances (K, n, n) with one in the place of an infinite variance."""
    heard = _has_finite_variance(covariance)
    if heard.all():
        return covariance
    finite = covariance.copy()
    diagonal = np.arange(covariance.shape[1])
    finite[:, diagonal, diagonal] = np.where(heard, finite[:, diagonal, diagonal], 1.0)
    return finite


def _efficiency(lines: RunSpectrum) -> float:
    """The share of the information that is left when a sample covariance takes the place of the true one.

    With P = (dof - n) W^-1, W complex Wishart, E[P] = C^-1 and E[P C P] = dof / (dof - n) C^-1 (Maiwald and Kraus,
    IEE Proc. Radar 147, 2000): an estimate weighted by P scatters more by that factor than its information says.
    """
    size = len(lines.channel_names)
    dof = (lines.window or lines).dof
    return inverse_bias_factor(dof, size) if dof > MIN_DOF_PER_SIGNAL * size else 1.0


def _invert_covariance(covariance: ComplexArray, dof: float, size: int) -> ComplexArray:
    """Unbiased inverse of covariances (K, n, n) that were estimated with `dof` degrees of freedom.

    With too few of them only the variances are known well enough to be inverted.
    """
    if dof > MIN_DOF_PER_SIGNAL * size:
        return np.asarray(np.linalg.inv(covariance) * inverse_bias_factor(dof, size), complex)
    variances = np.real(np.diagonal(covariance, axis1=1, axis2=2))
    factor = inverse_bias_factor(dof, 1) if dof > 1 else 1.0
    return np.asarray(factor / variances[:, :, None] * np.eye(variances.shape[1]), complex)
