"""Fits that end where two modes of different damping have one frequency."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.estimation.levenberg_marquardt import Minimum
from balance_cli.estimation.likelihood import Curvature
from balance_cli.estimation.mode_crossings import cross_modes, exchanged_modes, plate_frequencies
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from tests.support.rigs import CONFIGS

MODEL = balance_model(load_geometry(CONFIGS / "hexapod.yaml"))
NAMES = MODEL.parameters.names
RATIOS = [NAMES.index(f"damping_ratio.{i}") for i in range(1, 7)]
ITERATIONS = 20


def symmetric():
    """Parameters (p,) of a hexapod with its mass on the axis: x and y have the same two frequencies."""
    theta = MODEL.parameters.value.copy()
    for name in ("centre_of_gravity.x", "centre_of_gravity.y", "inertia.xy", "inertia.xz", "inertia.yz"):
        theta[NAMES.index(name)] = 0.0
    theta[NAMES.index("inertia.yy")] = theta[NAMES.index("inertia.xx")]
    theta[[i for i, name in enumerate(NAMES) if name.startswith("stiffness.")]] = 2e6
    theta[RATIOS] = 0.01 * np.arange(1, 7)
    return theta


def ended(theta, chi2, iterations=4, converged=False):
    p = int(MODEL.parameters.free.sum())
    curvature = Curvature(chi2, np.zeros(p), np.zeros((p, p)))
    return Minimum(theta, curvature, curvature, iterations, converged)


def test_the_frequencies_are_those_of_the_plate():
    theta = MODEL.parameters.value
    found = modes(MODEL.system(theta)).frequency
    assert plate_frequencies(MODEL, theta) / (2 * np.pi) == pytest.approx(found[:6], rel=1e-3)


def test_ratios_are_exchanged_where_two_modes_meet():
    assert exchanged_modes(MODEL, MODEL.parameters.value) == []
    theta = symmetric()
    first, second = (start[RATIOS] for start in exchanged_modes(MODEL, theta))
    assert first == pytest.approx([0.02, 0.01, 0.03, 0.04, 0.05, 0.06])
    assert sorted(second) == sorted(theta[RATIOS]) and np.count_nonzero(second != theta[RATIOS]) == 2


def test_a_fit_that_ends_at_a_crossing_goes_on_beyond_it():
    """The right one of two pairs is found, and then the other."""
    theta, right = symmetric(), [0.02, 0.01, 0.03, 0.04, 0.05, 0.06]
    second = [start[RATIOS] for start in exchanged_modes(MODEL, theta)][1]
    right = np.where(second != theta[RATIOS], second, right)

    def minimize(start):
        chi2 = 1.0 + np.count_nonzero(start[RATIOS] != right)
        return ended(start, chi2, converged=chi2 == 1.0)

    end = cross_modes(MODEL, minimize(theta), ITERATIONS, minimize)
    assert end.theta[RATIOS] == pytest.approx(right)
    assert end.converged and end.iterations == 12


@pytest.mark.parametrize("state", [{"converged": True}, {"iterations": ITERATIONS}])
def test_a_fit_that_was_not_stopped_stays(state):
    end = ended(symmetric(), 5.0, **state)
    assert cross_modes(MODEL, end, ITERATIONS, lambda start: pytest.fail("not needed")) is end


def test_a_start_that_is_no_better_or_not_physical_changes_nothing():
    end = ended(symmetric(), 5.0)

    def singular(start):
        raise np.linalg.LinAlgError

    assert cross_modes(MODEL, end, ITERATIONS, singular) is end
    assert cross_modes(MODEL, end, ITERATIONS, lambda start: replace(end, theta=start)) is end
