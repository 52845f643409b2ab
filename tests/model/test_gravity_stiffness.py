"""The weight above the cells against the exact potential energy of a plate that turns by finite angles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.mass_properties import metric_side
from balance_cli.model.balance import balance_model
from balance_cli.model.effects import EFFECTS
from tests.support.rigs import rotor_balance

WEIGHT = 2e4


def stiffness(rig, effects=()):
    return balance_model(rig.model_copy(update={"effects": effects})).system().pencil.stiffness.value


class Plate:
    """Springs of fixed direction on a rigid plate, preloaded so that they carry the weight."""

    def __init__(self, rig):
        self.arm = np.array([cell.position for cell in rig.cells]) - metric_side(rig).centre_of_gravity
        self.axis = np.array([cell.direction for cell in rig.cells])
        self.stiffness = np.array([cell.effective_stiffness for cell in rig.cells])
        rows = np.hstack([self.axis, np.cross(self.arm, self.axis)])
        self.preload = np.linalg.lstsq(rows.T, [0, 0, WEIGHT, 0, 0, 0])[0]
        assert np.allclose(rows.T @ self.preload, [0, 0, WEIGHT, 0, 0, 0], atol=1e-6 * WEIGHT)

    @property
    def height(self):
        """Height of the center of gravity above the points of support, by their shares of the weight."""
        return -self.preload * self.axis[:, 2] @ self.arm[:, 2] / WEIGHT

    def energy(self, q):
        x, turn = q[:3], Rotation.from_rotvec([q[5], q[4], q[3]]).as_matrix()
        elongation = np.sum(self.axis * (x + self.arm @ turn.T - self.arm), axis=1)
        return WEIGHT * x[2] - self.preload @ elongation + 0.5 * self.stiffness @ elongation**2

    def hessian(self, step=2e-4):
        points = step * np.eye(6)
        f = self.energy
        return np.array([[f(a + b) - f(a - b) - f(b - a) + f(-a - b) for b in points] for a in points]) / (4 * step**2)


@pytest.mark.parametrize("upright", [True, False])
def test_gravity_stiffness_is_that_of_the_potential_energy(upright):
    rig = rotor_balance()
    if not upright:
        lowered = [cell.model_copy(update={"position": (*cell.position[:2], 0.9)}) for cell in rig.cells]
        rig = rig.model_copy(update={"cells": tuple(lowered)})
    plate = Plate(rig)
    assert plate.height > 0.1 if upright else plate.height < -0.1
    effect = DeclaredEffect(name="gravity-stiffness", parameters={"stiffness": WEIGHT * plate.height})
    n = len(rig.freedom)
    K = stiffness(rig, (effect,))[:n, :n]
    without = stiffness(rig)[:n, :n]
    change = np.abs(K - without).max()
    np.testing.assert_allclose(plate.hessian(), K, atol=1e-3 * change)
    assert np.abs(plate.hessian() - without).max() > 0.9 * change


def test_a_rig_does_not_fall_over_at_the_bounds():
    rig = rotor_balance()
    (effect,) = (effect for effect in EFFECTS if effect.name == "gravity-stiffness")
    (parameter,) = effect.parameters(rig, ())
    for bound in (parameter.lower, parameter.upper):
        declared = DeclaredEffect(name=effect.name, parameters={parameter.name: bound})
        assert np.linalg.eigvalsh(stiffness(rig, (declared,))).min() > 0
