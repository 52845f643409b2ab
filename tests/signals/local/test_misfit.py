"""What local models miss of a response, and the lines at which they have one."""

import numpy as np
import pytest

from balance_cli.signals.local.fit import ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.misfit import missed_response_power
from balance_cli.signals.local.scaled_spectrum import is_within_power
from balance_cli.signals.local.window import response_rows, split_windows

LINES, CHANNELS = 81, 3
MIDDLE = slice(27, 54)


def _fit(response, noise, rng):
    """The fit with one pole of windows of a response (M, c) to random loads, with noise on the channels."""
    U = (rng.normal(size=(LINES, 1)) + 1j * rng.normal(size=(LINES, 1))) / np.sqrt(2)
    v = (rng.normal(size=response.shape) + 1j * rng.normal(size=response.shape)) * noise / np.sqrt(2)
    r = np.linspace(-1.0, 1.0, LINES)
    windows = WindowedData((response * U + v)[None], U[None], np.ones((1, LINES)), r[None])
    (fit,) = split_windows(fit_windows(windows, ModelOrders(3, 2, 1)), windows)
    return fit, (response_rows(fit, r) @ fit.coefficients)[:, 0]


def _modes(*poles):
    r = np.linspace(-1.0, 1.0, LINES)
    gains = np.array([1.0, -0.7, 0.4])
    return sum(np.outer(1.0 / (r - pole), gains[:CHANNELS] * (1 + 0.3 * i)) for i, pole in enumerate(poles))


def test_a_mode_too_many_for_the_model_is_in_its_error():
    rng, sigma = np.random.default_rng(2), 1e-3
    true = _modes(-0.5 + 0.15j, 0.1 + 0.12j, 0.7 + 0.1j)
    ratios = []
    for _ in range(20):
        fit, response = _fit(true, sigma, rng)
        noise = np.broadcast_to(sigma**2 * np.eye(CHANNELS, dtype=complex), (LINES, CHANNELS, CHANNELS))
        missed = missed_response_power(fit, MIDDLE, noise)[:, 0]
        error = np.mean(np.abs(response - true)[MIDDLE] ** 2, axis=0)
        assert np.all(error > 10 * sigma**2)
        ratios.append(missed / error)
    assert np.median(ratios) == pytest.approx(1.0, abs=0.4)


def test_nothing_is_missed_of_what_the_model_describes():
    rng, sigma = np.random.default_rng(3), 1e-3
    noise = np.broadcast_to(sigma**2 * np.eye(CHANNELS, dtype=complex), (LINES, CHANNELS, CHANNELS))
    missed = [missed_response_power(_fit(_modes(0.2 + 0.15j), sigma, rng)[0], MIDDLE, noise) for _ in range(100)]
    assert np.mean(np.array(missed) > 0) < 0.01


@pytest.mark.parametrize("kind", ["random", "sweep"])
def test_lines_beyond_the_band_of_a_record_that_leaks_have_no_response(kind):
    """From 4 to 40 Hz, at lines of 0.05 Hz; the ends of the record differ, so that all lines have some power."""
    rate, duration = 200.0, 20.0
    time = np.arange(int(rate * duration)) / rate
    if kind == "random":
        rng = np.random.default_rng(4)
        tones = rng.uniform(4.0, 40.0, 700)
        load = np.cos(2 * np.pi * np.outer(time, tones) + rng.uniform(0, 6.28, 700)).sum(axis=1)
    else:
        load = np.cos(2 * np.pi * (4.0 * time + 36.0 * time**2 / (2 * duration)) + 0.5)
    frequency = np.arange(1, len(time) // 2) / duration
    used = frequency[is_within_power(load[:, None])]
    slack = 0.5 if kind == "random" else 1.5  # a sweep whose rate is finite has power beside its last frequency
    assert 4.0 - slack < used.min() < 4.3
    assert 39.7 < used.max() < 40.0 + slack
    assert np.all(np.diff(used) < 0.06)
