"""Channels that read one cell, or the torque meter, against each other: no model of the plate is in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_ratio import (
    DELAY,
    DIFFERENCE_KINDS,
    GAIN,
    SCORED_KINDS,
    PairSpectrum,
    RatioFit,
    fit_ratio,
    fit_with_kind,
    score_gain,
)
from balance_cli.diagnosis.data_tests.high_pass_transient import high_pass_transient
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_min_p_value, chi2_p_value, format_with_sigma, noise_factor
from balance_cli.model.balance import balance_model
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CHANNEL_TEST_NAME = "channels of a cell"
# Probability below which two channels are held to differ, and what is fitted to describe nothing of all that is there.
DATA_TEST_LEVEL = 1e-3
# Kinds that a finding may name, and what one more must gain in chi-square.
MOST_KINDS = 2
MIN_DIFFERENCE_GAIN = 25.0
# Chi-square within which two findings cannot be told apart.
INDISTINGUISHABLE_FINDINGS = 6.0
# Chi-square by which a kind may fit two channels worse than the best one, and still be what the plate speaks for.
NEAR_BEST_FIT = 30.0


@dataclass(frozen=True)
class _Pair:
    """Two channels of a cell with their lines, and of each run the number of real values and the noise's dof."""

    first: str
    second: str
    lines: PairSpectrum
    counts: tuple[float, ...]
    dof: tuple[float, ...]


def channel_tests(runs: Sequence[RunSpectrum], geometry: Geometry) -> list[ModelFreeTest]:
    """One row for each channel and the first one of the same cell."""
    paths = {path.channel: path for path in declared_paths(geometry)}
    found = (
        _pair_data(runs, paths[first], paths[second], geometry.tolerances.sensitivity)
        for first, second in channel_pairs(geometry)
    )
    return [_test(pair) for pair in found if pair is not None]


def declared_paths(geometry: Geometry) -> tuple[ChannelPath, ...]:
    """The channels' gains and filters as declared, without any effect."""
    return balance_model(geometry.model_copy(update={"effects": ()})).system().paths


def channel_pairs(geometry: Geometry) -> list[tuple[str, str]]:
    """The first channel of each cell and of the torque meter, with every other one of it."""
    groups: dict[str | None, list[str]] = {}
    for channel in geometry.channels:
        groups.setdefault(channel.cell, []).append(channel.name)
    return [(names[0], other) for names in groups.values() for other in names[1:]]


def _pair_data(runs: Sequence[RunSpectrum], first: ChannelPath, second: ChannelPath, tolerance: float) -> _Pair | None:
    names = (first.channel, second.channel)
    runs = [run for run in runs if set(names) <= set(run.channel_names)]
    if not runs:
        return None
    parts = [_pair_spectrum(run, (first, second), i) for i, run in enumerate(runs)]
    joined = PairSpectrum(
        np.concatenate([part.s for part in parts]),
        np.concatenate([part.forces for part in parts]),
        np.concatenate([part.covariance for part in parts]),
        np.concatenate([part.factor for part in parts]),
        np.concatenate([part.high_pass_transient for part in parts]),
        np.concatenate([part.run for part in parts]),
        float(np.sqrt(2.0) * tolerance),
    )
    return _Pair(*names, joined, tuple(2.0 * len(part.s) for part in parts), tuple(2.0 * run.dof for run in runs))


def _pair_spectrum(run: RunSpectrum, paths: tuple[ChannelPath, ChannelPath], number: int) -> PairSpectrum:
    """The lines of one run, but for the mean of its record."""
    places = np.array([run.channel_names.index(path.channel) for path in paths])
    moving = np.flatnonzero(run.frequency > 0)
    gains = channel_gains(paths, run.frequency[moving])
    noise = run.covariance[moving[:, None, None], places[:, None], places]
    return PairSpectrum(
        np.asarray(2j * np.pi * run.frequency[moving], complex),
        run.channels[moving[:, None], places] / gains,
        noise / (gains[:, :, None] * gains[:, None, :].conj()),
        np.full(len(gains), noise_factor(run.dof, 1)),
        _normalize_columns(np.stack([high_pass_transient(run, path, moving) for path in paths], axis=1) / gains),
        np.full(len(gains), number),
    )


def _normalize_columns(columns: ComplexArray) -> ComplexArray:
    """Columns (k, 2) of like size: theirs is free, and may be tiny."""
    largest = np.max(np.abs(columns), axis=0, initial=0.0)
    return np.asarray(columns / np.where(largest > 0, largest, 1.0))


def _test(pair: _Pair) -> ModelFreeTest:
    """Chi-square against equality; the probability is that of the best look at it, all looks counted."""
    start = _fit_equal_channels(pair.lines)
    looks = [_residual_p_value(pair, start)]
    looks += [
        chi2_p_value(score_gain(pair.lines, start, kind), (1.0,), (sum(pair.dof),))
        for kind in SCORED_KINDS
        if kind not in start.kinds
    ]
    p_value = bonferroni_min_p_value(looks)
    finding = "equal" if p_value > DATA_TEST_LEVEL else _finding(pair, start)
    return ModelFreeTest(
        CHANNEL_TEST_NAME, f"{pair.first}, {pair.second}", start.chi2, sum(pair.counts), p_value, finding
    )


def _residual_p_value(pair: _Pair, fit: RatioFit) -> float:
    return chi2_p_value(fit.chi2, pair.counts, pair.dof)


def _fit_equal_channels(lines: PairSpectrum) -> RatioFit:
    """Nothing fitted but a gain within what is declared of the sensitivities."""
    kinds = (GAIN,) if lines.gain_sigma > 0 else ()
    return fit_ratio(lines, kinds, np.zeros(len(kinds)))


def _finding(pair: _Pair, start: RatioFit) -> str:
    """The simplest description that leaves nothing improbable; `neither` where none does."""
    fit, own, rival = start, len(start.kinds), None
    for _ in range(MOST_KINDS):
        others = _fits_with_one_more_kind(pair, fit)
        if fit.chi2 - others[0].chi2 < MIN_DIFFERENCE_GAIN:
            break
        fit, rival = others[0], others[1] if others[1].chi2 < others[0].chi2 + INDISTINGUISHABLE_FINDINGS else None
        if _residual_p_value(pair, fit) > DATA_TEST_LEVEL:
            return _describe_fit(pair, fit, own) + ("" if rival is None else f"; or {_describe_fit(pair, rival, own)}")
    left = f"chi2/dof {fit.chi2 / sum(pair.counts):.3g} left"
    if len(fit.kinds) == own:
        return f"differ; neither delay, gain nor filter ({left})"
    return f"neither delay, gain nor filter alone; nearest: {_describe_fit(pair, fit, own)} ({left})"


@dataclass(frozen=True)
class ChannelDifference:
    """One way in which two channels differ: kinds with their values that describe it, the best first; what it gains."""

    first: str
    second: str
    kinds: tuple[tuple[str, float], ...]
    gain: float


def find_channel_differences(runs: Sequence[RunSpectrum], geometry: Geometry) -> tuple[ChannelDifference, ...]:
    """The ways in which pairs of channels differ, one or two of a pair, which leave nothing improbable.

    Small differences are left to the score test, but for those of a high-pass: at rest it lets nothing through however
    low its cutoff is, which no derivative at its null can tell.
    """
    paths = {path.channel: path for path in declared_paths(geometry)}
    found: list[ChannelDifference] = []
    for first, second in channel_pairs(geometry):
        pair = _pair_data(runs, paths[first], paths[second], geometry.tolerances.sensitivity)
        if pair is not None:
            found += _pair_differences(pair, _fit_equal_channels(pair.lines))
    return tuple(found)


def _pair_differences(pair: _Pair, start: RatioFit) -> list[ChannelDifference]:
    fits = _fits_with_one_more_kind(pair, start)
    best = fits[0]
    large = best.chi2 < 0.5 * start.chi2 and _residual_p_value(pair, start) < DATA_TEST_LEVEL
    if not large and not _is_high_pass(pair, start, best):
        return []
    if _residual_p_value(pair, best) > DATA_TEST_LEVEL**2:
        near = [one for one in fits if one.chi2 < best.chi2 + NEAR_BEST_FIT]
        kinds = tuple((one.kinds[-1].name, float(one.values[-1])) for one in near)
        return [ChannelDifference(pair.first, pair.second, kinds, start.chi2 - best.chi2)]
    both = _fits_with_one_more_kind(pair, best)[0]
    if best.chi2 - both.chi2 < MIN_DIFFERENCE_GAIN or _residual_p_value(pair, both) <= DATA_TEST_LEVEL**2:
        return []
    gains = (start.chi2 - best.chi2, best.chi2 - both.chi2)
    ways = zip(both.kinds[-2:], both.values[-2:], gains, strict=True)
    return [
        ChannelDifference(pair.first, pair.second, ((kind.name, float(value)),), gain) for kind, value, gain in ways
    ]


def _fits_with_one_more_kind(pair: _Pair, fit: RatioFit) -> list[RatioFit]:
    """The fits with one kind more, the best first."""
    return sorted(
        (fit_with_kind(pair.lines, fit, kind) for kind in DIFFERENCE_KINDS if kind not in fit.kinds),
        key=lambda one: one.chi2,
    )


def _is_high_pass(pair: _Pair, start: RatioFit, best: RatioFit) -> bool:
    """Whether the difference is a high-pass beyond doubt."""
    gain = start.chi2 - best.chi2
    clear = gain > MIN_DIFFERENCE_GAIN and chi2_p_value(gain, (1.0,), (sum(pair.dof),)) < DATA_TEST_LEVEL**2
    return clear and best.kinds[-1].name.startswith("high-pass")


def _describe_fit(pair: _Pair, fit: RatioFit, own: int) -> str:
    parts = zip(fit.kinds, fit.values, fit.sigma, strict=True)
    return " and ".join(_describe_kind(pair, kind.name, value, sigma) for kind, value, sigma in list(parts)[own:])


def _describe_kind(pair: _Pair, kind: str, value: float, sigma: float) -> str:
    first, second = pair.first, pair.second
    if kind == DELAY.name:
        late, other = (second, first) if value > 0 else (first, second)
        return f"{late} is late by {format_with_sigma(1e3 * abs(value), 1e3 * sigma, 'ms')} against {other}"
    if kind == GAIN.name:
        return f"{second} reads {format_with_sigma(np.exp(value), np.exp(value) * sigma)} times {first}"
    channel, size = (second if kind.endswith("B") else first), max(value, 1e-300)
    if kind.startswith("low-pass"):
        cutoff = 1.0 / (2 * np.pi * size)
        return f"{channel} has a further low-pass at {format_with_sigma(cutoff, cutoff * sigma / size, 'Hz')}"
    return f"{channel} has a further high-pass, time constant {format_with_sigma(1.0 / size, sigma / size**2, 's')}"
