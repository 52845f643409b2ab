"""What differs between runs shows in the channels of a cell, without a model of the plate."""

import numpy as np
import pytest

from balance_cli.diagnosis.data_tests.run_changes import run_tests
from balance_cli.diagnosis.result import RUN_CHANGE_TEST
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from tests.support.simulated_lines import FREQUENCY, RIG, swept_lines

SETTINGS = DEFAULT_SETTINGS.data_tests
COMPONENTS = ("Fx", "Fy", "Fz", "Mx")


def rows(changes, first=0):
    runs = [
        swept_lines(name, seed=first + seed, changed=change)
        for seed, (name, change) in enumerate(zip(COMPONENTS, changes, strict=True))
    ]
    return {row.place: row for row in run_tests(runs, RIG, SETTINGS)}


def test_runs_that_are_alike_are_equal():
    found = rows([{}] * 4)
    assert len(found) == 7
    assert {row.name for row in found.values()} == {RUN_CHANGE_TEST}
    assert {row.finding for row in found.values()} == {"equal"}


def test_p_values_of_equal_runs_are_uniform():
    p_values = [row.p_value for seed in range(3) for row in rows([{}] * 4, 10 * seed).values()]
    assert np.mean(np.array(p_values) < 0.1) < 0.3


def test_a_gain_that_drifts_is_named_with_its_runs():
    drift = [{"x.piezo": np.full(len(FREQUENCY), 1.0 + 0.004 * number)} for number in range(4)]
    found = rows(drift)
    row = found["x.strain, x.piezo"]
    assert row.p_value < 1e-6
    assert row.finding.startswith("the runs differ: in sweep-")
    assert "x.piezo reads 1.01" in row.finding
    assert {name for name, other in found.items() if other.finding != "equal"} == {"x.strain, x.piezo"}


def test_a_clock_that_drifts_is_a_delay_that_grows():
    drift = [{"z1.piezo": np.exp(-2j * np.pi * FREQUENCY * 5e-5 * number)} for number in range(4)]
    row = rows(drift)["z1.strain, z1.piezo"]
    assert row.p_value < 1e-6
    assert "is late by 0.1499" in row.finding or "is late by 0.1500" in row.finding


def test_a_constant_difference_is_none_between_runs():
    same = [{"x.piezo": np.full(len(FREQUENCY), 1.02)}] * 4
    assert rows(same)["x.strain, x.piezo"].finding == "equal"


@pytest.mark.parametrize("cutoff", [2000.0, 500.0])
def test_a_filter_of_one_channel_is_none_either(cutoff):
    same = [{"x.piezo": 1.0 / (1.0 + 1j * FREQUENCY / cutoff)}] * 4
    assert rows(same)["x.strain, x.piezo"].finding == "equal"


def test_a_run_that_does_not_load_the_cell_tells_nothing_of_its_channels():
    """Noise over noise has a ratio too, and a fit of it a small sigma."""
    still = dict.fromkeys(("x.strain", "x.piezo"), np.zeros(len(FREQUENCY)))
    found = rows([{}, {}, still, still])["x.strain, x.piezo"]
    assert found.finding == "equal"
    assert found.dof == 1


def test_of_different_excitations_the_finding_says_what_else_it_may_be():
    drift = [{"x.piezo": np.full(len(FREQUENCY), 1.0 + 0.004 * (number == 3))} for number in range(4)]
    assert "crosstalk would show in the same way" in rows(drift)["x.strain, x.piezo"].finding
