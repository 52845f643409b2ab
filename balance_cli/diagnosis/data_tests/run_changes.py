"""What differs between runs, without a model of the plate: gain and delay of one channel of a cell against the other.

An amplifier that drifts, or a clock that does, changes from run to run, and an average over the runs hides it. In each
run the ratio of two channels of one cell is compared with the ratio that describes all runs. Sums of squares about the
weighted mean of the runs test that the values are equal.

Two things must not be mistaken for a change. A run that does not load a cell tells nothing of its channels: the ratio
of their noise is no ratio of gains, and a fit of it is as precise as it is wrong. And mains interference or strong
crosstalk change a ratio by something else than a gain or a delay: only runs that a gain and a delay describe are
compared. Weak crosstalk can look like a gain that differs between excitations; the finding says so where these differ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.data_tests.channel_pairs import ComparedPair, compared_pairs
from balance_cli.diagnosis.data_tests.channel_ratio import DIFFERENCE_KINDS, DifferenceKind, PairSpectrum, fit_ratio
from balance_cli.diagnosis.result import RUN_CHANGE_TEST, ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_min_p_value, chi2_p_value, format_with_sigma
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]

TWO_SIDED_KINDS = tuple(kind for kind in DIFFERENCE_KINDS if not kind.ratio.one_sided)
"""The differences that are fitted in each run: those that a single parameter of either sign describes."""


def run_tests(runs: Sequence[RunSpectrum], geometry: Geometry, settings: DataTestSettings) -> list[ModelFreeTest]:
    """One row for each pair of channels of a cell of which several runs tell the ratio."""
    tests = (_test(pair, settings) for pair in compared_pairs(runs, geometry, settings))
    return [test for test in tests if test is not None]


def _test(pair: ComparedPair, settings: DataTestSettings) -> ModelFreeTest | None:
    """Chi-square of the values of the runs about their mean, of the kind that differs most."""
    names, values, sigma, dof = _run_values(pair, settings)
    if len(names) < 2:
        return None
    chi2 = _scatter(values, sigma)
    count = float(len(names) - 1)
    p_values = [chi2_p_value(float(each), (count,), (min(dof),)) for each in chi2]
    worst, p_value = int(np.argmin(p_values)), bonferroni_min_p_value(p_values)
    finding = "equal"
    if p_value <= settings.significance_level:
        finding = _finding(pair, names, TWO_SIDED_KINDS[worst], values[:, worst], sigma[:, worst])
    return ModelFreeTest(RUN_CHANGE_TEST, f"{pair.first}, {pair.second}", float(chi2[worst]), count, p_value, finding)


def _run_values(pair: ComparedPair, settings: DataTestSettings) -> tuple[list[str], Array, Array, list[float]]:
    """Runs that tell the ratio, its values (runs, kinds) in them, their standard deviations, and the noise's dof."""
    names, values, sigma, dof = [], [], [], []
    for number, name in enumerate(pair.runs):
        lines = pair.lines.select_run(number)
        if signal_to_noise(lines) < settings.run_changes.min_signal_to_noise:
            continue
        fit = fit_ratio(lines, TWO_SIDED_KINDS, np.zeros(len(TWO_SIDED_KINDS)), settings.channel_pairs)
        count = 2.0 * len(lines.s) - len(TWO_SIDED_KINDS)
        if chi2_p_value(fit.chi2, (count,), (pair.dof[number],)) <= settings.significance_level:
            continue
        names.append(name)
        values.append(fit.values)
        sigma.append(np.maximum(fit.sigma, np.finfo(float).tiny))
        dof.append(pair.dof[number])
    return names, np.array(values), np.array(sigma), dof


def signal_to_noise(lines: PairSpectrum) -> float:
    """Return the power of the weaker channel over that of its noise, in all lines together."""
    noise = np.sum(np.diagonal(lines.covariance, axis1=1, axis2=2).real, axis=0)
    return float(np.min(np.sum(np.abs(lines.forces) ** 2, axis=0) / np.maximum(noise, np.finfo(float).tiny)))


def _scatter(values: Array, sigma: Array) -> Array:
    """Chi-square (kinds,) of values (runs, kinds) about their weighted means."""
    weight = 1.0 / sigma**2
    mean = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
    return np.asarray(np.sum(weight * (values - mean) ** 2, axis=0))


def _finding(pair: ComparedPair, names: Sequence[str], kind: DifferenceKind, values: Array, sigma: Array) -> str:
    """The two runs that differ most, in sigma, and by what, in the words of the effect."""
    difference = values[:, None] - values
    significance = difference / np.sqrt(sigma[:, None] ** 2 + sigma**2)
    high, low = (int(i) for i in np.unravel_index(np.argmax(significance), significance.shape))
    change, spread = float(difference[high, low]), float(np.hypot(sigma[low], sigma[high]))
    size = format_with_sigma(*kind.ratio.shown(change, spread), kind.ratio.unit)
    words = kind.ratio.finding.format(channel=pair.second, reference=f"{pair.first} in {names[low]}", size=size)
    components = dict(zip(pair.runs, pair.components, strict=True))
    crosstalk = "" if components[names[high]] == components[names[low]] else "; crosstalk would show in the same way"
    return f"the runs differ: in {names[high]} {words}{crosstalk}"
