"""Noise of the channels in a record of a dozen revolutions of a fast rotor."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Acquisition
from balance_cli.signals.channel_noise import row_noise


@pytest.mark.parametrize("samples", [190, 246])
def test_records_that_hold_three_short_windows_tell_their_noise_in_a_longer_one(samples):
    """Each had been refused: a window of 64 samples has no bin above nine tenths of the Nyquist frequency."""
    rng = np.random.default_rng(samples)
    time = np.arange(samples) / 861.0
    rows = rng.standard_normal((40, samples)) + 300.0 * np.cos(2.0 * np.pi * 308.0 * time)
    assert np.median(row_noise(rows, 861.0, Acquisition(filter=None))) == pytest.approx(1.0, rel=0.3)
