"""What drifts within a record, without a model of the plate: the first half of its periods against the last.

An amplifier that warms up changes its gain, and a data-acquisition box on a clock of its own is later at the end of a
record than at its beginning. A mean over the record hides both, and the scatter between periods, which grows, passes
for noise. In each half of a periodic record a gain and a delay between two channels of one cell are fitted; changes of
all records that have the same sign add up. Records that do not repeat are not tested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.data_tests.channel_pairs import ComparedPair, channel_pairs, compare_pair, declared_paths
from balance_cli.diagnosis.data_tests.channel_ratio import DifferenceKind, fit_ratio
from balance_cli.diagnosis.data_tests.run_changes import TWO_SIDED_KINDS, signal_to_noise
from balance_cli.diagnosis.result import RECORD_CHANGE_TEST, ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_min_p_value, chi2_p_value, format_with_sigma
from balance_cli.signals.covariance_pooling import pooled_covariance, variance_floor
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

OVERLAP = 2.0 / 3.0
"""Degrees of freedom of overlapping differences, relative to their number."""


def record_tests(runs: Sequence[RunSpectrum], geometry: Geometry, settings: DataTestSettings) -> list[ModelFreeTest]:
    """One row for each pair of channels of a cell of which periodic records have five periods or more."""
    paths = {path.channel: path for path in declared_paths(geometry)}
    rows = []
    for first, second in channel_pairs(geometry):
        halves = [half for run in runs for half in _halves(run, (first, second), settings)]
        pair = compare_pair(halves, (paths[first], paths[second]), geometry.tolerances.sensitivity, settings)
        rows.append(None if pair is None else _test(pair, settings))
    return [row for row in rows if row is not None]


def _halves(run: RunSpectrum, names: tuple[str, str], settings: DataTestSettings) -> list[RunSpectrum]:
    """The two channels of a run in each half of its periods, under the name of the run.

    The start transient, which is in both channels of a cell alike, is no reason to leave periods out but the first.
    """
    if run.periods is None or not set(names) <= set(run.channel_names):
        return []
    places = np.array([run.channel_names.index(name) for name in names])
    moving = np.flatnonzero(run.frequency > 0)
    periods = run.periods[1:, moving[:, None], places]
    half = len(periods) // 2
    if half < settings.record_changes.min_half_periods:
        return []
    covariance, dof = noise_of_period(periods)
    first = RunSpectrum(
        run=run.run,
        channel_names=names,
        components=(),
        frequency=run.frequency[moving],
        channels=periods[:half].mean(axis=0),
        loads=np.zeros((len(moving), 0), complex),
        covariance=covariance / half,
        dof=dof,
    )
    return [first, replace(first, channels=periods[-half:].mean(axis=0))]


def noise_of_period(periods: ComplexArray) -> tuple[ComplexArray, float]:
    """Covariance (k, c, c) of one period (P, k, c) and its dof, from differences of successive ones.

    A drift hardly enters them. Overlapping differences of white noise have two thirds of the degrees of freedom of
    their number (von Neumann, Ann. Math. Stat. 12 (1941) 367).
    """
    step = np.diff(periods, axis=0)
    counts = np.full(periods.shape[1], float(len(step)))
    floor = variance_floor(periods, periods.shape[2])
    pooled = pooled_covariance(step.swapaxes(0, 1) / np.sqrt(2.0), counts, floor=floor)
    return pooled.at_lines, OVERLAP * pooled.dof


def _test(pair: ComparedPair, settings: DataTestSettings) -> ModelFreeTest | None:
    """Whether the changes from the first to the last half, of the kind that changes most, are more than noise."""
    names, change, spread, limit = _changes(pair, settings)
    if not names:
        return None
    count = float(len(names))
    separate = np.sum((change / spread) ** 2, axis=0)
    mean, mean_sigma = _weighted_mean(change, spread)
    p_values = [
        min(chi2_p_value(float(each), (count,), (limit,)), chi2_p_value(float(together), (1.0,), (limit,)))
        for each, together in zip(separate, (mean / mean_sigma) ** 2, strict=True)
    ]
    worst, p_value = int(np.argmin(p_values)), bonferroni_min_p_value([p for p in p_values for _ in range(2)])
    finding = "equal"
    if p_value <= settings.significance_level:
        largest = names[int(np.argmax(np.abs(change[:, worst]) / spread[:, worst]))]
        finding = _finding(pair, TWO_SIDED_KINDS[worst], float(mean[worst]), float(mean_sigma[worst]), largest)
    place = f"{pair.first}, {pair.second}"
    return ModelFreeTest(RECORD_CHANGE_TEST, place, float(separate[worst]), count, p_value, finding)


def _changes(pair: ComparedPair, settings: DataTestSettings) -> tuple[list[str], Array, Array, float]:
    """Records that load the cell, the changes (records, kinds) in them, their sigmas, and the least dof of the noise.

    What gain and delay do not describe widens sigma (Birge ratio): a clock that drifts spreads every line a little.
    """
    names, values, sigma = [], [], []
    for number in range(0, len(pair.runs), 2):
        halves = [pair.lines.select_run(number), pair.lines.select_run(number + 1)]
        if min(map(signal_to_noise, halves)) < settings.run_changes.min_signal_to_noise:
            continue
        null = np.zeros(len(TWO_SIDED_KINDS))
        first, last = (fit_ratio(lines, TWO_SIDED_KINDS, null, settings.channel_pairs) for lines in halves)
        free = 2.0 * len(halves[0].s) - len(null)
        if free <= 0:
            continue  # as many parameters as readings: nothing tells what they do not describe
        birge = np.sqrt(max(first.chi2 / free, last.chi2 / free, 1.0))
        names.append(pair.runs[number])
        values.append(last.values - first.values)
        sigma.append(np.maximum(birge * np.hypot(first.sigma, last.sigma), np.finfo(float).tiny))
    return names, np.array(values), np.array(sigma), min(pair.dof)


def _weighted_mean(values: Array, sigma: Array) -> tuple[Array, Array]:
    """Weighted means (kinds,) of values (records, kinds), and their standard deviations."""
    weight = 1.0 / sigma**2
    return np.sum(weight * values, axis=0) / weight.sum(axis=0), weight.sum(axis=0) ** -0.5


def _finding(pair: ComparedPair, kind: DifferenceKind, change: float, sigma: float, largest: str) -> str:
    """The mean change from the first to the last half of the records, in the words of the effect."""
    size = format_with_sigma(*kind.ratio.shown(change, sigma), kind.ratio.unit)
    channel, reference = pair.second, pair.first
    if kind.ratio.names_positive and change < 0:
        channel, reference = reference, channel
    words = kind.ratio.finding.format(channel=channel, reference=reference, size=size)
    return f"drifts within the records, most clearly in {largest}: against the first half, in the last {words}"
