"""Tests of innovations: what is white and of its size passes, what is not is found out."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from balance_cli.reduction.kalman.innovations import LAGS, InnovationSums, InnovationTests
from tests.support.kalman_models import Array

NAMES = ("a", "b", "c")


def _tests(e: Array, blocks: int = 1) -> InnovationTests:
    sums = InnovationSums(e.shape[1])
    for part in np.array_split(e, blocks):
        sums.add(part)
    found = sums.tests(NAMES)
    assert found is not None
    return found


def _white(seed: int, samples: int = 5000) -> Array:
    return np.random.default_rng(seed).standard_normal((samples, 3))


@pytest.mark.parametrize("blocks", [1, 40])
def test_white_innovations_pass_as_often_as_chance_has_it(blocks):
    found = [_tests(_white(seed), blocks) for seed in range(60)]
    nis = np.array([(one.nis - 1.0) / one.nis_sigma for one in found])
    whiteness = np.array([(one.whiteness - 1.0) / one.whiteness_sigma for one in found])
    for scores in (nis, whiteness):
        assert abs(scores.mean()) < 3.5 / np.sqrt(len(found))
        assert 0.75 < scores.std() < 1.3


def test_innovations_larger_than_stated_are_told():
    found = _tests(1.05 * _white(1))
    assert (found.nis - 1.0) / found.nis_sigma > 5.0
    assert abs(found.whiteness - 1.0) < 4.0 * found.whiteness_sigma


def test_the_channel_that_is_larger_is_named():
    found = _tests(_white(2) * [1.0, 1.0, 2.0])
    assert max(found.channels, key=found.channels.get) == "c"
    assert np.isclose(found.channels["c"], 4.0, rtol=0.1)


@pytest.mark.parametrize("color", [0.1, -0.1])
def test_colored_innovations_are_detected(color):
    e = scipy.signal.lfilter([np.sqrt(1 - color**2)], [1.0, -color], _white(3), axis=0)
    found = _tests(e)
    assert (found.whiteness - 1.0) / found.whiteness_sigma > 5.0
    assert abs(found.nis - 1.0) < 5.0 * found.nis_sigma


def test_a_tone_below_the_noise_is_detected():
    e = _white(4) + 0.4 * np.sin(0.7 * np.arange(5000))[:, None]
    found = _tests(e)
    assert (found.whiteness - 1.0) / found.whiteness_sigma > 5.0


def test_autocorrelations_are_those_of_their_definition():
    e = _white(5, 400)
    rho = np.array([np.sum(e[lag:] * e[:-lag], axis=0) / (400 - lag) for lag in range(1, LAGS + 1)])
    rho /= np.mean(e**2, axis=0)
    count = 400 - np.arange(1, LAGS + 1)
    assert np.isclose(_tests(e).whiteness, np.mean(count[:, None] * rho**2), rtol=1e-12)


def test_too_few_samples_are_not_tested():
    sums = InnovationSums(3)
    assert sums.tests(NAMES) is None
    sums.add(_white(6, LAGS))
    assert sums.tests(NAMES) is None


def test_autocorrelations_are_those_of_the_test_of_whiteness():
    """A first-order process with coefficient 0.6: rho_l = 0.6^l, with a standard error below 0.02 at 20 000 samples."""
    rng = np.random.default_rng(4)
    e = rng.normal(size=(20_000, 2))
    for k in range(1, len(e)):
        e[k, 1] = 0.6 * e[k - 1, 1] + 0.8 * e[k, 1]
    sums = InnovationSums(2)
    sums.add(e)
    tests = sums.tests(("white", "colored"))
    np.testing.assert_allclose(tests.autocorrelation["colored"], 0.6 ** np.arange(1, 21), atol=0.05)
    assert np.abs(tests.autocorrelation["white"]).max() < 0.03
    rho = np.array(list(tests.autocorrelation.values()))
    assert tests.whiteness == pytest.approx(np.mean(tests.pairs * rho**2))
