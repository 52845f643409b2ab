"""Rounding by a converter: its steps, the part of its error that repeats, and the noise of periodic lines with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.periodic import periodic_record
from balance_cli.signals.quantization import quantization_steps, repeated_variance
from balance_cli.simulation import NO_NOISE, SweepPlan, simulate_run, true_rig
from tests.support.other_rigs import other_rig

Array = NDArray[np.float64]

RIG = other_rig("A")
PERIODS = 8


def multisine(samples: int, rng: np.random.Generator) -> Array:
    t = np.arange(samples) / samples
    return np.asarray(sum(np.cos(2 * np.pi * k * t + rng.uniform(0.0, 6.3)) for k in range(3, 60)))


def test_steps_are_those_of_the_converter() -> None:
    rng = np.random.default_rng(1)
    signal = multisine(4000, rng)
    steps = 0.01 * np.array([1.0, 3.0, 10.0])
    samples = np.round(signal[:, None] / steps) * steps + np.array([0.0, 0.5, -2.0])
    np.testing.assert_allclose(quantization_steps(samples), steps, rtol=1e-6)
    np.testing.assert_allclose(quantization_steps(samples.astype(np.float32).astype(float)), steps, rtol=1e-3)
    assert quantization_steps(np.full((100, 1), 0.3)) == 0.0
    for count in (4000, 200, 30):  # of a short period the least difference is no small one
        assert quantization_steps(signal[:count, None]) == 0.0


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5])
def test_the_part_that_repeats_falls_with_the_noise(noise: float) -> None:
    """Beside 40 periods the error of their mean, less that of the scatter, is what repeats."""
    rng = np.random.default_rng(2)
    signal = multisine(20000, rng)
    q = signal.std() / 30
    periods = [np.round((signal + noise * q * rng.normal(size=len(signal))) / q) * q for _ in range(40)]
    scatter = np.var(periods, axis=0, ddof=1).mean()
    repeated = np.mean((np.mean(periods, axis=0) - signal) ** 2) - scatter / len(periods)
    predicted = repeated_variance(np.array([q]), np.array([scatter]))
    assert repeated == pytest.approx(predicted[0], rel=0.1, abs=0.02 * q**2 / 12.0)


@pytest.fixture(scope="module")
def steady() -> Run:
    """The last period of a sweep, again and again."""
    excitation = {"excited": ("Fz",), "level": (40.0,), "band": (5.0, 260.0)}
    sweep = SweepPlan(run="sweep", period=1.0, periods=PERIODS, sample_rate=2000.0, **excitation)
    run, _ = simulate_run(true_rig(RIG), sweep, NO_NOISE)
    last = run.read(run.samples - run.samples // PERIODS, run.samples)
    return replace(run, source=MemorySource(np.tile(last.channels, (PERIODS, 1)), np.tile(last.loads, (PERIODS, 1))))


@pytest.mark.parametrize("bits", [9, 11, 13])
@pytest.mark.parametrize("noise", [0.02, 0.1, 0.3])
def test_the_error_of_lines_is_within_their_noise(steady: Run, bits: int, noise: float) -> None:
    """Of a converter whose range is twice the largest reading of each channel; noise in parts of its step."""
    block = steady.read()
    step = 4.0 * np.abs(block.channels).max(axis=0) / 2**bits
    noisy = block.channels + noise * step * np.random.default_rng(3).normal(size=block.channels.shape)
    converted = replace(steady, source=MemorySource(np.round(noisy / step) * step, block.loads))
    true, found = (periodic_record(run, RIG.channel_names).spectrum for run in (steady, converted))
    assert np.array_equal(true.frequency, found.frequency) and len(true.frequency) > 100
    error = np.abs(found.channels - true.channels) ** 2
    variance = np.einsum("kcc->kc", found.covariance).real[:, : error.shape[1]]
    assert np.mean(error) == pytest.approx(np.mean(variance), rel=0.2)
