"""Lines of a static run whose load readings are noisier than its channels: nothing lost, and nothing counted twice."""

from collections.abc import Iterator

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.significance import gain_p_value
from balance_cli.estimation.noise_precision import live_precision
from balance_cli.estimation.noise_uncertainty import noise_uncertainty
from balance_cli.estimation.static_lines import static_lines
from balance_cli.signals.run_spectrum import NoisePart, StaticPoints
from balance_cli.signals.static_noise import static_points
from balance_cli.simulation import StaticPlan
from balance_cli.simulation.statics import static_load_points

CHANNELS = 8
LOAD_OVER_CHANNEL_NOISE = 30.0
"""As of a small stiff rig: what the noise of a load reading does to the channels, over their own."""
LADDERS = StaticPlan(run="static", largest=dict.fromkeys(COMPONENTS, 10.0), steps=2)
ONE_WAY = StaticPlan(
    run="static",
    points=[{name: level} for name in COMPONENTS for level in (3.0, 6.0, 9.0)] + [{"Fx": 5.0, "Mz": 5.0}] * 3,
)
TRIMMED = LADDERS.model_copy(update={"trim": "trim", "trim_loads": {"Fz": 20.0}})


def points_of(plan: StaticPlan, seed: int = 0, share: bool = True) -> StaticPoints:
    """Readings without load noise in rows at rest; a column c_j of noise where load j was applied."""
    rng = np.random.default_rng(seed)
    loads = static_load_points(plan)
    columns, sigma = LOAD_OVER_CHANNEL_NOISE * rng.normal(size=(CHANNELS, 6)), np.eye(CHANNELS)
    applied = (loads != 0.0).astype(float)
    noise = rng.normal(size=(len(loads), CHANNELS)) + (applied * rng.normal(size=loads.shape)) @ columns.T
    sometimes = [j for j in range(6) if applied[:, j].mean() < 1.0]
    parts = [NoisePart(sigma, np.ones(len(loads)), 1.0, 0.1)]
    parts += [NoisePart(np.outer(columns[:, j], columns[:, j]), applied[:, j], 1.0, 0.1) for j in sometimes]
    names = tuple(f"c{i}" for i in range(CHANNELS))
    weights = np.ones(CHANNELS) if share else None
    channels = 7.0 + loads @ columns.T + noise
    return StaticPoints("static", "bare", names, channels, loads, sigma, 30.0, share=weights, noise_parts=tuple(parts))


def basis_of(points: StaticPoints) -> np.ndarray:
    """Q (m, m-1), by which the rows became lines."""
    waveform = static_lines(points).waveform
    assert waveform is not None
    return np.asarray(waveform.projection.T)


def step_directions(points: StaticPoints) -> Iterator[np.ndarray]:
    """What an offset of each load that was not always applied adds to the rows (m, c)."""
    for part in points.noise_parts[1:]:
        column = part.shape[:, np.argmax(np.diag(part.shape))]
        yield np.outer(part.share, column / np.linalg.norm(column))


def exact_covariance(points: StaticPoints, Q: np.ndarray) -> np.ndarray:
    """Covariance of all lines and channels together (k c, k c)."""
    return np.asarray(sum(np.kron(Q.T @ (p.share[:, None] * Q), p.size * p.shape) for p in points.noise_parts))


def counted_covariance(points: StaticPoints) -> np.ndarray:
    """The same as the estimators take it: lines are independent."""
    lines, c = static_lines(points), CHANNELS
    k = len(lines.frequency)
    covariance = np.zeros((k, c, k, c))
    covariance[np.arange(k), :, np.arange(k), :] = 0.5 * lines.covariance[:, :c, :c].real
    return covariance.reshape(k * c, k * c)


@pytest.mark.parametrize("plan", [LADDERS, ONE_WAY, TRIMMED])
def test_lines_hold_all_of_the_rows_but_their_constant(plan):
    points = points_of(plan)
    lines, Q = static_lines(points), basis_of(points)
    m = len(points.loads)
    np.testing.assert_allclose(Q.T @ Q, np.eye(m - 1), atol=1e-12)
    np.testing.assert_allclose(Q.T @ np.ones(m), 0.0, atol=1e-12)
    np.testing.assert_allclose(Q @ lines.loads.real, points.loads - points.loads.mean(axis=0), atol=1e-11)


@pytest.mark.parametrize("plan", [LADDERS, ONE_WAY, TRIMMED])
def test_independent_lines_are_never_surer_than_the_correlated_ones(plan):
    points = points_of(plan)
    excess = counted_covariance(points) - exact_covariance(points, basis_of(points))
    values = np.linalg.eigvalsh(excess)
    assert values[0] > -1e-9 * values[-1]


@pytest.mark.parametrize("plan", [LADDERS, ONE_WAY, TRIMMED])
def test_information_about_an_offset_of_a_load_is_that_of_the_rows(plan):
    """It is a step in the very direction of the noise of that load, which every row with the load has anew."""
    points = points_of(plan)
    Q = basis_of(points)
    exact, counted = exact_covariance(points, Q), counted_covariance(points)
    for rows in step_directions(points):
        step = (Q.T @ rows).reshape(-1)
        share = (step @ np.linalg.solve(counted, step)) / (step @ np.linalg.solve(exact, step))
        assert 0.5 < share < 1.0 + 1e-9


def test_lines_of_the_linear_part_alone_are_no_surer_either():
    """Without the nonlinear part of the rows a line mixes rows with and without a load."""
    points = points_of(ONE_WAY, share=False)
    loads = points.loads - points.loads.mean(axis=0)
    excess = counted_covariance(points) - exact_covariance(points, np.linalg.qr(loads)[0])
    values = np.linalg.eigvalsh(excess)
    assert values[0] > -1e-9 * values[-1]


def test_rows_with_equal_noise_are_one_group():
    """Then the loads are in the first lines alone, as if no parts of the noise were known."""
    rng = np.random.default_rng(3)
    loads = rng.normal(size=(30, 6))
    points = StaticPoints("static", "bare", ("a", "b"), loads[:, :2], loads, np.eye(2), 9.0, share=np.ones(2))
    np.testing.assert_allclose(static_lines(points).loads[6:], 0.0, atol=1e-12)


@pytest.mark.parametrize("load_noise", [4.0, 20.0])
@pytest.mark.parametrize("grows", [False, True])
def test_slopes_have_the_distribution_that_their_noise_says(load_noise, grows):
    """Ladders of two steps, of which two pairs of equal loads tell the noise of a reading: F(1, 2), not chi-square.

    `load_noise`: of a full load over what the channels resolve; it `grows` with the load, as that of weights does.
    """
    rng, p_values = np.random.default_rng(4), []
    cycle = np.array([0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0])
    loads = np.concatenate([np.outer(cycle, np.eye(6)[i]) for i in range(6)])
    names = tuple(f"c{i}" for i in range(12))
    for _ in range(40):
        slopes = rng.normal(size=(12, 6))
        sigma = 1e-4 * (loads @ slopes.T).std(axis=0)
        resolved = 1.0 / np.sqrt(np.sum((slopes / sigma[:, None]) ** 2, axis=0))
        error = load_noise * resolved * rng.normal(size=loads.shape) * (np.abs(loads) if grows else loads != 0.0)
        volts = loads @ slopes.T + sigma * rng.normal(size=(len(loads), 12))
        source = MemorySource(volts, loads + error)
        lines = static_lines(static_points(Run("static", "rig", "static", names, len(loads), source), names))
        precision = live_precision(lines, True).real
        for k in range(6):
            along = slopes @ lines.loads[k].real
            influence = np.zeros((len(lines.frequency), 12, 1), complex)
            influence[k, :, 0] = precision[k] @ along
            score = influence[k, :, 0].real @ (lines.channels[k].real - along)
            dof = 2.0 / noise_uncertainty(lines.noise_parts, influence)[0]
            gain = 2.0 * score**2 / (influence[k, :, 0].real @ along)
            p_values.append(gain_p_value(gain, 1, float(dof)))
    assert np.mean(np.array(p_values) < 0.01) < 0.035, "0.17 to 0.50 with the diagonal of the covariance inverted"


@pytest.mark.parametrize("share", [None, np.ones(2)])
@pytest.mark.parametrize("zeros", [0.0, 1.0, 1e4])
def test_the_zeros_of_stated_load_series_are_in_no_line(share, zeros):
    """Zeros of 2 and 20 mV had raised chi-square of a sound static run to 45 and 4500 per degree of freedom."""
    rng = np.random.default_rng(8)
    series = np.repeat(np.arange(6), 7)
    ramp = np.array([0, 1, 2, 3, 2, 1, 0]) / 3
    loads = np.vstack([np.outer(ramp, 100.0 * np.eye(6)[j]) for j in range(6)])
    matrix = rng.standard_normal((2, 6))
    exact = loads @ matrix.T
    shifted = exact + zeros * rng.standard_normal((6, 2))[series]
    points = StaticPoints("static", "bare", ("a", "b"), shifted, loads, np.eye(2), 30.0, share=share, series=series)
    lines = static_lines(points)
    columns = [("Fx", "Fy", "Fz", "Mx", "My", "Mz").index(name) for name in lines.components]
    assert np.allclose(lines.channels, lines.loads @ matrix[:, columns].T, atol=1e-6)
    assert np.linalg.matrix_rank(lines.loads.real) == 6
