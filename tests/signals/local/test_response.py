"""Responses from local models: loads that cannot be told apart are refused, and ends of sweeps are not used."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals.local.response import _load_precision, local_response

RATE, FINE, SECONDS, TOP = 1000.0, 16, 20.0, 350.0
MODES = ((40.0, 0.01, 5e3), (95.0, 0.008, 2e4))


def test_loads_in_proportion_are_refused_with_the_run():
    spectrum = SimpleNamespace(run=SimpleNamespace(file="r.h5"), components=("Fx", "Fy"))
    models = SimpleNamespace(spectrum=spectrum)
    np.testing.assert_allclose(_load_precision(models, 2.0 * np.eye(2)[None]), 0.5 * np.eye(2)[None])
    with pytest.raises(UserError, match=r"r\.h5, loads: the loads Fx, Fy are proportional to each other"):
        _load_precision(models, np.ones((1, 2, 2)))


def linear_sweep(direction):
    """A sweep from 2 Hz to TOP, or back, of a two-mode system that begins at rest; load and channel."""
    time = np.arange(int(SECONDS * RATE) * FINE) / (RATE * FINE)
    first, last = (2.0, TOP)[::direction]
    force = np.sin(2 * np.pi * (first * time + (last - first) * time**2 / (2 * SECONDS)))
    response = np.zeros(len(time))
    for frequency, damping, gain in MODES:
        omega = 2 * np.pi * frequency
        system = ([gain], [1.0, 2 * damping * omega, omega**2])
        numerator, denominator, _ = scipy.signal.cont2discrete(system, 1 / (RATE * FINE), method="foh")
        response += scipy.signal.lfilter(numerator.ravel(), denominator, force)
    sections = scipy.signal.butter(6, 400.0, fs=RATE * FINE, output="sos")
    rng = np.random.default_rng(3)
    loads, channel = np.zeros((int(SECONDS * RATE), 6)), scipy.signal.sosfilt(sections, response)[::FINE]
    loads[:, 2] = scipy.signal.sosfilt(sections, force)[::FINE] + 1e-3 * rng.standard_normal(len(loads))
    channel = channel + 1e-3 * channel.std() * rng.standard_normal(len(loads))
    source = MemorySource(channel[:, None], loads)
    run = Run(*("sweep", "rig", "sweep", ("c",), len(loads), source, True, RATE))
    return replace(run, excited=("Fz",), excitation="sine-sweep", level=(0.7,))


@pytest.mark.parametrize("direction", [1, -1])
def test_lines_that_a_sweep_passes_at_an_end_of_its_record_are_not_used(direction):
    """Their response passes for a transient: it had been wrong by all of it, at up to a dozen sigma."""
    found = local_response(linear_sweep(direction), ("c",), "lrm")
    s = 2j * np.pi * found.frequency
    exact = sum(g / (s**2 + 2 * z * 2 * np.pi * f * s + (2 * np.pi * f) ** 2) for f, z, g in MODES)
    error = np.abs(found.response[:, 0, 0] - exact)
    sigma = np.sqrt(np.abs(found.channel_covariance[:, 0, 0] * found.load_covariance[:, 0, 0]))
    low = found.frequency < 30.0
    assert found.frequency[0] < 15.0 and np.sqrt(np.mean((error / sigma)[low] ** 2)) < 1.3
    assert np.max(error[low] / np.abs(exact[low])) < 0.05
