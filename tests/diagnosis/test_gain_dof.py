"""Noise against which a gain is tested that a few lines make: Student's likelihood ratio in place of the normal one."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.search.gain_dof import equivalent_dof, gain_dof
from balance_cli.diagnosis.search.noise_dof import StaticLines
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.diagnosis.selection.confirm import select_significant
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.diagnosis.significance import bonferroni_p_value, gain_p_value
from tests.diagnosis.test_noise_dof import FITTED, NONE, part, run_information, slopes_along

TESTED = np.array([1], np.intp)


def static_run(residual: np.ndarray, dof: float = 2.0):
    """Lines (k,) with unit slope of one channel, whose noise is known with `dof` degrees of freedom in each."""
    slopes = slopes_along(0, lines=len(residual))
    parts = tuple(
        part(np.diag([1.0, 0.0, 0.0]), np.eye(len(residual))[k], 1.0, np.sqrt(2.0 / dof)) for k in range(len(residual))
    )
    weighted = np.zeros((len(residual), 3), complex)
    weighted[:, 0] = residual
    run = run_information(slopes, parts, dof=1e9)
    fitted = slopes[:, :, FITTED].astype(complex)
    return replace(run, lines=StaticLines(slopes.astype(complex), weighted, fitted, run.weighted[:, :, FITTED]))


def test_a_gain_of_one_line_has_the_degrees_of_freedom_of_its_noise():
    """With unit slope chi-square falls by 2 r^2."""
    run = static_run(np.array([5.0]))
    assert gain_dof([run], FITTED, TESTED, NONE, np.array([5.0]), 50.0) == pytest.approx(2.0, rel=1e-6)


def test_lines_that_agree_are_worth_more_than_one_that_is_off():
    """Four lines with 2 degrees of freedom each: all moved by 2.5, or one by 10; chi-square falls by 50 in both."""
    agree, alone = static_run(np.full(4, 2.5)), static_run(np.array([10.0, 0.0, 0.0, 0.0]))
    agreeing, single = (gain_dof([run], FITTED, TESTED, NONE, np.array([2.5]), 50.0) for run in (agree, alone))
    assert agreeing == pytest.approx(8.0, rel=1e-6)
    assert single < 1.0
    assert gain_p_value(50.0, 1, agreeing) < 1e-3 < gain_p_value(50.0, 1, max(single, 1.0))


def test_runs_whose_noise_is_one_keep_their_gain():
    assert gain_dof([run_information(slopes_along(0))], FITTED, TESTED, NONE, np.array([1.0]), 30.0) == np.inf


@pytest.mark.parametrize("dof", [0.5, 2.0, 30.0, 1e4])
def test_equivalent_degrees_of_freedom_invert_the_likelihood_ratio(dof):
    assert equivalent_dof(40.0, dof * np.log1p(40.0 / dof)) == pytest.approx(dof, rel=1e-6)


def test_a_gain_of_which_nothing_is_left_is_tested_against_an_unknown_noise():
    assert equivalent_dof(40.0, -3.0) == 0.0


def test_a_larger_gain_in_a_poorly_known_noise_hides_no_significant_one():
    """Of blind seed 427 a weight misalignment gained more than a significant candidate, and neither was refitted."""
    score = Score(None, 0, 30.0, 1, 0.0, np.inf, None, None, None)
    larger, significant = replace(score, gain=80.0, noise_dof=1.0), replace(score, gain=60.0, noise_dof=np.inf)
    count = 100
    assert bonferroni_p_value(larger.gain, larger.parameters, count, larger.noise_dof) > 0.003
    assert select_significant([larger, significant], count, DEFAULT_SETTINGS) == [significant]
