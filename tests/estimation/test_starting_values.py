"""Regressions on the equations of motion: exciters that record something else than the load of the hub."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.equation_error import equation_error, measured_forces
from balance_cli.estimation.equations_of_motion import motion_residuals
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.starting_values import find_starting_values
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import solve
from balance_cli.signals.run_spectrum import RunSpectrum
from tests.support.exciter_response import exciter_response
from tests.support.rigs import rotor_balance

FREQUENCY = np.linspace(3.0, 120.0, 60)
COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def effect(name, *where, **parameters):
    return DeclaredEffect(name=name, where=where, parameters=parameters)


EXCITERS = (
    effect("exciter-low-pass", "Fx", cutoff=80.0, natural_period=4e-3),
    effect("load-gain", "My", gain=1.02),
    effect("load-delay", "My", delay=3e-4),
    effect("exciter-misalignment", "Fx", "Fz", fraction=0.03),
)


def with_effects(rig, *effects):
    return rig.model_copy(update={"effects": effects})


def exact_lines(rig, components):
    """Lines of a run with the loads that the exciters record, and next to no noise."""
    system = balance_model(rig).system()
    columns = [COMPONENTS.index(name) for name in components]
    T = exciter_response(system, solve(system, FREQUENCY))[:, :, columns]
    rng, c, u = np.random.default_rng(1), *T.shape[1:]
    U = 20.0 * np.exp(2j * np.pi * rng.uniform(size=(len(FREQUENCY), u)))
    covariance = np.broadcast_to((1e-18 * np.eye(c + u)).astype(complex), (len(FREQUENCY), c + u, c + u))
    channels = np.einsum("kcu,ku->kc", T, U)
    return RunSpectrum("run", rig.channel_names, components, FREQUENCY, channels, U, covariance, np.inf)


def batch_of(rig, components=("Fx", "My")):
    return stack_runs([exact_lines(rig, components)], [], rig.channel_names)[0]


def errors_of_motion(batch, system):
    residual = motion_residuals([batch], system)[0](system)
    return residual.error, residual.jacobian()


def errors_of_forces(batch, system):
    return equation_error(system, measured_forces(batch, system))


@pytest.mark.parametrize("errors", [errors_of_motion, errors_of_forces])
def test_the_errors_of_the_equations_vanish_at_the_truth_of_exciters_that_follow_what_is_recorded(errors):
    rig = with_effects(rotor_balance(), *EXCITERS)
    batch, model = batch_of(rig), balance_model(rig)
    error, derivatives = errors(batch, model.system())
    assert np.abs(error).max() < 1e-6
    parameters = model.parameters
    exciters = [i for i, name in enumerate(parameters.names) if name.startswith(("exciter-", "load-"))]
    assert len(exciters) == 5
    for index in exciters:
        step = 1e-4 * parameters.scale[index] * np.eye(len(parameters))[index]
        above, below = (errors(batch, model.system(parameters.value + sign * step))[0] for sign in (1, -1))
        numerical = (above - below) / (2e-4 * parameters.scale[index])
        place = int(np.sum(parameters.free[:index]))
        np.testing.assert_allclose(derivatives[:, :, place], numerical, atol=1e-5 * np.abs(numerical).max())


@pytest.mark.parametrize("natural", [20.0, 30.0, 200.0])
def test_a_regression_from_the_declared_values_finds_the_lag_of_commands(natural):
    """Natural frequencies below the modes (23 to 77 Hz), among them and above."""
    lag = {"cutoff": natural / 0.9, "natural_period": 1.0 / natural}
    rig = rotor_balance()
    loaded = [batch_of(with_effects(rig, effect("exciter-low-pass", "all", **lag)), (name,)) for name in COMPONENTS]
    model = balance_model(with_effects(rig, effect("exciter-low-pass", "all")))
    theta = find_starting_values(model.parameters, loaded, model.system, model.parameters.value).effects_free
    first, second = model.system(theta).equations.load_lag.value[0]
    assert first == pytest.approx(0.9 / (2 * np.pi * natural), rel=0.01)
    assert second == pytest.approx(1.0 / (2 * np.pi * natural) ** 2, rel=0.01)
