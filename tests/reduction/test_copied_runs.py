"""A record under two names is named, and its loads are flagged; loads that differ in the last digit are no copies."""

import numpy as np

from balance_cli.steps.contradicted_loads import compare_with_other_runs
from tests.reduction.test_turned_harmonics import a_run, random_loads


def test_equal_loads_are_flagged_in_both_runs():
    first, other = (random_loads(np.random.default_rng(seed)) for seed in (1, 2))
    almost = first * (1 + 2e-16)
    runs = {name: a_run(loads, name) for name, loads in (("a", first), ("b", other), ("c", first), ("d", almost))}
    flagged, warnings = compare_with_other_runs(runs)
    assert [name for name, run in flagged.items() if run.flags[1][0]] == ["a", "c"]
    assert len(warnings) == 1 and "a, c have the same loads in every digit" in warnings[0]
    assert all(warnings[0] in flagged[name].notes for name in ("a", "c"))


def test_runs_without_loads_are_no_copies():
    nothing = np.full((9, 6), np.nan + 0j)
    runs = {name: a_run(nothing, name) for name in ("a", "b")}
    assert compare_with_other_runs(runs) == (runs, ())
