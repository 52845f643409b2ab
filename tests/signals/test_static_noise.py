"""Noise of static rows from differences along the loading: right whatever smooth misfit the straight line has."""

from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals import static_noise
from balance_cli.signals.static_noise import second_differences, static_points
from balance_cli.simulation import CampaignPlan, Noise, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import static_plans
from tests.support.rigs import rotor_balance

CHANNELS = ("a", "b", "c", "d")
SIGMA = 2e-4
COVARIANCE = SIGMA**2 * (np.eye(4) + 0.4)
AMPLITUDE = np.array([800.0, 800.0, 3500.0, 150.0, 150.0, 500.0])
REPEATS = 120


def sequence() -> np.ndarray:
    """Each component in turn up, down, through zero and back, in steps of a fifth: 121 rows."""
    cycle = np.concatenate([np.arange(1, 6), np.arange(4, -6, -1), np.arange(-4, 1)]) / 5
    rows = [np.zeros((1, 6))]
    for j in range(6):
        block = np.zeros((len(cycle), 6))
        block[:, j] = cycle * AMPLITUDE[j]
        rows.append(block)
    return np.concatenate(rows)


def play(loads: np.ndarray, width: float) -> np.ndarray:
    """Hysteresis -1 to 1 of each component: a contact that slips after `width` steps."""
    step = width * np.abs(np.diff(loads, axis=0)).max(axis=0)
    slider, state = np.zeros(6), []
    for row in loads:
        slider = np.clip(slider, row - step, row + step)
        state.append((row - slider) / step)
    return np.array(state)


def misfit(kind: str, loads: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if kind == "cubic":
        return 10 * SIGMA * (loads / AMPLITUDE) ** 3 @ rng.normal(size=(6, 4))
    if kind == "quadratic":
        return 10 * SIGMA * (loads / AMPLITUDE) ** 2 @ rng.normal(size=(6, 4))
    if kind == "hysteresis that jumps":
        return 3 * SIGMA * play(loads, 0.5) @ rng.normal(size=(6, 4))
    if kind == "hysteresis that bends":
        return 2 * SIGMA * play(loads, 2.0) @ rng.normal(size=(6, 4))
    if kind == "drift":
        return 20 * SIGMA * np.linspace(0, 1, len(loads))[:, None] ** 2 * np.ones(4)
    return np.zeros((len(loads), 4))


def run_of(loads: np.ndarray, channels: np.ndarray) -> Run:
    return Run("static", "rig", "static", CHANNELS, len(loads), MemorySource(channels, loads), trim="bare")


@cache
def estimates(kind: str, load_noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    C0 = 1e-3 * rng.normal(size=(4, 6))
    root, loads, covariances, dofs = np.linalg.cholesky(COVARIANCE), sequence(), [], []
    for _ in range(REPEATS):
        channels = loads @ C0.T + rng.normal(size=(len(loads), 4)) @ root.T + misfit(kind, loads, rng)
        read = loads + load_noise * rng.normal(size=loads.shape)
        points = static_points(run_of(read, channels), CHANNELS)
        covariances.append(points.covariance)
        dofs.append(points.dof)
    return np.array(covariances), np.array(dofs)


@pytest.mark.parametrize(
    "kind", ["none", "cubic", "quadratic", "hysteresis that jumps", "hysteresis that bends", "drift"]
)
def test_covariance_is_right_whatever_the_misfit(kind):
    covariances, _ = estimates(kind)
    tolerance = 0.09 if kind == "hysteresis that bends" else 0.05
    assert covariances.mean(axis=0) / COVARIANCE[0, 0] == pytest.approx(COVARIANCE / COVARIANCE[0, 0], abs=tolerance)


def test_degrees_of_freedom_are_those_of_the_scatter():
    """The variance of a variance estimated with n degrees of freedom is 2/n of its square."""
    covariances, dofs = estimates("none")
    relative = np.diagonal(covariances, axis1=1, axis2=2) / np.diagonal(COVARIANCE)
    assert dofs.mean() > 40
    assert np.mean(np.var(relative, axis=0)) == pytest.approx(2 / dofs.mean(), rel=0.25)


def test_noise_of_the_load_readings_is_in_it():
    rng = np.random.default_rng(8)
    C0 = 1e-3 * rng.normal(size=(4, 6))
    covariances, _ = estimates("none", load_noise=0.2)
    expected = COVARIANCE + 0.2**2 * C0 @ C0.T
    assert np.diagonal(covariances.mean(axis=0)) == pytest.approx(np.diagonal(expected), rel=0.08)


def test_one_wild_row_hardly_matters():
    rng = np.random.default_rng(5)
    loads = sequence()
    channels = SIGMA * rng.normal(size=(len(loads), 4))
    clean = static_points(run_of(loads, channels), CHANNELS).covariance
    channels[47] += 50 * SIGMA
    spoilt = static_points(run_of(loads, channels), CHANNELS).covariance
    assert np.trace(spoilt) < 2.0 * np.trace(clean)


def test_second_differences_vanish_on_straight_lines_of_uneven_steps():
    loads = np.zeros((8, 6))
    loads[:, 0] = [0, 1, 3, 4, 8, 9, 11, 12]
    operator = second_differences(loads)
    assert len(operator) == 5
    assert operator @ loads[:, 0] == pytest.approx(np.zeros(5), abs=1e-12)
    assert np.linalg.norm(operator, axis=1) == pytest.approx(np.ones(5))


def test_random_poses_have_no_ramp():
    rng = np.random.default_rng(6)
    loads = rng.normal(size=(40, 6))
    with pytest.raises(UserError, match="within a ramp"):
        static_points(run_of(loads, rng.normal(size=(40, 4))), CHANNELS)


@pytest.mark.parametrize("volts", [0.0, 1.0])
def test_rows_of_one_load_are_refused(volts):
    """Without any load and any reading the covariance of the noise had no inverse."""
    rows, channels = np.full((25, 6), volts), np.full((25, 2), volts)
    run = Run("static", "RTS-6", "static", ("a", "b"), 25, MemorySource(channels, rows), True)
    with pytest.raises(UserError, match="its loads do not change"):
        static_points(run, ("a", "b"))


def test_a_row_has_the_noise_of_a_load_only_where_that_was_applied():
    """The torque meter reads 0.02 V/(N m): beside its own 0.2 mV the moment's 0.05 N m are 1 mV."""
    rig, noise = true_rig(rotor_balance()), Noise()
    variances = []
    for seed in range(8):
        runs, _ = simulate_campaign(rig, CampaignPlan(runs=static_plans()[:1]), seed=seed)
        points = static_points(runs[0], runs[0].channel_names)
        torque = points.channel_names.index("torque")
        variance = sum(part.covariance for part in points.noise_parts)[:, torque, torque]
        twisted = points.loads[:, 5] != 0.0
        assert np.ptp(variance[twisted]) == 0.0
        variances.append((variance[twisted].mean(), variance[~twisted].mean()))
    of_moment = noise.static_channel**2 + (0.02 * noise.static_load) ** 2
    assert np.mean(variances, axis=0) == pytest.approx([of_moment, noise.static_channel**2], rel=0.35)


def test_what_is_known_of_a_loads_noise_is_said():
    """Some twenty rows, of which neighbors share their differences, tell the variance of a reading to a half."""
    rig, noise = true_rig(rotor_balance()), Noise()
    sizes, errors = [], []
    for seed in range(24):
        runs, _ = simulate_campaign(rig, CampaignPlan(runs=static_plans()[:1]), seed=seed)
        moment = static_points(runs[0], runs[0].channel_names).noise_parts[6]
        sizes.append(moment.size)
        errors.append(moment.error)
    true = noise.static_load**2
    assert np.mean(sizes) == pytest.approx(true, rel=0.3)
    assert np.std(sizes) == pytest.approx(np.mean(errors), rel=0.4)
    assert 0.3 < np.mean(errors) / true < 0.7


def test_a_load_that_no_difference_tells_of_is_unknown_but_for_a_bound():
    """One component in a ramp, another at single rows between which nothing is compared."""
    rng = np.random.default_rng(3)
    loads = np.zeros((60, 6))
    loads[:50, 0] = 100.0 * np.arange(50)
    loads[52::3, 1] = [100.0, -100.0, 50.0]
    channels = loads @ rng.normal(size=(6, 4)) * 1e-3 + SIGMA * rng.standard_normal((60, 4))
    parts = static_points(run_of(loads, channels), CHANNELS).noise_parts
    assert len(parts) > 1
    assert all(np.isfinite(part.size) and np.isfinite(part.error) for part in parts)
    shape, channels_alone = parts[-1].shape, parts[0].shape
    visible = 1.0 / np.trace(np.linalg.solve(channels_alone, shape))
    assert parts[-1].error == pytest.approx(1e3 * (parts[-1].size + visible))


def test_short_ramps_up_and_down_tell_their_noise_from_repeated_loads():
    cycle = np.array([0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0])
    loads = np.concatenate([np.outer(cycle, np.eye(6)[j] * AMPLITUDE[j]) for j in range(6)])
    # Weights are never equal to the last digit.
    rng = np.random.default_rng(7)
    loads *= 1 + 1e-5 * rng.normal(size=loads.shape)
    square = (loads / AMPLITUDE) ** 2 @ rng.normal(size=(6, 4))
    ratios = []
    for _ in range(REPEATS):
        noise = rng.multivariate_normal(np.zeros(4), COVARIANCE, size=len(loads))
        points = static_points(run_of(loads, loads / AMPLITUDE @ np.ones((6, 4)) + 0.05 * square + noise), CHANNELS)
        ratios.append(np.diag(points.covariance) / np.diag(COVARIANCE))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)


def test_ramps_of_two_steps_to_both_sides_tell_the_noise():
    """Of their only difference along a ramp nothing is left beside squares and cubes; equal loads tell the noise."""
    rng = np.random.default_rng(5)
    ramp = np.array([0.5, 1.0, 0.5, -0.5, -1.0, -0.5])
    loads = np.zeros((36, 6))
    for j in range(6):
        loads[6 * j : 6 * j + 6, j] = ramp * AMPLITUDE[j]
    channels = loads @ (1e-3 * rng.normal(size=(4, 6))).T + SIGMA * rng.normal(size=(36, 4))
    points = static_points(run_of(loads, channels), CHANNELS)
    assert np.sqrt(np.diag(points.covariance)) == pytest.approx(SIGMA, rel=0.8)
    assert points.dof > 4


@pytest.mark.parametrize("constant_rows", [0, 200])
def test_some_of_many_rows_suffice_unless_they_tell_nothing(constant_rows):
    """A long run; behind rows at one load that show nothing, all rows are used."""
    rng = np.random.default_rng(4)
    ramp = np.concatenate([np.linspace(0, 1, 30), np.linspace(1, 0, 30)])
    loads = np.concatenate([np.zeros((constant_rows, 6)), np.outer(np.tile(ramp, 5), rng.uniform(1, 2, 6))])
    operator = static_noise.second_differences(loads)
    whole = int(np.linalg.matrix_rank(static_noise._difference_operator(loads, operator)))
    few = static_noise._independent_differences(loads, operator, 4)
    assert 4 <= few < whole
    assert static_noise._independent_differences(loads, operator, whole) == whole
    assert static_noise._independent_differences(loads, operator, whole + 1) == whole
