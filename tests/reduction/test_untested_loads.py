"""Loads that rest on one sensor are untested, others with redundant sensors are not."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.reduction.load_spectra import load_spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import circular_real, stacked_real
from balance_cli.reduction.run_verdict import WITH_CARE, run_verdict, untested_loads
from balance_cli.reduction.untested_loads import untested_harmonics, untested_means
from balance_cli.reduction.weighted_least_squares import LoadEquations, solve_loads
from balance_cli.steps.reduce import reduce_run
from tests.support.channels import with_channel

SENSORS = ("cell a", "cell b", "cell b", "cell c", "cell d")
HARMONICS = 6
NOISE = circular_real(np.broadcast_to(1e-8 * np.eye(5, dtype=complex), (HARMONICS, 5, 5)))


@pytest.fixture(scope="module")
def response():
    """Of five channels for two loads cell a is the only one that tells the second load."""
    rng = np.random.default_rng(5)
    T = rng.standard_normal((HARMONICS, 5, 2)) + 1j * rng.standard_normal((HARMONICS, 5, 2))
    T[:, 1:, 1] = 0.0
    return T


def solved(T, loads, factors=(1.0,) * 5):
    y = T @ np.asarray(loads) * np.array(factors)
    stacked = np.concatenate([y.real, y.imag], axis=1)
    exact = np.full(HARMONICS, np.inf)
    return solve_loads(stacked_real(T), stacked, NOISE, exact, lambda f: 0.0 * NOISE, np.ones(4))


def untested(solution):
    variance = np.diagonal(solution.covariance, axis1=1, axis2=2)[:, :2]
    return untested_harmonics(solution.equations, SENSORS, solution.degrees, solution.limit, np.sqrt(variance))


@pytest.mark.parametrize("loads", [(2.0 + 1.0j, -0.5 + 3.0j), (2.0, 0.0), (0.0, 1.0), (0.0, 0.0)])
def test_a_load_on_one_sensor_is_untested_whatever_its_size_and_the_other_is_not(response, loads):
    assert untested(solved(response, loads)).tolist() == [[False, True]] * HARMONICS


def test_what_is_untested_is_wrong_without_a_contradiction_where_the_sensor_is_reversed(response):
    loads = np.array([0.0, 1.0])
    wrong = solved(response, loads, (-1.0, 1.0, 1.0, 1.0, 1.0))
    assert not wrong.misfit.any() and np.all(np.abs(wrong.loads[:, 1] - 1.0) > 1.9)


def test_with_a_second_sensor_no_load_is_untested(response):
    both = response.copy()
    both[:, 4, 1] = 0.7
    assert not untested(solved(both, (2.0, 1.0))).any()
    one_cell = both.copy()
    one_cell[:, 4, 1], one_cell[:, 1, 1] = 0.0, 0.7
    assert not untested(solved(one_cell, (2.0, 1.0))).any()


def test_a_test_at_some_harmonics_is_one_of_all(response):
    both = response.copy()
    both[:3, 4, 1] = 0.7
    loads = untested(solved(both, (2.0, 1.0)))
    assert not loads.any()
    both[1:3, 4, 1] = 0.0
    assert untested(solved(both, (2.0, 1.0)))[:, 1].tolist() == [False, *[True] * (HARMONICS - 1)]


def test_errors_of_the_response_notice_no_sensor(response):
    """A measured response has a remainder of its own for the loads that a wrong sensor makes: 1 % of what is read.

    It had been taken for what shows the sensor wrong, and the load was tested.
    """
    measured = response.copy()
    measured[:, 1:, 1] = 0.01 * np.exp(1j * np.arange(4)) * response[:, :1, 1]
    solution = solved(measured, (0.01, 1.0))
    sigma = np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2)[:, :2])
    at = (solution.equations, SENSORS, solution.degrees, solution.limit, sigma)

    def by_response(loads):
        size = np.abs(loads[:, 1] + 1j * loads[:, 3])[:, None, None] ** 2
        return 1e-4 * size * np.mean(np.abs(response[:, 0, 1]) ** 2) * np.eye(10)

    assert untested_harmonics(*at, None, by_response)[:, 1].all()
    assert not untested_harmonics(*at, None, None)[:, 1].any()


def test_means_count_sensors_and_what_each_of_them_tells():
    T = np.array([[1.0, 0.0], [0.8, 0.0], [0.9, 0.0], [0.0, 1.0]])
    G = np.linalg.pinv(T)
    equations = LoadEquations(T, T @ [100.0, 0.0], 1e-4 * np.eye(4), G)
    sigma = 1e-2 * np.sqrt(np.diagonal(G @ G.T))
    assert untested_means(equations, ("a", "b", "c", "d"), 5.0, sigma).tolist() == [False, True]
    assert untested_means(equations, ("a", "a", "a", "d"), 5.0, sigma).tolist() == [True, True]


@pytest.fixture(scope="module")
def source(identified):
    return model_source(identified)


def untested_rows(loads):
    return {(loads.components[j], h) for h, row in enumerate(loads.flags) for j in range(6) if "untested" in row[j]}


def test_of_the_sample_rig_mz_rests_on_the_torque_meter_and_means_of_fx_and_my_on_cell_x(campaign, calibration, source):
    wind = campaign.runs_of_kind("wind")[0]
    found = reduce_run(wind, campaign.geometry, calibration, source)
    assert untested_rows(found) == {("Fx", 0), ("My", 0), *(("Mz", h) for h in range(9))}
    assert untested_loads(found) == ("the means of Fx and My", "Mz (torque meter alone)")
    verdict = run_verdict(found)
    words = "no redundant sensor tests the means of Fx and My and Mz (torque meter alone) (untested: 11 of 54 rows)"
    assert verdict.word == WITH_CARE and words in verdict.reasons
    turned = reduce_run(with_channel(wind, "torque", np.negative), campaign.geometry, calibration, source)
    mz = found.components.index("Mz")
    assert np.all(np.abs(turned.amplitude + found.amplitude)[:, mz] < 1e-4 * np.abs(found.amplitude[:, mz]))
    assert all("untested" in row[mz] for row in turned.flags)


def test_a_shift_of_cell_x_since_the_zero_is_untested_where_it_moves_the_means(campaign, calibration, source):
    wind = campaign.runs_of_kind("wind")[0]
    sound = reduce_run(wind, campaign.geometry, calibration, source)
    shifted = with_channel(wind, "x.strain", lambda volts: volts + 0.5 * np.abs(volts).max())
    found = reduce_run(shifted, campaign.geometry, calibration, source)
    moved = np.abs(found.amplitude - sound.amplitude)[0] > 10.0 * found.sigma_cosine[0]
    assert moved.any()
    assert all("untested" in flag for flag, wrong in zip(found.flags[0], moved, strict=True) if wrong)


def test_spectra_of_a_component_that_rests_on_one_sensor_are_untested(campaign, source):
    wind = campaign.runs_of_kind("wind")[0]
    found = load_spectra(wind, campaign.geometry, source, (5.0, 100.0))
    table = found.to_frame()
    flagged = table[table["flag"].str.contains("untested")]
    assert found.untested == ("Mz",) and set(flagged["component"]) == {"Mz"}
    assert len(flagged) == len(found.frequency_hz)
    without = replace(found, flags=("",) * len(found.flags))
    assert without.trust == "untested" and replace(without, untested=None).trust == "good"


def test_in_short_records_the_search_for_mistakes_tests_sensors_that_the_residual_test_does_not(response):
    both = response.copy()
    both[:, 4, 1] = 0.7
    solution = solved(both, (2.0, 1.0))
    variance = np.diagonal(solution.covariance, axis1=1, axis2=2)[:, :2]
    given = (solution.equations, SENSORS, solution.degrees, np.full(HARMONICS, 1e15), np.sqrt(variance))
    assert untested_harmonics(*given)[:, 1].all()
    assert not untested_harmonics(*given, NOISE).any()
