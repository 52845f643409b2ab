"""What fades like a start transient is no step of a mean load; what stays is."""

import numpy as np

from balance_cli.reduction.steadiness import _beyond_transient

DECAY = np.exp(-0.25)
"""For each window: a time constant of four windows."""


def test_a_fading_oscillation_is_taken_away_and_a_step_stays():
    windows = np.arange(40)
    fading = (0.1 * np.exp(-0.25 * windows) * np.cos(0.3 * windows)).astype(complex)[:, None]
    left = _beyond_transient(fading, 14, DECAY) - fading[14:].mean()
    np.testing.assert_array_less(np.abs(left[:14]), 1e-15)
    step = np.where(windows < 14, 1.0, 0.0).astype(complex)[:, None]
    kept = _beyond_transient(step, 14, DECAY)
    np.testing.assert_array_equal(kept[14:], step[14:])
    assert kept[13, 0].real > 0.85 and kept[2, 0].real < 1e-15


def test_without_windows_before_or_a_mode_nothing_changes():
    means = np.linspace(0.0, 1.0, 9).astype(complex)[:, None]
    for start, decay in ((0, 0.5), (9, 0.5), (4, 0.0)):
        assert _beyond_transient(means, start, decay) is means
