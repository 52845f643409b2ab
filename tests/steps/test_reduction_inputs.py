"""Inputs of a reduction: a wind-off record that does not move is no zero."""

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
