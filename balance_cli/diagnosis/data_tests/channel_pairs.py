"""Channels that read the same cell, or the torque meter, compared with each other without a model of the plate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_test_settings import ChannelPairSettings, DataTestSettings
from balance_cli.diagnosis.data_tests.channel_ratio import (
    DIFFERENCE_KINDS,
    SCORED_KINDS,
    TOLERATED_KINDS,
    DifferenceKind,
    PairSpectrum,
    RatioFit,
    fit_ratio,
    fit_with_kind,
    ratio_chi2,
    remove_ratio,
    score_gain,
)
from balance_cli.diagnosis.data_tests.high_pass_transient import high_pass_transient
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import bonferroni_min_p_value, chi2_p_value, format_with_sigma, noise_factor
from balance_cli.model.balance import balance_model
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CHANNEL_TEST_NAME = "channels of a cell"


@dataclass(frozen=True)
class _Pair:
    """Two channels of a cell with their lines; of each run the number of real values and the noise's dof."""

    first: str
    second: str
    lines: PairSpectrum
    counts: tuple[float, ...]
    dof: tuple[float, ...]


def channel_tests(runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings) -> list[ModelFreeTest]:
    """One row for each channel and the first channel of the same cell."""
    paths = {path.channel: path for path in declared_paths(geometry)}
    pairs = (
        _pair_data(runs, paths[first], paths[second], geometry.tolerances.sensitivity)
        for first, second in channel_pairs(geometry)
    )
    return [_test(pair, settings) for pair in pairs if pair is not None]


def declared_paths(geometry: Geometry) -> tuple[ChannelPath, ...]:
    """Gains and filters of the channels as declared, without any effect."""
    return balance_model(geometry.model_copy(update={"effects": ()})).system().equations.paths


def channel_pairs(geometry: Geometry) -> list[tuple[str, str]]:
    """The first channel of each source (a cell, the torque meter), paired with each of its other channels."""
    groups: dict[str, list[str]] = {}
    for channel in geometry.channels:
        groups.setdefault(channel.source, []).append(channel.name)
    return [(names[0], name) for names in groups.values() for name in names[1:]]


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
    """The lines of one run, without the mean of its record."""
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
    """Columns (k, 2) scaled to a largest magnitude of one: their size is arbitrary and may be tiny."""
    largest = np.max(np.abs(columns), axis=0, initial=0.0)
    return np.asarray(columns / np.where(largest > 0, largest, 1.0))


def _test(pair: _Pair, settings: SearchSettings) -> ModelFreeTest:
    """Chi-square against equality; the p-value is the smallest of several tests, Bonferroni-corrected."""
    start = _fit_equal_channels(pair.lines, settings.data_tests.channel_pairs)
    p_values = [_residual_p_value(pair, start)]
    p_values += [
        chi2_p_value(
            score_gain(pair.lines, start, kind, settings.score.min_information_share), (1.0,), (sum(pair.dof),)
        )
        for kind in SCORED_KINDS
        if kind not in start.kinds
    ]
    p_value = bonferroni_min_p_value(p_values)
    finding = "equal" if p_value > settings.data_tests.significance_level else _finding(pair, start, settings)
    return ModelFreeTest(
        CHANNEL_TEST_NAME, f"{pair.first}, {pair.second}", start.chi2, sum(pair.counts), p_value, finding
    )


def _residual_p_value(pair: _Pair, fit: RatioFit) -> float:
    return chi2_p_value(fit.chi2, pair.counts, pair.dof)


def _fit_equal_channels(lines: PairSpectrum, settings: ChannelPairSettings) -> RatioFit:
    """The fit of equal channels, whose sensitivities differ within the declared tolerance at most."""
    kinds = TOLERATED_KINDS if lines.gain_sigma > 0 else ()
    return fit_ratio(lines, kinds, np.zeros(len(kinds)), settings)


def _finding(pair: _Pair, start: RatioFit, settings: SearchSettings) -> str:
    """The simplest description that passes the residual test; `neither` where none does."""
    limits, level = settings.data_tests.channel_pairs, settings.data_tests.significance_level
    fit, tolerated, rival = start, len(start.kinds), None
    for _ in range(limits.max_kinds):
        best, second = _fits_with_one_more_kind(pair, fit, limits)[:2]
        if fit.chi2 - best.chi2 < limits.min_kind_gain:
            break
        fit, rival = best, second if second.chi2 < best.chi2 + settings.indistinguishable_chi2 else None
        if _residual_p_value(pair, fit) > level:
            text = _describe_fit(pair, fit, tolerated)
            return text if rival is None else f"{text}; or {_describe_fit(pair, rival, tolerated)}"
    remaining = f"remaining chi2/dof {fit.chi2 / sum(pair.counts):.3g}"
    if len(fit.kinds) == tolerated:
        return f"differ; neither delay, gain nor filter ({remaining})"
    return f"neither delay, gain nor filter alone; nearest: {_describe_fit(pair, fit, tolerated)} ({remaining})"


@dataclass(frozen=True)
class ChannelDifference:
    """One difference of two channels: the kinds that describe it with value and sigma, best first; its gain."""

    first: str
    second: str
    kinds: tuple[tuple[DifferenceKind, float, float], ...]
    gain: float


def find_channel_differences(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings
) -> tuple[ChannelDifference, ...]:
    """The differences of pairs of channels, at most two of each pair, with which the pair passes the residual test.

    Small differences are left to the score test, except where they change the response at rest by a finite amount: no
    derivative at the null shows that.
    """
    paths = {path.channel: path for path in declared_paths(geometry)}
    differences: list[ChannelDifference] = []
    for first, second in channel_pairs(geometry):
        pair = _pair_data(runs, paths[first], paths[second], geometry.tolerances.sensitivity)
        if pair is not None:
            equal = _fit_equal_channels(pair.lines, settings.data_tests.channel_pairs)
            differences += _pair_differences(pair, equal, settings)
    return tuple(differences)


def difference_gain(
    runs: Sequence[RunSpectrum],
    geometry: Geometry,
    names: tuple[str, str],
    difference: tuple[DifferenceKind, float],
    settings: SearchSettings,
) -> float:
    """Decrease of the chi-square of two channels by a difference of this kind and value; zero without any line."""
    paths = {path.channel: path for path in declared_paths(geometry)}
    pair = _pair_data(runs, paths[names[0]], paths[names[1]], geometry.tolerances.sensitivity)
    if pair is None:
        return 0.0
    equal = _fit_equal_channels(pair.lines, settings.data_tests.channel_pairs)
    kind, value = difference
    if kind in equal.kinds:
        return equal.chi2 - ratio_chi2(pair.lines, (kind,), np.array([value]))
    return equal.chi2 - ratio_chi2(pair.lines, (*equal.kinds, kind), np.append(equal.values, value))


@dataclass(frozen=True)
class ComparedPair:
    """Two channels of a cell with the ratio that describes all their runs best taken out of their lines.

    `runs`: names, in the order of their numbers in the lines; `components`: those that each excites; `dof`: degrees of
    freedom of the noise of each.
    """

    first: str
    second: str
    runs: tuple[str, ...]
    components: tuple[tuple[str, ...], ...]
    lines: PairSpectrum
    dof: tuple[float, ...]


def compared_pairs(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: DataTestSettings
) -> tuple[ComparedPair, ...]:
    """Return the pairs of channels that several runs share."""
    paths = {path.channel: path for path in declared_paths(geometry)}
    tolerance = geometry.tolerances.sensitivity
    pairs = (
        compare_pair(runs, (paths[first], paths[second]), tolerance, settings)
        for first, second in channel_pairs(geometry)
    )
    return tuple(pair for pair in pairs if pair is not None)


def compare_pair(
    runs: Sequence[RunSpectrum], paths: tuple[ChannelPath, ChannelPath], tolerance: float, settings: DataTestSettings
) -> ComparedPair | None:
    """Return two channels of a cell in the runs that have both; None unless several do."""
    names = (paths[0].channel, paths[1].channel)
    shared = [run for run in runs if set(names) <= set(run.channel_names)]
    pair = _pair_data(shared, *paths, tolerance)
    if pair is None or len(shared) < 2:
        return None
    equal = _fit_equal_channels(pair.lines, settings.channel_pairs)
    are_equal = _residual_p_value(pair, equal) > settings.significance_level
    common = equal if are_equal else _fits_with_one_more_kind(pair, equal, settings.channel_pairs)[0]
    labels, components = tuple(run.run for run in shared), tuple(run.components for run in shared)
    return ComparedPair(*names, labels, components, remove_ratio(pair.lines, common), pair.dof)


def _pair_differences(pair: _Pair, start: RatioFit, settings: SearchSettings) -> list[ChannelDifference]:
    limits, level = settings.data_tests.channel_pairs, settings.data_tests.significance_level
    fits = _fits_with_one_more_kind(pair, start, limits)
    best = fits[0]
    large = best.chi2 < limits.max_remaining_share * start.chi2 and _residual_p_value(pair, start) < level
    if not large and not _is_clear_at_rest(pair, start, best, settings.data_tests):
        return []
    if _residual_p_value(pair, best) > level**2:
        near = [fit for fit in fits if fit.chi2 < best.chi2 + settings.alternative_gap]
        kinds = tuple((fit.kinds[-1], float(fit.values[-1]), float(fit.sigma[-1])) for fit in near)
        return [ChannelDifference(pair.first, pair.second, kinds, start.chi2 - best.chi2)]
    both = _fits_with_one_more_kind(pair, best, limits)[0]
    if best.chi2 - both.chi2 < limits.min_kind_gain or _residual_p_value(pair, both) <= level**2:
        return []
    gains = (start.chi2 - best.chi2, best.chi2 - both.chi2)
    ways = zip(both.kinds[-2:], both.values[-2:].tolist(), both.sigma[-2:].tolist(), gains, strict=True)
    return [ChannelDifference(pair.first, pair.second, ((kind, *size),), gain) for kind, *size, gain in ways]


def _fits_with_one_more_kind(pair: _Pair, fit: RatioFit, settings: ChannelPairSettings) -> list[RatioFit]:
    """The fits with one kind more, the best first."""
    return sorted(
        (fit_with_kind(pair.lines, fit, kind, settings) for kind in DIFFERENCE_KINDS if kind not in fit.kinds),
        key=lambda fit: fit.chi2,
    )


def _is_clear_at_rest(pair: _Pair, start: RatioFit, best: RatioFit, settings: DataTestSettings) -> bool:
    """Whether the difference is significant and changes the response at rest by a finite amount."""
    gain = start.chi2 - best.chi2
    p_value = chi2_p_value(gain, (1.0,), (sum(pair.dof),))
    clear = gain > settings.channel_pairs.min_kind_gain and p_value < settings.significance_level**2
    return clear and best.kinds[-1].ratio.at_rest


def _describe_fit(pair: _Pair, fit: RatioFit, tolerated: int) -> str:
    """The kinds in words, without the first `tolerated` ones, which the declared tolerance covers."""
    parts = zip(fit.kinds, fit.values, fit.sigma, strict=True)
    return " and ".join(_describe_kind(pair, kind, value, sigma) for kind, value, sigma in list(parts)[tolerated:])


def _describe_kind(pair: _Pair, kind: DifferenceKind, value: float, sigma: float) -> str:
    ratio = kind.ratio
    in_first = kind.in_first or (ratio.names_positive and value <= 0)
    channel, reference = (pair.first, pair.second) if in_first else (pair.second, pair.first)
    size = format_with_sigma(*ratio.shown(value, sigma), ratio.unit)
    return ratio.finding.format(channel=channel, reference=reference, size=size)
