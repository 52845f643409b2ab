"""Leaving out one channel or one run, where the rest of the data then needs no effect.

A channel with a loose contact, or a run in which something slipped, is no property of the rig. Where no set of effects
describes all data, the model from before the search is fitted to the data without the channel or run that holds most of
its residual. It is left out if the rest is then described within its noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.model_update import UpdateResult, is_good_fit, model_quality
from balance_cli.diagnosis.result import CHANNEL, RUN, LeftOut, ResidualMap
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.search.score_statistics import score_in_two_stages
from balance_cli.diagnosis.selection.confirm import ConfirmedFit
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identified_model import CONTRADICTS_OTHERS
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import Estimate
from balance_cli.signals.run_spectrum import NoisePart, RunSpectrum, StaticPoints

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ExclusionResult:
    """What is left out, the spectra and lines without it, and the fit of these."""

    left_out: LeftOut
    spectra: Spectra
    batches: tuple[Batch, ...]
    update: UpdateResult


def find_exclusion(
    start: Estimate,
    spectra: Spectra,
    residual: ResidualMap,
    announce: Callable[[str], bool],
    settings: SearchSettings,
) -> ExclusionResult | None:
    """Return the first channel or run without which the model of `start` describes all other data; None without any.

    `residual`: that of the model before and after the search. The search has failed to describe the data.
    """
    for kind, name in _proposals(residual, settings):
        if announce(f"without {kind} {name}"):
            return None
        rest = without_channel(spectra, name, start.geometry) if kind == CHANNEL else without_run(spectra, name)
        if not rest.lines:
            continue
        batches = stack_runs(rest.lines, rest.statics, start.geometry.channel_names)
        fit = fit_all_lines(start, batches, settings.fit)
        quality = model_quality(fit, batches)
        left_out = LeftOut(kind, name, quality.chi2_per_dof)
        if not is_good_fit(ConfirmedFit(fit), quality, settings):
            continue
        pool = candidates(start.geometry, excluded=settings.excluded)
        scores = score_in_two_stages(fit, batches, pool, settings)
        smallest = min(bonferroni_p_value(s.gain, s.parameters, len(scores), s.noise_dof) for s in scores)
        if smallest >= settings.selection.significance_level:
            update = UpdateResult(fit, {}, (), ConfirmedFit(fit, (), scores, {}, smallest), True)
            return ExclusionResult(left_out, rest, batches, update)
    return None


def _proposals(residual: ResidualMap, settings: SearchSettings) -> Iterator[tuple[str, str]]:
    """The channels and runs that hold most of the excess over the noise, before the search or after it."""
    shares = dict[tuple[str, str], float]()
    for power in (residual.before**2, residual.after**2):
        for kind, axis, names in ((CHANNEL, 2, residual.channels), (RUN, 0, residual.runs)):
            others = tuple(i for i in range(3) if i != axis)
            excess = np.nansum(np.maximum(power - 1.0, 0.0), axis=others)
            share = excess / max(float(excess.sum()), np.finfo(float).tiny)
            best = int(np.argmax(share))
            if len(names) > 1 and share[best] > settings.data_tests.exclusions.min_excess_share:
                shares[(kind, names[best])] = max(share[best], shares.get((kind, names[best]), 0.0))
    yield from sorted(shares, key=lambda item: -shares[item])


# ---- spectra without a part ------------------------------------------------------------------------------------------


def without_run(spectra: Spectra, name: str) -> Spectra:
    """Return the spectra without a run."""
    lines = tuple(run for run in spectra.lines if run.run != name)
    return replace(spectra, lines=lines, statics=tuple(run for run in spectra.statics if run.run != name))


def without_channel(spectra: Spectra, name: str, geometry: Geometry) -> Spectra:
    """Return the spectra without a channel; the others of its cell then give the force of that cell.

    A run of which no other channel is recorded is left out with it.
    """
    lines = tuple(_lines_without(run, name, geometry) for run in spectra.lines if run.channel_names != (name,))
    statics = tuple(_points_without(run, name, geometry) for run in spectra.statics if run.channel_names != (name,))
    runs = [*(run.run for run in spectra.lines), *(points.run for points in spectra.statics)]
    reason = {name: CONTRADICTS_OTHERS}
    left_out = {run: {**spectra.channels_left_out.get(run, {}), **reason} for run in runs}
    return replace(spectra, lines=lines, statics=statics, channels_left_out=left_out)


def _lines_without(run: RunSpectrum, name: str, geometry: Geometry) -> RunSpectrum:
    if name not in run.channel_names:
        return run
    c, u = len(run.channel_names), len(run.components)
    remaining = np.array([i for i, other in enumerate(run.channel_names) if other != name], np.intp)
    signals = np.concatenate([remaining, np.arange(c, c + u)])
    pick = np.ix_(np.arange(len(run.frequency)), signals, signals)
    waveform = run.waveform
    if waveform is not None:
        share = _share_without(waveform.share, run.channel_names, name, geometry)
        noise = None if waveform.noise is None else waveform.noise[remaining]
        waveform = waveform.with_channels(waveform.volts[:, remaining], share, noise)
    window = None if run.window is None else replace(run.window, covariance=run.window.covariance[pick])
    return replace(
        run,
        channel_names=tuple(run.channel_names[i] for i in remaining),
        channels=run.channels[:, remaining],
        covariance=run.covariance[pick],
        window=window,
        waveform=waveform,
        noise_parts=_parts_without(run.noise_parts, remaining),
        periods=None if run.periods is None else run.periods[:, :, remaining],
    )


def _points_without(run: StaticPoints, name: str, geometry: Geometry) -> StaticPoints:
    if name not in run.channel_names:
        return run
    remaining = np.array([i for i, other in enumerate(run.channel_names) if other != name], np.intp)
    share = run.share
    if share is not None:
        share = _share_without(share[None, :], run.channel_names, name, geometry)[0]
    return replace(
        run,
        channel_names=tuple(run.channel_names[i] for i in remaining),
        channels=run.channels[:, remaining],
        covariance=run.covariance[np.ix_(remaining, remaining)],
        share=share,
        noise_parts=_parts_without(run.noise_parts, remaining),
    )


def _parts_without(parts: Sequence[NoisePart], remaining: NDArray[np.intp]) -> tuple[NoisePart, ...]:
    return tuple(replace(part, shape=part.shape[np.ix_(remaining, remaining)]) for part in parts)


def _share_without(share: Array, names: Sequence[str], name: str, geometry: Geometry) -> Array:
    """Weights (F, c - 1) of the channels among those of their cell, in proportion as before, without one channel."""
    cell = {channel.name: channel.cell for channel in geometry.channels}
    others = np.array([other != name and cell[other] == cell[name] for other in names])
    total = share[:, others].sum(axis=1, keepdims=True)
    changed = share.copy()
    changed[:, others] = share[:, others] / np.where(total > 0, total, 1.0)
    return np.asarray(changed[:, [i for i, other in enumerate(names) if other != name]])
