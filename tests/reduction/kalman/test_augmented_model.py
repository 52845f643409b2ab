"""Balance, filters, delays and loads as one sampled model: its response to harmonic loads is that of the balance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.model.balance import balance_model
from balance_cli.model.state_space import state_space, with_anti_alias
from balance_cli.reduction.kalman.augmented_model import MeasuredSystem, initial_covariance, sampled_system
from balance_cli.reduction.kalman.load_models import LowPassDrift, Oscillators
from balance_cli.signals.anti_alias import anti_alias_response
from tests.support.kalman_models import Array
from tests.support.rigs import rotor_balance

STEP = 1.0 / 800.0
LATE = ("time-delay", ("z1.piezo",), {"delay": 1e-3})
LATER = ("time-delay", ("z2.piezo",), {"delay": 3.1e-3})
EARLY = ("time-delay", ("x.strain",), {"delay": -2e-3})
CROSSTALK = ("crosstalk", ("x.strain", "z1.strain"), {"fraction": 0.05})
GYROSCOPIC = ("gyroscopic-coupling", (), {"polar_inertia": 3.0})
CARRIED = ("extra-mode", ("x",), {"frequency": 60.0, "damping_ratio": 0.02, "mass": 3.0, "shape_theta": 0.3})
CASES = {
    "as declared": (),
    "late": (LATE, LATER),
    "late and early under crosstalk": (LATE, EARLY, CROSSTALK),
    "mode, gyroscopic, late": (CARRIED, GYROSCOPIC, LATE),
}
COLUMNS = tuple(range(6))


def _system(effects=(), columns: tuple[int, ...] = COLUMNS) -> MeasuredSystem:
    geometry = rotor_balance()
    declared = tuple(DeclaredEffect(name=name, where=where, parameters=values) for name, where, values in effects)
    system = balance_model(geometry.model_copy(update={"effects": declared})).system()
    space = with_anti_alias(state_space(system, 17.5), geometry.acquisition)
    noise = np.geomspace(1e-8, 1e-5, len(space.mixing))
    return MeasuredSystem(space, columns, STEP, noise, np.zeros(len(space.channel_names)))


def _sampled_response(system: MeasuredSystem, speed: float, order: int) -> Array:
    """Volts per load at one harmonic, of the states that follow an oscillator without noise, turning for ever."""
    m = len(system.columns)
    model = sampled_system(system, [Oscillators(np.zeros((1, m)), np.ones((1, m)), (order,), speed)])
    n = system.balance_order
    turning = slice(n, n + 2 * m)
    kept = np.r_[0:n, n + 2 * m : model.order]
    z = np.exp(2j * np.pi * order * speed * system.step)
    driving = np.kron(np.eye(m), np.array([[1.0], [1.0j]]))
    states = np.linalg.solve(
        z * np.eye(len(kept)) - model.F[np.ix_(kept, kept)], model.F[kept, turning].astype(complex) @ driving
    )
    assert np.allclose(model.F[turning, turning] @ driving, z * driving, rtol=0, atol=1e-11)
    volts = model.H[:, kept] @ states + model.H[:, turning] @ driving
    return np.sqrt(system.noise)[:, None] * volts


@pytest.mark.parametrize("effects", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("order", [1, 4, 8])
def test_response_to_a_harmonic_is_that_of_the_balance(effects, order):
    system, speed = _system(effects), 17.5
    frequency = order * speed
    exact = system.space.response(frequency)[0]
    # The states refer to an instant after the sample where a channel runs early.
    exact = exact * np.exp(-2j * np.pi * frequency * system.state_lead_time)
    size = np.abs(exact).max(axis=0)
    assert (np.abs(_sampled_response(system, speed, order) - exact) / size).max() < 1e-9


def test_the_response_has_the_anti_alias_filter_in_it():
    system, geometry = _system((LATE,)), rotor_balance()
    bare = balance_model(
        geometry.model_copy(update={"effects": (DeclaredEffect(name=LATE[0], where=LATE[1], parameters=LATE[2]),)})
    ).system()
    exact = anti_alias_response(geometry.acquisition, 140.0) * state_space(bare, 17.5).response(140.0)[0]
    size = np.abs(exact).max(axis=0)
    assert (np.abs(_sampled_response(system, 17.5, 8) - exact) / size).max() < 1e-9


def test_ahead_is_how_early_the_earliest_channel_runs():
    assert _system((LATE,)).state_lead_time == 0.0
    assert _system((LATE, EARLY)).state_lead_time == 2e-3


def test_loads_that_the_balance_does_not_carry_are_left_out():
    some = (COMPONENTS.index("Fz"), COMPONENTS.index("Mx"))
    whole, part = _sampled_response(_system((LATE,)), 17.5, 3), _sampled_response(_system((LATE,), some), 17.5, 3)
    assert np.abs(part - whole[:, some]).max() < 1e-10 * np.abs(whole).max()


LAYERS = (
    LowPassDrift(np.array([100.0, 80.0, 200.0, 20.0, 30.0, 10.0]), 0.1, 5.0),
    LowPassDrift(np.full(6, 5.0), 100.0, 150.0),
)
OSCILLATORS = Oscillators(np.full((3, 6), 1.0), np.full((3, 6), 20.0), (1, 2, 4), 17.5).with_stationary_drift()
HELD = np.array([500.0, 300.0, 2000.0, 100.0, 200.0, 150.0])


@pytest.mark.parametrize("effects", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("offset", [0.0, 1e-2])
def test_first_covariance_is_one(effects, offset):
    """It is positive semidefinite, in units of its own sizes, and no size is nil."""
    system = _system(effects)
    system = replace(system, offset=np.where(np.arange(len(system.offset)) == 2, offset, 0.0))
    P = initial_covariance(system, [*LAYERS, OSCILLATORS], HELD)
    size = np.sqrt(np.diag(P))
    assert size.min() > 0.0
    assert np.abs(P - P.T).max() < 1e-12 * np.abs(P).max()
    value = np.linalg.eigvalsh(P / np.outer(size, size))
    assert value.min() > -1e-10
    if offset:
        place = system.balance_order + 24 + 36
        assert np.isclose(size[place], offset, rtol=1e-4)


def test_loads_are_as_large_at_first_as_their_layers_say():
    system = _system((LATE,))
    layers = [*LAYERS, OSCILLATORS]
    P, U = initial_covariance(system, layers, HELD), sampled_system(system, layers).U
    expected = sum(layer.sigma**2 for layer in layers)
    assert np.allclose(np.diag(U @ P @ U.T), expected, rtol=1e-6)
