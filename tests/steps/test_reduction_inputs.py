"""Inputs of a reduction: a wind-off record that does not move is a zero where the converter is coarse."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.io.errors import UserError
from balance_cli.steps.reduction_inputs import zero_reference
from tests.support.nonlinear_rig import NAMES, calibration, record


def test_a_zero_run_whose_channels_are_all_constant_is_refused_with_its_cause():
    quiet = record("zero", np.zeros(6), noise=0.0, kind="zero")
    with pytest.raises(UserError, match=r"^zero, channels: no strain or torque channel can be used .*dead: constant"):
        zero_reference([quiet], calibration())


def test_a_zero_run_in_which_some_channels_move_has_these():
    noisy = record("zero", np.zeros(6), kind="zero", seed=5)
    reference = zero_reference([noisy], calibration())
    assert reference is not None
    assert reference.channel_names == tuple(NAMES)


def test_a_zero_run_with_too_few_channels_is_refused_with_their_reasons():
    noisy = record("zero", np.zeros(6), kind="zero", seed=5)
    channels = noisy.read().channels.copy()
    channels[:, : len(NAMES) - 5] = 0.0
    still = replace(noisy, source=MemorySource(channels, None))
    with pytest.raises(
        UserError, match=r"^zero, channels: 5 of \d+ strain and torque channels can be used .*dead: const"
    ):
        zero_reference([still], calibration())


def test_the_zero_of_a_coarse_converter_is_known_to_half_a_step():
    step = 0.02
    zero, wind = (
        replace(run, source=MemorySource(step * np.round(run.read().channels / step + level), None))
        for run, level in (
            (record("zero", np.zeros(6), noise=0.0, kind="zero"), 3.0),
            (record("wind", np.full(6, 40.0), noise=step, kind="wind", seed=2), 0.0),
        )
    )
    reference = zero_reference([zero], calibration(), wind)
    assert reference is not None
    np.testing.assert_allclose(reference.mean, zero.read().channels[0])
    np.testing.assert_allclose(reference.variance, step**2 / 12.0, rtol=1e-6)
    moving = zero.read().channels.copy()
    moving[:, 0] += 1e-3 * np.random.default_rng(1).standard_normal(zero.samples)
    partly = zero_reference([replace(zero, source=MemorySource(moving, None))], calibration(), wind)
    assert partly is not None
    assert partly.channel_names == tuple(NAMES)
    assert partly.variance[0] < 1e-3 * partly.variance[1] == pytest.approx(1e-3 * step**2 / 12.0, rel=1e-6)
    fine = record("wind", np.full(6, 40.0), kind="wind", seed=2)
    dead = replace(zero, source=MemorySource(np.zeros_like(zero.read().channels), None))
    for run, other in ((zero, fine), (dead, wind)):
        with pytest.raises(UserError, match="no strain or torque channel can be used"):
            zero_reference([run], calibration(), other)
