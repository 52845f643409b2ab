"""The printed tests of the innovations state the limits that flag the loads."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.cli.reduce_text import _innovation_tests_text
from balance_cli.reduction.kalman.innovations import InnovationTests
from balance_cli.reduction.result import TimeDomainResult

WHITE = InnovationTests(1.0, 0.002, 1.0, 0.08, {"x": 1.0}, 10_000, {"x": np.zeros(20)}, np.full(20, 10_000.0))


@pytest.mark.parametrize(
    ("tests", "contradicted"),
    [
        (WHITE, False),
        (replace(WHITE, whiteness=6.04), False),
        (replace(WHITE, whiteness=251.0), True),
        (replace(WHITE, nis=1.3), True),
        (replace(WHITE, nis=0.7), True),
        (replace(WHITE, autocorrelation={"x": np.full(20, 0.06)}), True),
    ],
)
def test_text_and_flag_are_of_one_mind(tests, contradicted):
    text = _innovation_tests_text(TimeDomainResult("harmonics", None, tests, None, {}, ()))
    assert tests.contradict_filter == ("contradict the filter" in text) == contradicted
    assert "(0.8 to 1.25 is consistent)" in text and "(at most 0.15)" in text and "(at most 2)" in text
    assert "1 +-" not in text


def test_loads_assumed_larger_than_they_are_make_no_contradiction():
    """`free` assumes ten times the loads: innovations smaller than stated had flagged every run."""
    tests = replace(WHITE, nis=0.58, assumed_larger=True)
    assert not tests.contradict_filter and replace(tests, nis=1.3).contradict_filter
    assert "(0 to 1.25 is consistent)" in _innovation_tests_text(TimeDomainResult("free", None, tests, None, {}, ()))
