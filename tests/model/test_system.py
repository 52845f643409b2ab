"""Frequency responses against closed forms; their derivatives against numerical ones; modes; damping."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.io.errors import UserError
from balance_cli.model import pole_response
from balance_cli.model.balance import balance_model
from balance_cli.model.damping import modal_damping
from balance_cli.model.mechanics.dual_numbers import constant, variables
from balance_cli.model.modes import eigenvalues, modes, overdamped_decay_rates
from balance_cli.model.placed_effects import place_effect
from balance_cli.model.plate import plate_matrices
from balance_cli.model.pole_response import forces_from_poles, solved_forces
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system_response import load_response, response, solve
from balance_cli.model.transient_modes import transient_modes
from tests.support.rigs import angular_frequency, one_degree_of_freedom, rotor_balance, two_degrees_of_freedom
from tests.support.scaled import Scale

FREQUENCY = np.concatenate([[0.0], np.linspace(2.0, 150.0, 60)])


def test_response_of_one_degree_of_freedom():
    rig = one_degree_of_freedom(
        channels=[{"name": "z.piezo", "cell": "z", "sensitivity": 0.01, "time_constant": 3.0, "lowpass": 90.0}]
    )
    system = balance_model(rig).system()
    T = response(system, solve(system, FREQUENCY))[:, 0, 2]
    w, k, m = angular_frequency(FREQUENCY), 4e5, 10.0
    plate = k / (k - w**2 * m + 1j * w * 2 * 0.02 * np.sqrt(k * m))
    channel = 0.01 * (1j * w * 3.0) / (1 + 1j * w * 3.0) / (1 + 1j * FREQUENCY / 90.0)
    np.testing.assert_allclose(T, plate * channel, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    "effects",
    [(), (DeclaredEffect(name="structural-damping", where=("all",), parameters={"loss_factor": 0.03}),)],
)
def test_response_without_the_inverse_is_the_same(effects):
    system = balance_model(rotor_balance().model_copy(update={"effects": effects})).system()
    expected = response(system, solve(system, FREQUENCY, 17.5))
    np.testing.assert_allclose(
        load_response(system, FREQUENCY, 17.5), expected, rtol=1e-9, atol=1e-12 * abs(expected).max()
    )


def test_response_from_poles_is_that_of_a_solution_at_each_frequency():
    system = balance_model(rotor_balance()).system()
    frequency = np.linspace(0.5, 400.0, 2000)
    expected = solved_forces(system, frequency, 17.5)
    forces = forces_from_poles(system, frequency, 17.5)
    assert forces is not None
    error, size = np.abs(forces - expected), np.abs(expected)
    assert np.all(error <= 1e-12 * size.max(axis=(0, 1)))
    coupled = size > 1e-6 * size.max(axis=(0, 1))
    np.testing.assert_allclose(forces[coupled], expected[coupled], rtol=1e-9)
    both = load_response(system, frequency, 17.5), response(system, solve(system, frequency, 17.5))
    np.testing.assert_allclose(*both, rtol=1e-9, atol=1e-12 * np.abs(both[1]).max())


def test_what_is_no_sum_over_poles_is_solved():
    system = balance_model(rotor_balance()).system()
    frequency = np.linspace(1.0, 150.0, 200)
    assert forces_from_poles(system, np.concatenate([[0.0], frequency]), 0.0) is None
    assert forces_from_poles(system, frequency[:20], 0.0) is None
    massless = np.where(np.arange(len(system.pencil.mass.value)) == 0, 0.0, system.pencil.mass.value)
    without_mass = replace(system, pencil=replace(system.pencil, mass=constant(massless, system.parameters)))
    assert forces_from_poles(without_mass, frequency, 0.0) is None
    assert np.isfinite(load_response(without_mass, frequency)).all()
    effect = DeclaredEffect(name="structural-damping", where=("all",), parameters={"loss_factor": 0.03})
    lossy = balance_model(rotor_balance().model_copy(update={"effects": (effect,)})).system()
    assert forces_from_poles(lossy, frequency, 0.0) is None
    np.testing.assert_array_equal(
        load_response(lossy, frequency),
        np.concatenate([load_response(lossy, part) for part in np.split(frequency, 10)]),
    )


def test_sums_that_rounding_spoils_are_solved(monkeypatch):
    system, frequency = balance_model(rotor_balance()).system(), np.linspace(1.0, 150.0, 200)
    poles, residues = pole_response._poles_and_residues(system, 0.0)
    monkeypatch.setattr(pole_response, "_poles_and_residues", lambda *_: (poles, residues * (1 + 1e-9)))
    assert forces_from_poles(system, frequency, 0.0) is None


def test_torque_acts_on_the_shaft_and_not_on_the_plate():
    system = balance_model(rotor_balance()).system()
    T = response(system, solve(system, FREQUENCY))
    w = angular_frequency(FREQUENCY)
    d = 2 * 0.01 * np.sqrt(9e4 * 0.65)
    np.testing.assert_allclose(T[:, -1, 5], 0.02 * 9e4 / (9e4 - 0.65 * w**2 + 1j * w * d), rtol=1e-12)
    assert not T[:, :-1, 5].any()
    assert not T[:, -1, :5].any()


def test_static_response_is_the_static_calibration_of_the_plate():
    rig = rotor_balance()
    system, plate = balance_model(rig).system(), plate_matrices(rig)
    forces = plate.C[:, None] * plate.B @ np.linalg.solve(plate.K, plate.F)
    T = response(system, solve(system, np.zeros(1)))[0]
    np.testing.assert_allclose(T[:7], 0.002 * forces, atol=1e-15)
    np.testing.assert_array_equal(T[7:14], 0.0)


@pytest.mark.parametrize("rig", [rotor_balance(), two_degrees_of_freedom()], ids=["rotor balance", "heave and pitch"])
def test_jacobian_against_numerical_derivatives(rig):
    model = balance_model(rig).free_all_parameters()
    theta, scale = model.parameters.value, model.parameters.scale
    rng = np.random.default_rng(1)
    loads = rng.normal(size=(len(FREQUENCY), 6)) + 1j * rng.normal(size=(len(FREQUENCY), 6))
    system = model.system(theta)
    jacobian = output_jacobian(system, solve(system, FREQUENCY), np.arange(len(FREQUENCY)), loads)

    def outputs(at):
        shifted = model.system(at)
        return np.einsum("kcj,kj->kc", response(shifted, solve(shifted, FREQUENCY)), loads)

    for i in range(len(theta)):
        step = 1e-5 * scale[i] * np.eye(len(theta))[i]
        numerical = (outputs(theta + step) - outputs(theta - step)) / (2e-5 * scale[i])
        size = max(np.abs(numerical).max(), 1e-9 * np.abs(outputs(theta)).max() / scale[i])
        np.testing.assert_allclose(jacobian[:, :, i], numerical, atol=2e-5 * size, err_msg=model.parameters.names[i])


def test_modes_of_heave_and_pitch():
    computed = modes(balance_model(two_degrees_of_freedom()).system())
    expected = np.sqrt([2e6 / 20.0, 2e6 * 0.09 / 0.8]) / (2 * np.pi)
    np.testing.assert_allclose(computed.frequency, expected, rtol=1e-12)
    np.testing.assert_allclose(computed.damping_ratio, 0.02, rtol=1e-10)


def test_derivatives_of_modes_against_numerical_derivatives():
    model = balance_model(rotor_balance()).free_all_parameters()
    theta, scale = model.parameters.value, model.parameters.scale
    computed = modes(model.system())
    for i in range(26):
        step = 1e-4 * scale[i] * np.eye(len(theta))[i]
        above, below = modes(model.system(theta + step)), modes(model.system(theta - step))
        frequency = (above.frequency - below.frequency) / 2e-4
        damping = (above.damping_ratio - below.damping_ratio) / 2e-4
        np.testing.assert_allclose(computed.frequency_derivative[:, i] * scale[i], frequency, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(computed.damping_derivative[:, i] * scale[i], damping, rtol=1e-5, atol=1e-8)


def test_stiffness_and_mass_scaled_together_do_not_change_any_response():
    model = balance_model(rotor_balance())
    theta = model.parameters.value.copy()
    scaled = theta.copy()
    for i, name in enumerate(model.parameters.names):
        if name.startswith(("stiffness", "mass", "inertia", "torque_meter.stiffness", "torque_meter.inertia")):
            scaled[i] *= 1.07
    original, changed = (response(s, solve(s, FREQUENCY)) for s in (model.system(theta), model.system(scaled)))
    np.testing.assert_allclose(original, changed, rtol=1e-9, atol=1e-15)


def test_modal_damping_gives_each_mode_its_ratio():
    plate = plate_matrices(rotor_balance())
    zeta = np.array([0.004, 0.01, 0.02, 0.005, 0.03, 0.015])
    D = modal_damping(constant(plate.M, 1), constant(plate.K, 1), constant(zeta, 1)).value
    values, Phi = eigh(plate.K, plate.M)
    np.testing.assert_allclose(Phi.T @ D @ Phi, np.diag(2 * zeta * np.sqrt(values)), atol=1e-9)


def test_parameters_without_finite_motion_raise():
    """A step of a fit may lead to such parameters, and must be rejected."""
    M, D = np.eye(2), np.zeros((2, 2))
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        eigenvalues(M, D, np.diag([1.0, np.inf]).astype(complex))
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        eigenvalues(np.diag([1.0, np.nan]), D, np.eye(2, dtype=complex))
    with pytest.raises(np.linalg.LinAlgError, match="no inertia"):
        eigenvalues(np.diag([1.0, -2.0]), D, np.eye(2, dtype=complex))


def test_equal_eigenvalues_do_not_break_the_derivative_of_the_damping():
    """Four equal springs: with equal ratios D is a smooth function even where eigenvectors are not unique."""

    def damping(x):
        theta = variables(x)
        M = constant(np.eye(2), 2) + theta[0] * np.array([[1.0, 0.5], [0.5, 2.0]])
        K = constant(4.0 * np.eye(2), 2) + theta[1] * np.array([[1.0, 0.3], [0.3, -1.0]])
        return modal_damping(M, K, constant([0.1, 0.1], 2))

    at, step = damping(np.zeros(2)), 1e-6
    for i, e in enumerate(np.eye(2)):
        numerical = (damping(step * e).value - damping(-step * e).value) / (2 * step)
        np.testing.assert_allclose(at.derivative[i], numerical, atol=1e-6)


# ---- structural damping ----------------------------------------------------------------------------------------------

LOSS = 0.01
REFERENCE = np.sqrt(4e5 / 10.0) / (2 * np.pi)
"""The frequency [Hz] in the middle of the modes of a rig that has one."""


def lossy(causality):
    """One degree of freedom on a cell with structural damping."""
    values = {"loss_factor": LOSS, "causality": causality}
    effect = DeclaredEffect(name="structural-damping", where=("z",), parameters=values)
    return balance_model(one_degree_of_freedom().model_copy(update={"effects": (effect,)}))


@pytest.mark.parametrize("causality", [0.0, 1.0])
def test_response_with_structural_damping(causality):
    system = lossy(causality).system()
    T = response(system, solve(system, FREQUENCY))[:, 0, 2]
    w, k, m = angular_frequency(FREQUENCY[1:]), 4e5, 10.0
    rising = causality * 2 / np.pi * LOSS * np.log(FREQUENCY[1:] / REFERENCE)
    spring = k * (1 + 1j * LOSS + rising)
    gain = T[0] / 1.0
    expected = gain * spring / (spring - w**2 * m + 1j * w * 2 * 0.02 * np.sqrt(k * m))
    np.testing.assert_allclose(T[1:], expected, rtol=1e-12)


def test_structural_damping_of_the_shaft_is_that_of_the_torque_alone():
    rig = rotor_balance()
    effect = DeclaredEffect(name="structural-damping", where=("torque",), parameters={"loss_factor": LOSS})
    system = balance_model(rig.model_copy(update={"effects": (effect,)})).system()
    row = np.array(system.equations.springs) == "torque"
    np.testing.assert_allclose(system.readings_loss.value, LOSS * row[:, None] * system.readings.value, rtol=1e-12)
    with pytest.raises(UserError, match="no place `torque`"):
        place_effect("structural-damping", ("torque",), one_degree_of_freedom())


@pytest.mark.parametrize("time", [10.0, 0.01])
def test_structural_damping_does_not_depend_on_the_unit_of_time(time):
    """The spring has its declared stiffness in the middle of the modes, at another frequency on a slower rig."""
    values = {"loss_factor": 0.03, "causality": 1.0}
    effect = DeclaredEffect(name="structural-damping", where=("all",), parameters=values)
    plain = rotor_balance()
    rigs = [rig.model_copy(update={"effects": (effect,)}) for rig in (plain, Scale(time, 1.0, 1.0).geometry(plain))]
    first, second = (balance_model(rig).system() for rig in rigs)
    frequency = np.array([0.0, 5.0, 31.0, 120.0])
    one, other = response(first, solve(first, frequency)), response(second, solve(second, frequency / time))
    np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9 * np.abs(one).max())


def test_modes_and_transients_with_structural_damping_to_first_order():
    model = lossy(1.0)
    computed, free = modes(model.system()), transient_modes(model.system(), 0.0, 400.0)
    k, m, d = 4e5, 10.0, 2 * 0.02 * np.sqrt(4e6)

    def equation(s):
        return m * s**2 + d * s + k * (1 + 2 / np.pi * LOSS * np.log(s / angular_frequency(REFERENCE)))

    s = complex(-d / (2 * m), np.sqrt(k / m))
    for _ in range(20):
        s -= equation(s) / (2 * m * s + d + k * 2 / np.pi * LOSS / s)
    assert computed.frequency[0] == pytest.approx(abs(s) / (2 * np.pi), rel=LOSS**2)
    assert computed.damping_ratio[0] == pytest.approx(-s.real / abs(s), rel=5e-3)
    assert free.s[0] == pytest.approx(s, rel=LOSS**2)


def test_derivatives_of_a_lossy_mode_against_numerical_derivatives():
    model = lossy(0.7).free_all_parameters()
    theta, scale = model.parameters.value, model.parameters.scale
    computed = modes(model.system(theta))
    for name in ("structural-damping@z.loss_factor", "structural-damping@z.causality", "stiffness.z"):
        i = model.parameters.index(name)
        step = 1e-4 * scale[i] * np.eye(len(theta))[i]
        above, below = modes(model.system(theta + step)), modes(model.system(theta - step))
        numerical = (above.frequency - below.frequency) / 2e-4
        np.testing.assert_allclose(computed.frequency_derivative[:, i] * scale[i], numerical, rtol=2 * LOSS, atol=1e-9)


# ---- motions that do not oscillate -----------------------------------------------------------------------------------


@pytest.mark.parametrize("zeta", [0.3, 1.4])
def test_decay_rates_of_an_overdamped_rig(zeta):
    """Both roots of s^2 + 2 zeta w s + w^2 are real, the slower one slower than zeta w."""
    system = balance_model(one_degree_of_freedom().model_copy(update={"damping_ratio": zeta})).system()
    w = np.sqrt(4e5 / 10.0)
    rates = np.sort(overdamped_decay_rates(system))
    expected = [w * (zeta - np.sqrt(zeta**2 - 1)), w * (zeta + np.sqrt(zeta**2 - 1))] if zeta > 1 else []
    np.testing.assert_allclose(rates, expected, rtol=1e-9)
    assert len(modes(system).frequency) == (zeta < 1)
