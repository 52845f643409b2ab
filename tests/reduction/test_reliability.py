"""What the residual test does not show of errors of sensors, against loads that are solved with such an error."""

import numpy as np
import pytest

from balance_cli.reduction.reliability import SENSOR_ERROR, UnnoticedErrors, join_harmonics, unnoticed_errors
from balance_cli.reduction.response_sources import circular_real, stacked_real
from balance_cli.reduction.weighted_least_squares import solve_loads

SENSORS = ("cell a", "cell b", "cell b", "cell c", "cell d")
HARMONICS = 3


@pytest.fixture(scope="module")
def problem():
    """Two loads on five channels: cell a is the only one that tells the second load."""
    rng = np.random.default_rng(5)
    T = rng.standard_normal((HARMONICS, 5, 2)) + 1j * rng.standard_normal((HARMONICS, 5, 2))
    T[:, 1:, 1] = 0.0
    loads = np.array([2.0 + 1.0j, -0.5 + 3.0j])
    y = T @ loads
    noise = circular_real(np.broadcast_to(np.diag([1e-8, 2e-8, 1e-8, 3e-8, 1e-8]).astype(complex), (HARMONICS, 5, 5)))
    return T, y, noise


def solve(problem, factors=(1.0,) * 5):
    T, y, noise = problem
    read = y * np.array(factors)
    stacked = np.concatenate([read.real, read.imag], axis=1)
    infinite = np.full(HARMONICS, np.inf)
    return solve_loads(stacked_real(T), stacked, noise, infinite, lambda loads: 0.0 * noise, np.ones(4))


def found(solution, degrees=None):
    degrees = solution.degrees if degrees is None else degrees
    return unnoticed_errors(solution.equations, SENSORS, degrees, solution.limit)


def test_a_load_on_one_sensor_changes_by_its_error_without_a_contradiction(problem):
    solution = solve(problem)
    errors = found(solution)
    assert [errors.sensors[n] for n in errors.sensor[:, 1]] == ["cell a"] * HARMONICS
    wrong = solve(problem, (1.0 + SENSOR_ERROR, 1.0, 1.0, 1.0, 1.0))
    assert np.all(wrong.redundancy_chi2 < 1e-9)
    np.testing.assert_allclose(errors.change[:, 1], np.abs(wrong.loads - solution.loads)[:, 1], rtol=1e-9)


def test_the_error_of_a_sensor_that_others_test_is_one_that_brings_chi_square_to_its_limit(problem):
    solution = solve(problem)
    only = found(solution).change[:, 0]
    changes = []
    for sensor in dict.fromkeys(SENSORS):
        unit = solve(problem, [1.0 + SENSOR_ERROR * (name == sensor) for name in SENSORS])
        size = np.minimum(np.sqrt((solution.limit - 1.0) / unit.redundancy_chi2), 1.0)
        changes.append(size * np.abs(unit.loads - solution.loads)[:, 0])
    np.testing.assert_allclose(only, np.max(changes, axis=0), rtol=1e-6)
    assert np.all(only < 0.5 * SENSOR_ERROR * np.abs(solution.loads[:, 0]))


def test_without_redundancy_the_whole_error_is_unnoticed(problem):
    solution = solve(problem)
    changes = []
    for sensor in dict.fromkeys(SENSORS):
        wrong = solve(problem, [1.0 + SENSOR_ERROR * (name == sensor) for name in SENSORS])
        changes.append(np.abs(wrong.loads - solution.loads))
    np.testing.assert_allclose(found(solution, np.zeros(HARMONICS)).change, np.max(changes, axis=0), rtol=1e-9)
    assert np.all(found(solution).change[:, 0] < 0.5 * np.max(changes, axis=0)[:, 0])


def test_only_changes_that_matter_are_named():
    errors = UnnoticedErrors(("cell a", "torque meter"), np.array([[0, 1], [0, 1]]), np.array([[3.0, 0.1], [5.0, 9.0]]))
    size, sigma = np.full((2, 2), 20.0), np.array([[0.1, 0.1], [0.1, 5.0]])
    note = errors.describe(("Fx", "Mz"), size, sigma)
    assert note == (
        "an error of up to 1 % in cell a, which the residual test does not show, "
        "changes Fx at harmonic 2 by 5 N (load 20 N)"
    )
    assert errors.describe(("Fx", "Mz"), 100.0 * size, sigma) == ""


def test_tones_are_joined_where_all_have_the_same_sensors():
    one = UnnoticedErrors(("cell a",), np.array([[0]]), np.array([[1.0]]))
    other = UnnoticedErrors(("cell b",), np.array([[0]]), np.array([[2.0]]))
    np.testing.assert_array_equal(join_harmonics([one, one]).change, [[1.0], [1.0]])
    assert join_harmonics([one, other]) is None and join_harmonics([one, None]) is None
