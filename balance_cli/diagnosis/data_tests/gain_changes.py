"""A gain that changed between two runs: one amplifier, a box of channels, or the force cell of the exciter.

The change of the responses is fitted by one factor for each channel, dH = g H. Where that describes nearly all of it,
the channels are divided into two groups of like factors; where all have the same, it is the load that is read in
another way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.data_tests.channel_drifts import ChannelFit
from balance_cli.diagnosis.significance import chi2_p_value, format_with_sigma

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def describe_gain_change(
    channels: Sequence[str],
    change: ComplexArray,
    response: ComplexArray,
    variance: Array,
    settings: DataTestSettings,
) -> str:
    """Return which channels read by which factor more in the second run; empty where factors do not describe it.

    `change` and `response`, the mean of both runs, (k, c), and `variance` (k, c) of the change.
    """
    weight = np.abs(response) ** 2 / variance
    size = np.maximum(weight.sum(axis=0), np.finfo(float).tiny)
    gain = np.sum((response.conj() * change).real / variance, axis=0) / size
    left = np.sum(np.abs(change - gain * response) ** 2 / variance)
    groups, share = settings.record_changes, 1.0 - settings.run_pairs.gain_share
    if len(channels) < groups.min_channels or left > share * np.sum(np.abs(change) ** 2 / variance):
        return ""
    birge = max(2.0 * float(left) / (2 * change.size - len(channels)), 1.0)
    fit = ChannelFit.of(gain[None], 2.0 * size[None] / birge)
    if chi2_p_value(fit.chi2, (len(channels) - 1.0,), (np.inf,)) > settings.significance_level:
        mean, sigma = float(np.average(gain, weights=size)), float(np.sqrt(0.5 * birge / size.sum()))
        return f"all channels read {format_with_sigma(_factor(mean), sigma)} times as much, as if the force cell did"
    group = fit.deviating_group(groups.clear_sigma)
    value, sigma = fit.change_of(group)
    named = ", ".join(channels[i] for i in group)
    return f"{named} read {format_with_sigma(_factor(value), sigma)} times as much against the other channels"


def _factor(change: float) -> float:
    """The factor from the first to the second run, of which the change is relative to the mean of both."""
    return (2.0 + change) / (2.0 - change)
