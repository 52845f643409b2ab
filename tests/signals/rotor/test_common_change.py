"""A change that all harmonics have in common is found long before any one of them changes by much."""

import numpy as np
import pytest

from balance_cli.signals.rotor.common_change import common_change

WINDOWS, ORDERS, LOADS = 48, 8, 6


def amplitudes(seed: int, noise: float = 0.01) -> np.ndarray:
    """Steady harmonics of six loads in 48 windows; the last three loads are not there."""
    rng = np.random.default_rng(seed)
    steady = np.exp(2j * np.pi * rng.random((ORDERS, LOADS))) * 0.8 ** np.arange(ORDERS)[:, None]
    steady[:, 3:] = 0.0
    scatter = rng.normal(size=(2, WINDOWS, ORDERS, LOADS))
    return np.asarray(steady + noise * (scatter[0] + 1j * scatter[1]))


def change_from(values: np.ndarray, window: int, factor: float, degrees: float) -> np.ndarray:
    changed = values.copy()
    turn = np.exp(1j * np.radians(degrees) * np.arange(1, ORDERS + 1))[:, None]
    changed[window:] *= factor * turn
    return changed


@pytest.mark.parametrize(
    ("factor", "degrees"), [(1.1, 0.0), (0.9, 0.0), (2.0, 0.0), (1.0, 3.0), (1.0, -15.0), (1.0, 170.0), (1.07, 2.0)]
)
def test_a_gain_and_a_turn_are_found(factor: float, degrees: float) -> None:
    change = common_change(change_from(amplitudes(1), 20, factor, degrees))
    assert change is not None
    assert change.factor == pytest.approx(factor, abs=0.01)
    assert np.degrees(change.turn) == pytest.approx(degrees, abs=0.2)
    assert abs(change.window - 20) <= 1


@pytest.mark.parametrize("factor", [0.9, 1.1, -1.0])
def test_a_gain_among_gusts_is_found_from_all_amplitudes(factor: float) -> None:
    """Gusts of a twentieth of the largest harmonic: none of the amplitudes is known to a hundredth."""
    for seed in range(20):
        values = amplitudes(seed, noise=0.05)
        values[:, :, 3:] = 0.0
        change = common_change(change_from(values, 24, factor, 0.0))
        assert change is not None and change.factor == pytest.approx(factor, abs=0.04)
        assert common_change(values) is None


def test_noise_has_no_factor() -> None:
    """Harmonics that are not there have means of noise before and after, with a factor of about zero."""
    for seed in range(200):
        values = amplitudes(seed)
        rng = np.random.default_rng(seed)
        noise = rng.normal(size=(2, *values.shape))
        assert common_change(noise[0] + 1j * noise[1]) is None


def test_slow_gusts_are_no_common_gain() -> None:
    """Their windows are not independent, and means before and after differ by more than the scatter says."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        values = amplitudes(seed, noise=0.01)
        drift = np.cumsum(rng.normal(size=(2, WINDOWS, ORDERS, LOADS)), axis=1) / np.sqrt(WINDOWS)
        assert common_change(values + 0.1 * (drift[0] + 1j * drift[1])) is None


def test_a_clock_that_runs_away_is_found() -> None:
    values = amplitudes(2)
    drift = np.radians(40.0) * np.arange(WINDOWS) / WINDOWS
    values *= np.exp(1j * drift[:, None, None] * np.arange(1, ORDERS + 1)[:, None])
    assert common_change(values) is not None


@pytest.mark.parametrize("noise", [0.001, 0.05, 0.3])
def test_steady_loads_gusts_and_changes_of_single_loads_are_none(noise: float) -> None:
    """1000 steady records have none either; 20 are tried here."""
    for seed in range(20):
        values = amplitudes(seed, noise)
        assert common_change(values) is None
        rng = np.random.default_rng(seed)
        values[20:] += 0.2 * rng.normal(size=(ORDERS, LOADS))  # another operating point: each load by itself
        assert common_change(values) is None
        values[30:, :, 0] *= 1.3  # one load alone
        assert common_change(values) is None


def test_few_amplitudes_tell_nothing() -> None:
    values = change_from(amplitudes(3), 20, 1.2, 0.0)
    values[:, 2:] = 0.0
    values[:, :, 2:] = 0.0
    assert common_change(values) is None
