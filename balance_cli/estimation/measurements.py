"""From the spectra of many runs to a few batches of weighted lines, all channels in their declared order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.estimation.batch import WORKERS, Batch, BatchLines, BatchRun
from balance_cli.estimation.noise_precision import has_finite_variance, live_precision, weight_efficiency
from balance_cli.estimation.static_lines import static_lines
from balance_cli.signals.run_spectrum import NoisePart, RunSpectrum, StaticPoints
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class _BatchKind:
    """What the runs of one batch have in common."""

    spin: float
    components: int
    has_exact_loads: bool
    is_static: bool


def stack_runs(
    lines: Sequence[RunSpectrum], statics: Sequence[StaticPoints], channel_names: tuple[str, ...]
) -> tuple[Batch, ...]:
    """All runs as few batches: lines of similar runs share their frequencies and so the model's inversions.

    A static run contributes the linear part of its rows, or all of them where the points come with `share`.
    """
    groups: dict[_BatchKind, list[RunSpectrum]] = {}
    spectra = [(run, False) for run in lines] + [(static_lines(points), True) for points in statics]
    for run, is_static in spectra:
        kind = _BatchKind(run.rotor_speed, len(run.components), _has_exact_loads(run), is_static)
        groups.setdefault(kind, []).append(run)
    parts = [(kind, part) for kind, group in groups.items() for part in _split_among_workers(group)]
    return tuple(_build_batch(part, kind, channel_names) for kind, part in parts)


def _split_among_workers(group: list[RunSpectrum]) -> list[list[RunSpectrum]]:
    """The runs in as many parts as there are workers, so that each has its own batch."""
    size = -(-len(group) // WORKERS)
    return [group[start : start + size] for start in range(0, len(group), size)]


def _has_exact_loads(lines: RunSpectrum) -> bool:
    c = len(lines.channel_names)
    return not np.any(lines.covariance[:, c:, c:])


def _build_batch(group: Sequence[RunSpectrum], kind: _BatchKind, channel_names: tuple[str, ...]) -> Batch:
    frequency, index = np.unique(np.concatenate([run.frequency for run in group]), return_inverse=True)
    lengths = [len(run.frequency) for run in group]
    efficiency = [np.full(length, weight_efficiency(run)) for run, length in zip(group, lengths, strict=True)]
    lines = BatchLines(
        index=index.reshape(-1),
        run=np.repeat(np.arange(len(group)), lengths),
        channels=np.concatenate([_expand_channels(run, channel_names) for run in group]),
        loads=np.concatenate([run.loads for run in group]),
        components=np.concatenate([_component_indices(run) for run in group]),
        constant_volts=np.concatenate([_constant_volts(run) for run in group]),
        constant_loads=np.concatenate([_constant_loads(run) for run in group]),
        precision=np.concatenate([_expand_precision(run, channel_names, kind.has_exact_loads) for run in group]),
        count=np.concatenate([_count_values(run) for run in group]),
        efficiency=np.concatenate(efficiency),
    )
    ends = np.cumsum(lengths)
    runs = tuple(
        _build_run(run, slice(int(end) - length, int(end)), channel_names)
        for run, length, end in zip(group, lengths, ends, strict=True)
    )
    return Batch(kind.spin, frequency, kind.has_exact_loads, kind.is_static, lines, runs)


def _build_run(spectrum: RunSpectrum, lines: slice, channel_names: tuple[str, ...]) -> BatchRun:
    return BatchRun(
        name=spectrum.run,
        lines=lines,
        window=spectrum.window,
        waveform=_expand_waveform(spectrum, channel_names),
        noise_dof=_noise_dof(spectrum),
        noise_parts=_expand_noise_parts(spectrum, channel_names),
    )


def _noise_dof(lines: RunSpectrum) -> float:
    """Real degrees of freedom of a run's noise estimate: those of its rows at rest, else at least two per line."""
    return lines.dof if not lines.frequency.any() else 2.0 * max(lines.dof, len(lines.frequency))


def _count_values(lines: RunSpectrum) -> Array:
    per_channel = np.where(lines.frequency > 0, 2.0, 1.0)
    has_information = has_finite_variance(lines.covariance)[:, : len(lines.channel_names)]
    return np.asarray(per_channel * np.sum(has_information, axis=1))


def _constant_volts(lines: RunSpectrum) -> Array:
    return np.zeros(len(lines.frequency)) if lines.constant_volts is None else lines.constant_volts


def _constant_loads(lines: RunSpectrum) -> Array:
    return np.zeros(lines.loads.shape) if lines.constant_loads is None else lines.constant_loads


def _component_indices(lines: RunSpectrum) -> Index:
    index = np.array([COMPONENTS.index(name) for name in lines.components], dtype=np.intp)
    return np.broadcast_to(index, (len(lines.frequency), len(index)))


# ---- from the channels of a run to all channels ----------------------------------------------------------------------


def _channel_indices(lines: RunSpectrum, channel_names: tuple[str, ...]) -> list[int]:
    return [channel_names.index(name) for name in lines.channel_names]


def _expand_channels(lines: RunSpectrum, channel_names: tuple[str, ...]) -> ComplexArray:
    expanded = np.zeros((len(lines.frequency), len(channel_names)), complex)
    expanded[:, _channel_indices(lines, channel_names)] = lines.channels
    return expanded


def _expand_precision(lines: RunSpectrum, channel_names: tuple[str, ...], has_exact_loads: bool) -> ComplexArray:
    """Precision (K, c+u, c+u) over all channels and the u loads."""
    c, u = len(channel_names), len(lines.components)
    inverse = live_precision(lines, has_exact_loads)
    expanded = np.zeros((len(inverse), c + u, c + u), complex)
    indices = np.array(_channel_indices(lines, channel_names) + ([] if has_exact_loads else list(range(c, c + u))))
    expanded[:, indices[:, None], indices[None, :]] = inverse
    return expanded


def _expand_waveform(lines: RunSpectrum, channel_names: tuple[str, ...]) -> Waveform | None:
    waveform = lines.waveform
    if waveform is None:
        return None
    volts = np.zeros((len(waveform.volts), len(channel_names)), complex)
    share = np.zeros(volts.shape)
    indices = _channel_indices(lines, channel_names)
    volts[:, indices], share[:, indices] = waveform.volts, waveform.share
    noise = None if waveform.noise is None else np.zeros(len(channel_names))
    if noise is not None:
        noise[indices] = waveform.noise
    return waveform.with_channels(volts, share, noise)


def _expand_noise_parts(lines: RunSpectrum, channel_names: tuple[str, ...]) -> tuple[NoisePart, ...]:
    indices, c = np.array(_channel_indices(lines, channel_names), np.intp), len(channel_names)
    parts = []
    for part in lines.noise_parts:
        shape = np.zeros((c, c))
        shape[np.ix_(indices, indices)] = part.shape
        parts.append(replace(part, shape=shape))
    return tuple(parts)
