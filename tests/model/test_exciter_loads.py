"""Exciters that resist the motion of the hub: as a reaction of their own, and as a part of the moving rig."""

import numpy as np

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.model.balance import balance_model
from balance_cli.model.exciter_loads import attach_exciters, true_load_matrices
from balance_cli.model.system_response import response, solve
from tests.support.rigs import rotor_balance

FREQUENCY = np.linspace(3.0, 120.0, 30)
EFFECTS = {
    ("exciter-mass", ("Fx",)): {"mass": 1.5},
    ("exciter-mass", ("Fx", "Fz")): {"mass": 0.7},
    ("exciter-stiffness", ("Fx", "Fy")): {"stiffness": 2e4},
    ("exciter-stiffness", ("Mz",)): {"stiffness": 3e3},
    ("exciter-misalignment", ("Fx", "Fz")): {"fraction": 0.03},
}


def system_with_exciters():
    effects = tuple(DeclaredEffect(name=name, where=where, parameters=p) for (name, where), p in EFFECTS.items())
    return balance_model(rotor_balance().model_copy(update={"effects": effects})).system()


def test_a_rig_with_its_exciters_responds_as_one_with_their_reaction():
    """(A + F C D F')^-1 F C = A^-1 F C (1 + D F' A^-1 F C)^-1."""
    system, lines = system_with_exciters(), np.arange(len(FREQUENCY))
    for attached in (np.arange(6) == 0, np.array([True, False, False, False, False, True]), np.zeros(6, bool)):
        at_lines = np.broadcast_to(attached, (len(lines), 6))
        solution = solve(system, FREQUENCY)
        reaction = response(system, solution) @ true_load_matrices(system, solution, lines, at_lines)
        moving = attach_exciters(system, attached)
        whole = response(moving, solve(moving, FREQUENCY)) @ system.equations.exciter_cross_axis.value
        np.testing.assert_allclose(whole, reaction, rtol=1e-9, atol=1e-12 * np.abs(reaction).max())


def test_exciters_without_mass_and_stiffness_leave_the_system_as_it_is():
    system = balance_model(rotor_balance()).system()
    assert attach_exciters(system, np.ones(6, bool)) is system
