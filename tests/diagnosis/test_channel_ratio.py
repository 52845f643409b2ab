"""The start values of a difference between two channels, compared all at once."""

import numpy as np
import pytest

from balance_cli.diagnosis.data_tests import channel_ratio
from balance_cli.diagnosis.data_tests.channel_ratio import DIFFERENCE_KINDS, PairSpectrum, ratio_chi2

LINES, RUNS = 60, 3


@pytest.mark.parametrize("transient", [0.0, 1.0])
@pytest.mark.parametrize("kind", DIFFERENCE_KINDS, ids=lambda kind: f"{kind.effect.name}-{kind.in_first}")
def test_chi2_of_all_starts_is_that_of_each(kind, transient):
    rng = np.random.default_rng(0)
    s = 2j * np.pi * np.linspace(1.0, 100.0, LINES)
    first = rng.standard_normal(LINES) + 1j * rng.standard_normal(LINES)
    forces = np.stack([first, first * (1.0 + 1e-3 * rng.standard_normal(LINES))], axis=1)
    covariance = np.tile(1e-6 * np.array([[1.0, 0.2j], [-0.2j, 1.5]]), (LINES, 1, 1))
    own = transient / (s[:, None] + [1.0, 2.0])
    run = np.repeat(np.arange(RUNS), LINES // RUNS)
    lines = PairSpectrum(s, forces, covariance, np.ones(LINES), own, run, gain_sigma=0.02)
    kinds, starts = (DIFFERENCE_KINDS[0], kind), kind.start_values(20, s)
    at_once = channel_ratio._chi2_of_starts(lines, kinds, np.array([1e-3]), starts)
    one_by_one = [ratio_chi2(lines, kinds, np.array([1e-3, value])) for value in starts]
    np.testing.assert_allclose(at_once, one_by_one, rtol=1e-11)
