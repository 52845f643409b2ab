"""Modes that lie elsewhere than in the model make loads doubtful; sound runs are left alone."""

from __future__ import annotations

import numpy as np
import pytest

from balance_cli.reduction.moved_modes import moved_modes
from balance_cli.reduction.operational_modes import OperationalModes
from balance_cli.signals.distributions import chi2

PREDICTED = np.array([14.0, 40.0, 67.0])
SIGMA = np.array([0.1, 0.1, 0.2])


def modes(*departure: float) -> OperationalModes:
    return OperationalModes(PREDICTED, PREDICTED * (1.0 + np.array(departure)), SIGMA)


def test_a_mode_that_moved_is_named_with_its_sigma() -> None:
    moved = moved_modes(modes(0.001, -0.03, np.nan))
    assert moved is not None
    assert moved.predicted.tolist() == [40.0] and moved.departure == pytest.approx([-0.03])
    assert "that at 40 Hz by -3 +- 0.3 %: the mass, a stiffness or the support has changed" in moved.sentence


def test_modes_that_moved_together_are_found_where_no_single_one_shows_it() -> None:
    share = 4.2 * np.hypot(SIGMA / PREDICTED, 0.002)
    assert moved_modes(modes(*(0.5 * share))) is None
    moved = moved_modes(modes(*share))
    assert moved is not None and len(moved.predicted) == 3
    assert chi2.sf(4.2**2, 1) > 1e-6


@pytest.mark.parametrize("departure", [(0.0, 0.0, 0.0), (0.002, -0.004, 0.003), (np.nan, np.nan, np.nan)])
def test_modes_in_their_places_say_nothing(departure: tuple[float, float, float]) -> None:
    assert moved_modes(modes(*departure)) is None


def test_the_error_of_a_load_is_that_of_an_oscillator_with_another_mass() -> None:
    """A cell reads k x for f = (k - m w^2 + j w d) x: with the mass of the model the load is off by dm w^2 x."""
    mass, stiffness, frequency = 2.0, 2.0 * (2 * np.pi * 40.0) ** 2, np.array([0.0, 10.0, 30.0, 55.0])
    damping, change = 2.0 * 0.01 * np.sqrt(mass * stiffness), 0.04
    w = 2 * np.pi * frequency
    load = stiffness - mass * w**2 + 1j * w * damping
    expected = np.abs(change * mass * w**2 / load)
    moved = moved_modes(modes(0.0, (1.0 + change) ** -0.5 - 1.0, 0.0))
    assert moved is not None
    assert moved.error_share(frequency) == pytest.approx(expected, rel=0.04)
