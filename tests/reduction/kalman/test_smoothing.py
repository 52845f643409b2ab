"""Filters and smoothers against Gaussian conditioning by dense algebra: beginnings, gaps, lost channels, ends."""

from __future__ import annotations

import numpy as np
import pytest

from balance_cli.reduction.kalman import segments as segments_module
from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.filtering import filtered_estimates
from balance_cli.reduction.kalman.segments import Segment
from balance_cli.reduction.kalman.smoothing import smoothed_estimates
from tests.support.kalman_models import (
    Array,
    condition_on_samples,
    conditional_variance,
    draw_samples,
    small_model,
    steady_filters,
)

MODEL = small_model()
WHOLE = (Segment(0, 160, (0, 1, 2)),)
LONG = (Segment(0, 400, (0, 1, 2)),)
BROKEN = (
    Segment(0, 60, (0, 1, 2)),
    Segment(60, 72, ()),
    Segment(72, 110, (0, 1, 2)),
    Segment(110, 140, (0, 2)),
    Segment(140, 200, (0, 1, 2)),
)


def _read(y: Array):
    return lambda start, stop, channels: y[start:stop][:, list(channels)]


def _mask(segments: tuple[Segment, ...]):
    read = np.zeros((segments[-1].stop, 3), bool)
    for s in segments:
        read[s.start : s.stop, list(s.channels)] = True
    return read


def _joined(estimates):
    parts = list(estimates)
    assert [part.first for part in parts] == list(np.cumsum([0, *(len(part.loads) for part in parts[:-1])]))
    return np.concatenate([part.loads for part in parts]), np.concatenate([part.variance for part in parts])


@pytest.mark.parametrize("segments", [WHOLE, BROKEN], ids=["whole", "broken"])
@pytest.mark.parametrize("block", [8192, 17])
def test_smoother_is_conditioning(segments, block, monkeypatch):
    monkeypatch.setattr(segments_module, "BLOCK", block)
    y, _ = draw_samples(MODEL, segments[-1].stop)
    outputs, variance = _joined(smoothed_estimates(_read(y), segments, steady_filters(MODEL, segments), 200))
    mean, exact = condition_on_samples(MODEL, y, _mask(segments))
    assert np.abs(outputs - mean).max() < 1e-3 * np.sqrt(exact.min())
    assert np.abs(variance / exact - 1.0).max() < 2e-3


def test_smoother_is_conditioning_where_a_beginning_is_remembered_through_a_gap():
    """A load that hardly changes, hardly seen: all of the record tells of its beginning."""
    F, H = MODEL.F.copy(), MODEL.H * [0.1, 0.1, 0.003, 1.0]
    F[2], F[0, 3] = [0.0, 0.0, 0.9995, 0.0], 0.0
    G = np.array([[0.1, 0.0], [0.0, 0.1], [0.02, 0.0], [0.2, 0.4]])
    slow = SampledModel(F, G @ G.T + 1e-9 * np.eye(4), H, MODEL.U)
    y, _ = draw_samples(slow, BROKEN[-1].stop)
    outputs, variance = _joined(smoothed_estimates(_read(y), BROKEN, steady_filters(slow, BROKEN), 200))
    mean, exact = condition_on_samples(slow, y, _mask(BROKEN))
    assert np.abs(outputs - mean).max() < 1e-9 * np.sqrt(exact.min())
    assert np.abs(variance / exact - 1.0).max() < 1e-3


@pytest.mark.parametrize("signal", [1e2, 1e3, 1e4, 1e5])
def test_smoother_knows_how_far_it_errs_about_a_gap_of_loads_far_above_the_noise(signal):
    """What rounding leaves of a difference had been the variance there: zero, or a multiple."""
    model = SampledModel(MODEL.F, MODEL.Q, signal * MODEL.H, MODEL.U)
    segments = (Segment(0, 80, (0, 1, 2)), Segment(80, 90, ()), Segment(90, 190, (0, 1, 2)))
    y, _ = draw_samples(model, 190)
    _, variance = _joined(smoothed_estimates(_read(y), segments, steady_filters(model, segments), 100))
    ratio = variance / conditional_variance(model, _mask(segments))
    assert np.abs(ratio[40:150] - 1.0).max() < 0.01


def test_filter_is_conditioning_on_the_past_once_it_is_steady():
    y, _ = draw_samples(MODEL, 160)
    outputs, variance = _joined(filtered_estimates(_read(y), WHOLE, steady_filters(MODEL, WHOLE), 60))
    mean, exact = condition_on_samples(MODEL, y, _mask(WHOLE), until=np.arange(160))
    assert np.abs(outputs - mean)[60:].max() < 1e-3 * np.sqrt(exact.min())
    assert np.abs(variance / exact - 1.0)[60:].max() < 1e-3
    assert np.all(variance[60:] >= exact[60:] * (1 - 1e-6))


def test_filter_states_how_far_it_errs_after_a_gap():
    errors, stated = [], None
    for seed in range(300):
        y, u = draw_samples(MODEL, 200, seed)
        outputs, stated = _joined(filtered_estimates(_read(y), BROKEN, steady_filters(MODEL, BROKEN), 40))
        errors.append(outputs - u)
    scatter = np.mean(np.square(errors), axis=0)
    ratio = scatter / stated
    assert abs(ratio.mean() - 1.0) < 0.02
    assert np.abs(ratio[60:76].mean() - 1.0) < 0.1


def test_lag_is_conditioning_on_so_many_samples_more(monkeypatch):
    monkeypatch.setattr(segments_module, "BLOCK", 50)
    y, _ = draw_samples(MODEL, 160)
    outputs, variance = _joined(filtered_estimates(_read(y), WHOLE, steady_filters(MODEL, WHOLE), 60, 3))
    mean, exact = condition_on_samples(MODEL, y, _mask(WHOLE), until=np.minimum(np.arange(160) + 3, 159))
    assert np.abs(outputs - mean)[60:].max() < 1e-3 * np.sqrt(exact.min())
    assert np.abs(variance / exact - 1.0)[60:].max() < 1e-3


def _unbiased_inputs(F: Array, B: Array, H: Array, y: Array, known: int) -> Array:
    """Least squares for the first state and all inputs up to sample `known`, of which nothing is said beforehand."""
    n, m = len(F), B.shape[1]
    columns = [np.linalg.matrix_power(F, k) for k in range(known + 1)]
    rows = np.zeros(((known + 1) * len(H), n + known * m))
    for k in range(known + 1):
        part = slice(k * len(H), (k + 1) * len(H))
        rows[part, :n] = H @ columns[k]
        for j in range(k):
            rows[part, n + j * m : n + (j + 1) * m] = H @ columns[k - 1 - j] @ B
    return np.linalg.lstsq(rows, y[: known + 1].ravel(), rcond=None)[0][n:].reshape(-1, m)


def test_large_free_inputs_are_joint_estimation_of_inputs_and_states():
    """Held over a sample and far larger than all noise they are what least squares without any prior finds."""
    F, B = MODEL.F[:2, :2], np.array([[0.4], [0.1]])
    H = 30.0 * MODEL.H[:, :2]
    joint = np.block([[F, B], [np.zeros((1, 3))]])
    model = SampledModel(joint, np.diag([1e-9, 1e-9, 100.0]), np.hstack([H, np.zeros((3, 1))]), np.eye(3)[2:])
    y, _ = draw_samples(SampledModel(joint, np.diag([1e-9, 1e-9, 4.0]), model.H, model.U), 400, seed=3)
    lag = 4
    outputs, variance = _joined(filtered_estimates(_read(y), LONG, steady_filters(model, LONG), 10, lag))
    for k in (340, 370, 390):
        unbiased = _unbiased_inputs(F, B, H, y, k + lag)[k]
        assert np.abs(outputs[k] - unbiased).max() < 1e-3 * np.sqrt(variance[k]).max()
