"""Noise of wind runs against runs with known loads: factors and filters of all channels show, loads do not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.diagnosis.consistency.findings import WARNING
from balance_cli.diagnosis.consistency.noise_levels import noise_findings
from tests.support.run_content import a_run

SAMPLES, CHANNELS = 6000, ("x.strain", "y1.strain", "torque")
LEVELS = np.array([1.0, 0.3, 5.0])


def record(kind, name, seed, change=lambda x: x):
    rng = np.random.default_rng(seed)
    channels = change(LEVELS * rng.standard_normal((SAMPLES, 3)))
    loads = None if kind == "wind" else rng.standard_normal((SAMPLES, 6))
    return a_run(kind, name=name, samples=SAMPLES, source=MemorySource(channels, loads))


def findings(wind, change=lambda x: x):
    known = [record("sweep", f"sweep-{k}", k, change) for k in range(3)]
    return noise_findings([*known, record("wind", "wind-1", 9, wind)], CHANNELS)


def low_pass(x):
    return signal.sosfilt(signal.butter(4, 0.3, output="sos"), x, axis=0)


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        (lambda x: x / 1000, 0.001),
        (lambda x: 3.0 * x, 3.0),
        (lambda x: 2.0 * x, 2.0),
        (lambda x: 0.5 * x, 0.5),
        (low_pass, 0.0),
    ],
)
def test_a_factor_or_filter_of_all_channels_is_named(change, factor):
    (finding,) = findings(change)
    assert finding.severity == WARNING and finding.runs == ("wind-1",)
    assert finding.factor == pytest.approx(factor, rel=0.1, abs=0.05)


def driven(x):
    """Loads up to half the rate, that drive all channels."""
    return x + 20.0 * x[:, [0]] * LEVELS


@pytest.mark.parametrize(
    "change",
    [lambda x: x, lambda x: x * [1.0, 0.01, 1.0], lambda x: 0.7 * x, driven],
    ids=["same", "one", "less", "loads"],
)
def test_sound_runs_one_channel_and_loads_in_the_band_have_no_finding(change):
    assert findings(change) == []


def test_known_runs_that_are_driven_there_or_have_no_common_level_tell_nothing():
    assert findings(lambda x: x / 1000, driven) == []
    runs = [record("sweep", f"sweep-{k}", k, lambda x, k=k: x * 3.0**k) for k in range(3)]
    assert noise_findings([*runs, record("wind", "wind-1", 9, lambda x: x / 1000)], CHANNELS) == []


def test_without_a_wind_run_nothing_is_read():
    sweep = record("sweep", "sweep", 1)
    assert noise_findings([replace(sweep, source=None)], CHANNELS) == []


def test_runs_with_one_cause_are_one_finding():
    known = [record("sweep", f"sweep-{k}", k) for k in range(3)]
    wind = [record("wind", f"wind-{k}", 9 + k, lambda x: x / 1000) for k in range(3)]
    both = noise_findings([*known, *wind, record("wind", "other", 20, lambda x: 3.0 * x)], CHANNELS)
    assert [finding.runs for finding in both] == [("wind-0", "wind-1", "wind-2"), ("other",)]


@pytest.mark.parametrize("speed", [25.0, 25.3, 61.0])
def test_harmonics_of_the_rotor_within_the_band_are_no_noise(speed):
    """Harmonics up to 0.9 of half the sample rate were 5.86 times the noise of one channel, and hid that of several."""
    sweeps = [record("sweep", f"sweep-{k}", k) for k in range(3)]
    rate = sweeps[0].sample_rate
    time = np.arange(SAMPLES) / rate
    orders = np.arange(1, int(0.45 * rate / speed))
    phases = np.random.default_rng(4).uniform(0.0, 6.28, (len(orders), 3))
    tones = sum(np.cos(2 * np.pi * n * speed * time[:, None] + p) for n, p in zip(orders, phases, strict=True))
    wind = record("wind", "wind-1", 9, lambda x: x + 3.0 * LEVELS * tones)
    wind = replace(wind, pulse_times=np.arange(0.003, time[-1], 1.0 / speed))
    assert noise_findings([*sweeps, wind], CHANNELS) == noise_findings([*sweeps, wind], CHANNELS[:1]) == []
    loud = record("wind", "wind-1", 9, lambda x: 3.0 * (x + LEVELS * tones))
    (finding,) = noise_findings([*sweeps, replace(loud, pulse_times=wind.pulse_times)], CHANNELS)
    assert finding.factor == pytest.approx(3.0, rel=0.1)
