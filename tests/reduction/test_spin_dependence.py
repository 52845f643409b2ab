"""Measured responses of a rig with something that spins: the loads of a wind run need those at its rotor speed."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.reduction.response_sources import at_rotor_speed
from balance_cli.signals.run_spectrum import FrequencyResponse
from tests.support import report_content

FREQUENCY = np.arange(4.0, 60.0, 0.5)
SPEED = 17.8
NOISE = 1e-4
CHANNELS = report_content.transfer(COMPONENTS).geometry.channel_names


def truth(frequency, speed, polar_inertia):
    """Responses (k, c, 6) of a rig of unit mass, whose spinning part couples rotations about x and y."""
    stiffness = (2 * np.pi * np.array([18.0, 21.0, 33.0, 25.0, 29.0, 40.0])) ** 2
    coupling = np.zeros((6, 6))
    coupling[3, 4], coupling[4, 3] = 1.0, -1.0
    w = 2 * np.pi * frequency[:, None, None]
    Z = (
        np.diag(stiffness)
        - w**2 * np.eye(6)
        + 1j * w * (2.0 * np.eye(6) + 2 * np.pi * speed * polar_inertia * coupling)
    )
    hub = np.eye(6)
    hub[4, 0], hub[3, 1] = 0.4, -0.4
    rows = np.random.default_rng(1).standard_normal((len(CHANNELS), 6)) * 1e4
    return rows @ np.linalg.solve(Z, np.broadcast_to(hub, Z.shape))


def response(component, speed, level, polar_inertia):
    rng = np.random.default_rng([COMPONENTS.index(component), int(speed)])
    column = truth(FREQUENCY, speed, polar_inertia)[:, :, [COMPONENTS.index(component)]]
    sigma = NOISE * np.abs(column).mean()
    noise = rng.standard_normal(column.shape) + 1j * rng.standard_normal(column.shape)
    k, c = column.shape[:2]
    covariance = np.broadcast_to(sigma**2 * np.eye(c, dtype=complex), (k, c, c))
    unit = np.ones((k, 1, 1), complex)
    return FrequencyResponse(f"{component}-{speed:.0f}", CHANNELS, (component,), "periodic", FREQUENCY,
                             column + sigma * noise / np.sqrt(2), covariance, unit, np.ones((k, c, 1)), np.ones((k, c)),
                             speed, (level,))  # fmt: skip


def source(turning, polar_inertia, speed=SPEED):
    """The source of sweeps of all loads at rest, and of some at SPEED at a lower level."""
    responses = [response(name, 0.0, 10.0, polar_inertia) for name in COMPONENTS]
    responses += [response(name, SPEED, 4.0, polar_inertia) for name in turning]
    transfer = replace(report_content.transfer(COMPONENTS), responses=tuple(responses))
    return at_rotor_speed(transfer_source(transfer, "local"), speed)


def test_responses_at_the_speed_of_the_run_are_preferred_to_those_of_the_highest_level():
    at = np.array([10.0, 30.0])
    measured = source(COMPONENTS, 0.1)
    np.testing.assert_allclose(measured.at(at, SPEED), truth(at, SPEED, 0.1), rtol=0.0, atol=0.5)
    assert measured.response_error is None and not measured.note


@pytest.mark.parametrize("component", ["Fx", "Mx", "Mz"])
def test_what_the_speed_changes_of_some_loads_is_an_error_of_all(component):
    """Of a campaign with a spinning hub loads by responses at rest were 71 standard deviations off, unflagged."""
    at, measured = FREQUENCY[4:-4:8] + 0.2, source(("Mx", "My"), 0.1)
    missed = (truth(at, SPEED, 0.1) - truth(at, 0.0, 0.1))[:, :, COMPONENTS.index(component)]
    loads = np.zeros((len(at), 6), complex)
    loads[:, COMPONENTS.index(component)] = 1.0
    known = np.einsum("kcc->k", measured.response_error.covariance(at, loads)).real
    assert np.mean(np.sum(np.abs(missed) ** 2, axis=1) / known) < 2.0
    assert "rotor speed" in measured.note


def test_without_anything_that_spins_the_responses_have_no_further_error():
    measured = source(("Mx", "My"), 0.0)
    assert measured.response_error is None and not measured.note


def test_a_run_at_rest_has_no_such_error():
    measured = source(("Mx", "My"), 0.1, speed=0.0)
    assert measured.response_error is None and not measured.note
