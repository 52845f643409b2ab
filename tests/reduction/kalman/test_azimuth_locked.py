"""Oscillators locked to the azimuth: at one speed the steady filter, at a moving one close to the exact filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.reduction.kalman.augmented_model import sampled_system
from balance_cli.reduction.kalman.azimuth_locked import SPEED_SUBDIVISIONS, AzimuthLockedFilter
from balance_cli.reduction.kalman.filtering import filtered_estimates
from balance_cli.reduction.kalman.segments import segment_information
from balance_cli.reduction.kalman.smoothing import smoothed_estimates
from balance_cli.reduction.kalman.steady_filter import SteadyFilter
from tests.support.kalman_models import Array
from tests.support.turning_models import (
    LAYERS,
    OSCILLATORS,
    STEP,
    SYSTEM,
    accelerating_azimuth,
    draw_records,
    exact_estimates,
    locked_filters,
    prior_covariance,
    time_varying_models,
)

SAMPLES, BEGINNING = 1200, 400


def _channel_filter(speed: float, rate: float) -> AzimuthLockedFilter:
    filters, segments = locked_filters(accelerating_azimuth(speed, rate, SAMPLES * STEP), SAMPLES)
    channel_filter = filters.channel_filters[segments[0].channels]
    assert isinstance(channel_filter, AzimuthLockedFilter)
    return channel_filter


@pytest.fixture(scope="module")
def moving():
    """Speed from 9.4 to 10.6 Hz: its second harmonic passes the mode at 20 Hz."""
    azimuth = accelerating_azimuth(9.4, 0.2, SAMPLES * STEP)
    models, prior = time_varying_models(azimuth, SAMPLES), prior_covariance(azimuth)
    return locked_filters(azimuth, SAMPLES), models, prior, draw_records(models, prior, 24)


def _read(y: Array):
    return lambda start, stop, channels: y[start:stop][:, list(channels)]


def _joined(estimates) -> tuple[Array, Array]:
    parts = list(estimates)
    return np.concatenate([part.loads for part in parts]), np.concatenate([part.variance for part in parts])


@pytest.fixture(scope="module")
def still() -> tuple[AzimuthLockedFilter, SteadyFilter]:
    """At 10 Hz, a speed of the grid, and the filter of that speed's own model."""
    azimuth = accelerating_azimuth(10.0, 0.0, SAMPLES * STEP)
    channel_filter, size = _channel_filter(10.0, 0.0), np.sqrt(np.diag(prior_covariance(azimuth)))
    own = SteadyFilter(time_varying_models(azimuth, 1)[0].scaled(size))
    near = SteadyFilter(sampled_system(SYSTEM, [*LAYERS, OSCILLATORS.at(10.5)]).scaled(size))
    return replace(channel_filter, filters=(own, near), speeds=np.array([10.0, 10.5])), own


def test_at_one_speed_it_is_the_steady_filter(still):
    locked, steady = still
    rng = np.random.default_rng(0)
    y, start = 3.0 * rng.standard_normal((300, 3)), rng.standard_normal(steady.model.order)
    one, other = locked.forward_pass(7, y, start), steady.forward_pass(7, y, start)
    assert np.abs(one.innovation - other.innovation).max() < 1e-9
    assert np.abs(one.predicted - other.predicted).max() < 1e-9
    assert np.abs(one.end - other.end).max() < 1e-9
    assert np.abs(locked.filtered_outputs(one).loads - steady.filtered_outputs(other).loads).max() < 1e-9
    assert np.abs(locked.whiten_innovations(one) - steady.whiten_innovations(other)).max() < 1e-9
    after = rng.standard_normal(steady.model.order)
    (loads, rho), (own, steady_rho) = locked.backward_pass(one, after), steady.backward_pass(other, after)
    assert np.abs(loads.loads - own.loads).max() < 1e-9
    assert np.abs(rho - steady_rho).max() < 1e-9
    for smooth in (False, True):
        assert np.allclose(locked.variance(7, 5, smooth), steady.variance(7, 5, smooth), rtol=1e-12)


def test_a_block_keeps_only_the_last_state(still):
    """Many blocks are pending in the smoother; the states of all their samples would fill the memory."""
    locked, steady = still
    filter_block = locked.forward_pass(0, np.zeros((300, 3)), np.ones(steady.model.order))
    rho = locked.backward_pass(filter_block, np.ones(steady.model.order))[1]
    assert all(
        one.base is None or one.base.size <= 300 * 3
        for one in (filter_block.innovation, filter_block.predicted, filter_block.end)
    )
    assert rho.base is None


def test_marked_pairs_add_up_to_the_loads_of_the_oscillators(still):
    """Loads of oscillators only are the sum of p over the harmonics, filtered and smoothed."""
    locked, steady = still
    oscillator_states = np.zeros_like(steady.model.U)
    oscillator_states[:, locked.oscillator_states.states] = steady.model.U[:, locked.oscillator_states.states]
    alone, at = SteadyFilter(replace(steady.model, U=oscillator_states)), np.arange(0, 300, 20)
    locked = replace(locked, filters=(alone, alone), marked=at + 50)
    rng = np.random.default_rng(1)
    filter_block = locked.forward_pass(50, rng.standard_normal((300, 3)), rng.standard_normal(steady.model.order))
    for outputs in (
        locked.filtered_outputs(filter_block),
        locked.backward_pass(filter_block, np.zeros_like(filter_block.end))[0],
    ):
        p = outputs.marked.reshape(len(at), 2, 2, 2)[..., 0]
        assert np.abs(outputs.loads[at] - p.sum(axis=2)).max() < 1e-9


def test_filter_is_close_to_the_exact_one_while_the_speed_moves(moving):
    """By 0.2 Hz in a second: gains of a grid of speeds are 0.2 % of a standard deviation off, 1 % at most."""
    (filters, segments), models, prior, (y, _, _) = moving
    exact = exact_estimates(models, prior, y[0])
    loads, variance = _joined(filtered_estimates(_read(y[0]), segments, filters, BEGINNING))
    off = ((loads - exact.filtered) / np.sqrt(exact.filtered_variance))[BEGINNING:]
    assert np.sqrt(np.mean(off**2)) < 2e-3
    assert np.abs(off).max() < 1e-2
    assert np.abs(variance / exact.filtered_variance - 1.0)[BEGINNING:].max() < 2e-3


@pytest.mark.parametrize("count", [200, SAMPLES])
def test_information_of_a_segment_is_that_of_its_samples(moving, count):
    """The adjoint of channels that read nothing is -O d from the start d, sample by sample at their own speeds."""
    (filters, segments), _, prior, _ = moving
    channel_filter = filters.channel_filters[segments[0].channels]
    found, order = segment_information(channel_filter, segments[0], count), len(prior)
    columns = []
    for d in np.eye(order):
        filter_block = channel_filter.forward_pass(0, np.zeros((count, 3)), d)
        columns.append(-channel_filter.backward_pass(filter_block, np.zeros(order))[1])
    size = np.sqrt(np.diag(found))
    assert np.abs((found - np.column_stack(columns)) / np.outer(size, size)).max() < 0.02


def test_smoother_is_close_to_the_exact_one_while_the_speed_moves(moving):
    (filters, segments), models, prior, (y, _, _) = moving
    exact = exact_estimates(models, prior, y[0])
    loads, variance = _joined(smoothed_estimates(_read(y[0]), segments, filters, BEGINNING))
    off = (loads - exact.smoothed) / np.sqrt(exact.smoothed_variance)
    assert np.sqrt(np.mean(off**2)) < 2e-3
    assert np.abs(off).max() < 1e-2
    assert np.abs(variance / exact.smoothed_variance - 1.0).max() < 0.1
    assert np.abs(variance / exact.smoothed_variance - 1.0)[50:-50].max() < 5e-3


@pytest.mark.parametrize("kind", ["filter", "lag", "smoother"])
def test_errors_are_as_large_as_stated_while_the_speed_moves(moving, kind):
    (filters, segments), _, _, (y, u, _) = moving
    errors = []
    for channels, loads in zip(y, u, strict=True):
        if kind == "smoother":
            estimates = smoothed_estimates(_read(channels), segments, filters, BEGINNING)
        else:
            lag = 100 if kind == "lag" else None
            estimates = filtered_estimates(_read(channels), segments, filters, BEGINNING, lag)
        found, variance = _joined(estimates)
        errors.append(((found - loads) / np.sqrt(variance))[BEGINNING:])
    errors = np.array(errors)
    assert np.abs(np.mean(errors**2, axis=(0, 1)) - 1.0).max() < 0.06
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.06


def test_innovations_are_white_and_of_unit_size_while_the_speed_moves(moving):
    (filters, segments), _, _, (y, _, _) = moving
    parts = [
        np.concatenate([part.innovations for part in filtered_estimates(_read(one), segments, filters, BEGINNING)])
        for one in y[:8]
    ]
    white = np.array(parts)[:, BEGINNING:]
    count = white[:, :, 0].size
    covariance = np.einsum("rka,rkb->ab", white, white) / count
    assert np.abs(covariance - np.eye(3)).max() < 4.5 * np.sqrt(2.0 / count)
    next_to = np.einsum("rka,rkb->ab", white[:, 1:], white[:, :-1]) / count
    assert np.abs(next_to).max() < 4.5 / np.sqrt(count)


@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_backward_is_the_adjoint_of_forward(rate):
    """rho[0]' x[0] = sum of e[k]' S[k]^-1 H x[k] for any e, x[k] being what x[0] becomes where nothing is read."""
    channel_filter = _channel_filter(9.4, rate)
    rng = np.random.default_rng(2)
    order = channel_filter.filters[0].model.order
    start, after, e = rng.standard_normal(order), rng.standard_normal(order), rng.standard_normal((500, 3))
    free_block = channel_filter.forward_pass(100, np.zeros((500, 3)), start)
    rho = channel_filter.backward_pass(replace(free_block, innovation=e), after)[1]
    inverse = np.stack([np.linalg.inv(item.matrices.S) for item in channel_filter.filters])
    place = np.interp(channel_filter.oscillator_states.speed(100, 500), channel_filter.speeds, np.arange(len(inverse)))
    share = np.rint(SPEED_SUBDIVISIONS * place) / SPEED_SUBDIVISIONS
    weights = np.stack(
        [np.interp(share, np.arange(len(inverse)), column) for column in inverse.reshape(len(inverse), -1).T], axis=1
    ).reshape(-1, 3, 3)
    segment_information = -np.einsum("ka,kab,kb->", e, weights, free_block.innovation)
    assert np.isclose(rho @ start, segment_information + after @ free_block.end, rtol=1e-10)


def test_a_lag_uses_no_later_samples(moving):
    """Samples later than twice the lag have no effect."""
    (filters, segments), _, _, (y, _, _) = moving
    changed = y[0].copy()
    changed[1000:] += 100.0
    one, other = (_joined(filtered_estimates(_read(v), segments, filters, BEGINNING, 40))[0] for v in (y[0], changed))
    assert np.array_equal(one[:920], other[:920])
    assert np.abs(one[999] - other[999]).max() > 1.0
