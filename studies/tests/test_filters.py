"""The study of filters: its rig and loads, and its errors on one short record of each case."""

from functools import cache

import numpy as np
import pandas as pd
import pytest

from balance_cli.steps.modes import computed_modes
from studies.filters import (
    ACTUAL_HARMONICS,
    IN_TIME,
    METHODS,
    NOMINAL_HARMONICS,
    case_rows,
    filters_chunk,
    simulate_record,
)
from studies.filters_rig import (
    BROAD,
    CARRIED,
    CASES,
    CHANNELS,
    COLUMNS,
    DRIFTING,
    EXACT,
    LOAD_GROWTH,
    MANEUVER,
    NOMINAL_SPEED,
    OFF_SPEED,
    SYSTEM,
    TURBULENCE,
    two_degree_geometry,
)
from studies.filters_table import filters_table, page_table

DURATION = 8.0
FILTER, SMOOTHER = "harmonics, filter", "harmonics, smoother"
RANDOM, RANDOM_BEHIND = "random, smoother", "random, filter 0.05 s behind"
USED = {
    EXACT: (ACTUAL_HARMONICS, FILTER, SMOOTHER, RANDOM, RANDOM_BEHIND),
    BROAD: (FILTER, SMOOTHER),
    SYSTEM: (NOMINAL_HARMONICS, SMOOTHER),
    OFF_SPEED: (NOMINAL_HARMONICS, ACTUAL_HARMONICS, SMOOTHER),
    DRIFTING: (NOMINAL_HARMONICS, ACTUAL_HARMONICS, SMOOTHER),
    MANEUVER: (ACTUAL_HARMONICS, FILTER, SMOOTHER),
}


@cache
def found(case: str) -> pd.DataFrame:
    """Return the errors of the methods of `USED` on one record."""
    record = simulate_record(CASES[case], 1, DURATION)
    return pd.DataFrame(case_rows(record, case, USED[case])).set_index("method")


def test_a_harmonic_lies_near_each_resonance():
    modes = computed_modes(two_degree_geometry({})).modes
    order = modes.frequency / NOMINAL_SPEED
    assert np.all(np.abs(order - [2, 4]) < 0.12)
    assert CASES[CHANNELS].tolerances and CASES[SYSTEM].tolerances and not CASES[EXACT].tolerances


def test_the_reduction_knows_the_declared_rig_alone():
    true, declared = (simulate_record(CASES[case], 3, 3.0) for case in (SYSTEM, EXACT))
    np.testing.assert_array_equal(true.source.at(np.array([35.0]), 17.5), declared.source.at(np.array([35.0]), 17.5))
    assert not np.allclose(true.truth.channels, declared.truth.channels, rtol=0.1)
    np.testing.assert_array_equal(true.truth.loads, declared.truth.loads)


def test_loads_grow_in_the_maneuver_alone():
    grown, steady = (simulate_record(CASES[case], 3, 3.0).truth for case in (MANEUVER, EXACT))
    late = grown.time > 0.55 * 3.0 + 0.3
    np.testing.assert_allclose(grown.loads[late], (1 + LOAD_GROWTH) * steady.loads[late])
    np.testing.assert_array_equal(grown.loads[grown.time < 0.55 * 3.0], steady.loads[grown.time < 0.55 * 3.0])


def test_turbulence_without_a_band_is_as_strong():
    broad, periodic = simulate_record(CASES[BROAD], 3, 4.0).truth, simulate_record(CASES[EXACT], 3, 4.0).truth
    fluctuation = broad.loads - periodic.loads
    # The other turbulence is in the difference too.
    rms = np.sqrt(2) * np.array([TURBULENCE[name] for name in CARRIED])
    np.testing.assert_allclose(fluctuation[:, COLUMNS].std(axis=0), rms, rtol=0.15)


def test_with_an_exact_model_the_smoother_sees_turbulence():
    history, amplitudes = found(EXACT)["in_band"], found(EXACT)["harmonics"]
    assert history[SMOOTHER] < 0.5 * history[ACTUAL_HARMONICS] and history[SMOOTHER] < 0.5 * history[FILTER]
    assert history[SMOOTHER] == history.min()
    assert (amplitudes < 0.02).all()


def test_a_smoother_is_no_worse_than_a_filter_behind():
    history = found(EXACT)["in_band"]
    assert history[RANDOM] < 1.2 * history[RANDOM_BEHIND]


def test_intervals_hold_where_the_loads_are_of_the_assumed_kind():
    assert 0.85 < found(BROAD)["coverage"][FILTER] < 0.99
    # The record determines whether turbulence has a band limit. This is one record; the median of ten is 0.98.
    assert 0.9 < found(EXACT)["coverage"][SMOOTHER] < 0.998
    assert 0.9 < found(BROAD)["coverage"][SMOOTHER] < 0.98


@pytest.mark.parametrize(("case", "wrong"), [(OFF_SPEED, 0.5), (DRIFTING, 0.1)])
def test_only_t_at_nominal_harmonics_depends_on_the_speed(case, wrong):
    amplitudes = found(case)["harmonics"]
    assert amplitudes[NOMINAL_HARMONICS] > wrong
    assert amplitudes[ACTUAL_HARMONICS] < 0.02 and amplitudes[SMOOTHER] < 0.02


def test_only_filters_follow_a_maneuver():
    history = found(MANEUVER)["in_band"]
    assert history[ACTUAL_HARMONICS] > 0.15
    assert history[FILTER] < 0.12 and history[SMOOTHER] < 0.04


def test_no_method_corrects_a_wrong_system_matrix():
    amplitudes = found(SYSTEM)["harmonics"]
    assert (amplitudes > 0.05).all()
    assert amplitudes.max() < 2.5 * amplitudes.min()


def test_the_table_has_every_case_and_method():
    rows = pd.concat([filters_rows(seed, error) for seed, error in ((0, 0.1), (1, 0.3), (2, 0.2))])
    table = filters_table(rows)
    assert list(table["method"]) == [*METHODS] * 2 and set(IN_TIME) < set(METHODS)
    assert (table["history_median"] == 0.2).all() and (table["history_max"] == 0.3).all()
    assert np.allclose(table["coverage"], 0.9)
    lines = page_table(table).splitlines()
    assert len(lines) == 2 + len(METHODS) and lines[2] == f"| {NOMINAL_HARMONICS} | 20 | 20 |"


def filters_rows(seed: int, error: float) -> pd.DataFrame:
    errors = {"history": error, "in_band": error, "harmonics": error, "coverage": 0.9, "seed": seed}
    return pd.DataFrame([{"case": case, "method": method, **errors} for case in ("a", "b") for method in METHODS])


def test_a_chunk_is_one_seed_of_everything(monkeypatch):
    monkeypatch.setattr("studies.filters.case_rows", lambda record, case: [{"case": case, "turns": record.run.samples}])
    rows = filters_chunk(5, 1.0)
    assert list(rows["case"]) == list(CASES) and (rows["seed"] == 5).all() and (rows["turns"] == 800).all()
