"""What changes within a record leave in its harmonics is in their sigma: gains that drift, means that step."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.reduction.model_sources import model_source
from balance_cli.signals.rotor.channel_change import common_drift, harmonic_drift
from balance_cli.steps.reduce import reduce_run

WINDOWS, NOISE = 40, 0.03


def windows(rng, gain=0.0):
    """Loads (w, 8, 6) of size 1 with noise, and a gain (w,)."""
    phases = np.exp(2j * np.pi * rng.random((8, 6)))
    noise = rng.standard_normal((2, WINDOWS, 8, 6)) * NOISE
    return phases * (1.0 + np.broadcast_to(gain, WINDOWS))[:, None, None] + noise[0] + 1j * noise[1]


@pytest.mark.parametrize(
    ("gain", "half"),
    [(0.05 * np.linspace(0.0, 1.0, WINDOWS), 0.022), (0.02 * (np.arange(WINDOWS) >= 20), 0.01)],
)
def test_half_of_a_common_change_is_uncertain(gain, half):
    rng = np.random.default_rng(1)
    found = [common_drift(windows(rng, gain)) for _ in range(10)]
    np.testing.assert_allclose(found, half, rtol=0.25)


def test_steady_loads_have_no_error_of_a_change():
    rng = np.random.default_rng(2)
    sigma = np.full((8, 6), NOISE / np.sqrt(WINDOWS))
    for _ in range(200):
        values = windows(rng)
        assert not harmonic_drift(values, values.mean(axis=0), sigma).any()


def test_few_loads_tell_no_common_change():
    gain = 0.05 * np.linspace(0.0, 1.0, WINDOWS)
    assert common_drift(windows(np.random.default_rng(5), gain)[:, :1, :2]) == 0.0


def test_what_a_few_windows_change_is_uncertain():
    values = windows(np.random.default_rng(3))
    values[37:, 0, 2] += 2.0
    error = harmonic_drift(values, values.mean(axis=0), np.full((8, 6), NOISE / np.sqrt(WINDOWS)))
    assert error[0, 2] == pytest.approx(2.0 * 3 / WINDOWS, rel=0.1) and np.count_nonzero(error) == 1


@pytest.fixture(scope="module")
def reduced(campaign, calibration, identified):
    """A function that reduces a wind run with changed volts, by the share of the interval that has passed."""
    wind, source = campaign.runs_of_kind("wind")[0], model_source(identified)
    volts = np.asarray(wind.read().channels)
    sound = reduce_run(wind, campaign.geometry, calibration, source)
    time = np.arange(len(volts)) / wind.sample_rate
    share = np.clip((time - sound.interval[0]) / (sound.interval[1] - sound.interval[0]), 0.0, 1.0)[:, None]

    def reduce(change):
        run = replace(wind, source=MemorySource(change(volts, share), None))
        return reduce_run(run, campaign.geometry, calibration, source)

    return reduce


def deviations(changed, sound):
    """Of the harmonics from those of the sound record, in standard deviations."""
    with np.errstate(invalid="ignore"):
        error = np.abs(changed.amplitude - sound.amplitude) / np.hypot(changed.sigma_cosine, changed.sigma_sine)
    return error[1:]


def test_a_gain_of_all_channels_that_drifts_is_in_sigma(reduced):
    """A drift by 5 % made loads 29 sigma off without a flag."""
    sound = reduced(lambda volts, share: volts)
    assert deviations(reduced(lambda volts, share: volts * (1.0 + 0.05 * share)), sound).max() < 3.0
    assert deviations(reduced(lambda volts, share: volts * (1.0 + 0.03 * (share > 0.5))), sound).max() < 3.0


@pytest.mark.parametrize("place", [0.9, 0.97])
def test_what_a_step_of_the_mean_leaves_in_harmonics_is_in_sigma(reduced, campaign, calibration, place):
    """1/rev was up to 41 sigma off, and the mean alone had a flag."""
    trim, wind = calibration.trims["bare"], campaign.runs_of_kind("wind")[0]
    sound = reduced(lambda volts, share: volts)
    size = 10.0 * np.abs(sound.amplitude[1:, 2]).max()
    column = dict(zip(trim.channel_names, size * trim.C0[:, 2], strict=True))
    step = np.array([column.get(name, 0.0) for name in wind.channel_names])
    stepped = reduced(lambda volts, share: volts + (share > place) * step)
    assert deviations(stepped, sound)[:, 2].max() < 4.0


def test_a_load_that_is_displaced_now_and_then_is_in_sigma_of_its_mean(reduced, campaign, calibration):
    """Twelve times for a two hundredth of the record: the lines tell only how it scatters, and all are of one sign."""
    trim, wind = calibration.trims["bare"], campaign.runs_of_kind("wind")[0]
    sound = reduced(lambda volts, share: volts)
    size = np.abs(sound.amplitude[1:, 2]).max()
    column = dict(zip(trim.channel_names, size * trim.C0[:, 2], strict=True))
    step = np.array([column.get(name, 0.0) for name in wind.channel_names])
    moved = reduced(lambda volts, share: volts + ((share * 12.0 % 1.0 < 0.06) & (share > 0.0)) * step)
    error, lift = np.abs(moved.amplitude[0] - sound.amplitude[0]).real, sound.components.index("Fz")
    assert error[lift] == pytest.approx(0.06 * size, rel=0.25)
    assert error[lift] < 2.0 * moved.sigma_cosine[0, lift]
    assert sound.sigma_cosine[0, lift] < 0.2 * error[lift]
