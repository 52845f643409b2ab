"""Channels that sum cells, and accelerometers on either side: closed forms, the simulated rig, fits and reductions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.state_space import state_space
from balance_cli.model.system_response import response, solve
from balance_cli.simulation import true_rig
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.response import force_matrix, full_system, input_matrix, state_matrix
from balance_cli.simulation.rig import apply_effects
from balance_cli.simulation.sensors import sensor_volts
from tests.support.other_rigs import other_rig
from tests.support.realization_error import realization_error
from tests.support.rigs import angular_frequency, one_degree_of_freedom, two_degrees_of_freedom

FREQUENCY = np.concatenate([[0.0], np.geomspace(1.0, 200.0, 40)])
SUPPORT = {"mass": 60.0, "damping_ratio": 0.03, "compliance_x": 4e-8, "compliance_z": 2e-8}
TILT = {"inertia_phi": 8.0, "compliance_phi": 4e-7}


def accelerometer(name: str, position: list[float], axis: list[float], side: str) -> dict[str, Any]:
    """A channel of an accelerometer, 10 mV/(m/s2)."""
    sensor = {"position": position, "axis": axis, "side": side}
    return {"name": name, "accelerometer": sensor, "sensitivity": 0.01, "time_constant": 1.5}


def equipped_hexapod() -> Geometry:
    """Rig A: three sums of two legs, six strain channels, and accelerometers on both sides."""
    content = geometry_to_dict(other_rig("A"))
    sums = [{"name": f"pair{i}", "cells": {f"l{i}": 1.0, f"l{i + 1}": 0.5}, "sensitivity": 0.02} for i in (1, 3, 5)]
    sensors = [
        accelerometer("ax", [0.1, 0.05, 0.2], [1.0, 0.0, 0.0], "metric"),
        accelerometer("az", [-0.2, 0.1, 0.0], [0.2, 0.0, 1.0], "metric"),
        accelerometer("ground", [0.3, 0.0, -0.4], [1.0, 0.0, 0.5], "non-metric"),
    ]
    strain = [channel for channel in content["channels"] if channel["name"].endswith("strain")]
    return geometry_from_dict({**content, "channels": [*strain, *sums, *sensors]})


def hexapod_with_shafts() -> Geometry:
    """Rig A with two torque meters in the shaft about z, which ends beside the plate, and one of a drive on it."""
    content = geometry_to_dict(other_rig("A"))
    meters = [
        {"name": "hub", "stiffness": 9.0e3, "inertia": 0.05},
        {"name": "propeller", "stiffness": 2.0e4, "inertia": 0.08, "axis": "x", "carried_by": "plate"},
        {"name": "drive", "stiffness": 3.0e4, "inertia": 0.2},
    ]
    channels = [
        {"name": f"{item['name']} torque", "torque_meter": item["name"], "sensitivity": 0.02} for item in meters
    ]
    return geometry_from_dict({**content, "torque_meters": meters, "channels": [*content["channels"], *channels]})


def with_support(geometry: Geometry) -> Geometry:
    """The same rig on a flexible support."""
    parameters = {**SUPPORT, **TILT}
    effect = DeclaredEffect(name="support-flexibility", where=("x", "z", "phi"), parameters=parameters)
    return geometry.model_copy(update={"effects": (effect,)})


def test_an_accelerometer_of_one_degree_of_freedom():
    rig = one_degree_of_freedom(
        channels=[{"name": "a", "accelerometer": {"position": [0.3, 0, 0], "axis": [0, 0, 2]}, "sensitivity": 0.05}]
    )
    system = balance_model(rig).system()
    w, k, m = angular_frequency(FREQUENCY), 4e5, 10.0
    motion = 1.0 / (k - w**2 * m + 1j * w * 2 * 0.02 * np.sqrt(k * m))
    np.testing.assert_allclose(response(system, solve(system, FREQUENCY))[:, 0, 2], -0.05 * w**2 * motion, rtol=1e-12)


def test_a_sum_is_that_of_its_cells():
    rig = two_degrees_of_freedom()
    content = geometry_to_dict(rig)
    content["channels"].append({"name": "sum", "cells": {"a": 1.0, "b": -0.5}, "sensitivity": 0.004})
    system = balance_model(geometry_from_dict(content)).system()
    T = response(system, solve(system, FREQUENCY))
    np.testing.assert_allclose(T[:, 2], 2.0 * T[:, 0] - T[:, 1], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("geometry", [with_support(equipped_hexapod()), with_support(hexapod_with_shafts())])
def test_response_is_that_of_the_simulated_rig(geometry):
    """On a flexible support; the simulation has its own equations and its own accelerations."""
    rig = apply_effects(true_rig(geometry), geometry.effects)
    mechanics = equations_of_motion(rig)
    A, B, C = state_matrix(mechanics), input_matrix(mechanics)[:, :6], force_matrix(mechanics)
    s = 2j * np.pi * FREQUENCY[1:]
    states = np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B.astype(complex))
    motion = np.pad(mechanics.accelerometer_rows, ((0, 0), (0, len(A) - mechanics.size)))
    measured = np.concatenate([C @ states, s[:, None, None] ** 2 * (motion @ states)], axis=1)
    one_sensor_each = np.eye(measured.shape[1])
    gain = np.ones((len(s), len(geometry.channels)), complex)
    for i, channel in enumerate(geometry.channels):
        gain[:, i] /= 1.0 if channel.lowpass is None else 1 + s / (2 * np.pi * channel.lowpass)
        gain[:, i] *= (
            1.0 if channel.time_constant is None else s * channel.time_constant / (1 + s * channel.time_constant)
        )
    plain = tuple(c.model_copy(update={"lowpass": None, "time_constant": None}) for c in geometry.channels)
    undelayed = replace(rig, geometry=geometry.model_copy(update={"channels": plain}))
    weights = sensor_volts(undelayed, one_sensor_each, None).T
    expected = gain[:, :, None] * (weights @ measured)
    system = balance_model(geometry).system()
    T = response(system, solve(system, FREQUENCY[1:]))
    np.testing.assert_allclose(T, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_simulated_accelerations_are_the_second_derivatives_of_the_motion():
    rig = true_rig(equipped_hexapod())
    step, frequency = 1e-4, 40.0
    time = np.arange(20000) * step
    loads = np.zeros((len(time), 6))
    loads[:, 2] = np.cos(2 * np.pi * frequency * time)
    mechanics = equations_of_motion(rig)
    measured = full_system(mechanics).response(loads, step)
    cells, accelerations = len(mechanics.cell_rows), mechanics.accelerometer_rows
    q = np.linalg.lstsq(mechanics.cell_stiffness[:, None] * mechanics.cell_rows, measured[:, :cells].T, rcond=None)[0]
    by_difference = np.gradient(np.gradient((accelerations @ q).T, step, axis=0), step, axis=0)
    inner = slice(1000, -1000)
    scale = np.abs(measured[inner, cells:]).max()
    np.testing.assert_allclose(measured[inner, cells:], by_difference[inner], atol=1e-3 * scale)


@pytest.mark.parametrize("flexible", [False, True])
def test_derivatives_and_state_space(flexible):
    geometry = equipped_hexapod()
    model = balance_model(with_support(geometry) if flexible else geometry).free_all_parameters()
    theta, scale = model.parameters.value, model.parameters.scale
    rng = np.random.default_rng(3)
    loads = rng.normal(size=(len(FREQUENCY), 6)) + 1j * rng.normal(size=(len(FREQUENCY), 6))

    def volts(values):
        system = model.system(values)
        return np.einsum("kcm,km->kc", response(system, solve(system, FREQUENCY)), loads)

    system = model.system(theta)
    jacobian = output_jacobian(system, solve(system, FREQUENCY), np.arange(len(FREQUENCY)), loads)
    for p in range(0, len(theta), 3):
        change = np.zeros(len(theta))
        change[p] = 1e-4 * scale[p]
        numeric = (volts(theta + change) - volts(theta - change)) / (2 * change[p])
        size = np.abs(jacobian[:, :, p]).max() or 1.0
        np.testing.assert_allclose(numeric, jacobian[:, :, p], atol=2e-5 * size)
    assert realization_error(state_space(system), system, np.geomspace(1.0, 400.0, 50)) < 1e-8


@pytest.mark.parametrize(
    ("channel", "place", "words"),
    [
        ({"cells": {"l1": 1.0, "l9": 1.0}}, "channels[12].cells.l9", "no cell `l9`"),
        ({"cells": {"l1": 0.0}}, "channels[12]", "a weight in `cells` is zero"),
        ({"cells": {"l1": 1.0}, "cell": "l1"}, "channels[12]", "give either"),
        ({"accelerometer": {"position": [0, 0, 0], "axis": [0, 0, 0]}}, "channels[12].accelerometer.axis", "length"),
        ({"accelerometer": {"position": [0, 0, 0], "axis": [0, 0, 1], "side": "top"}}, "accelerometer.side", "metric"),
    ],
)
def test_faults_are_named_with_their_place(channel, place, words):
    content = geometry_to_dict(other_rig("A"))
    content["channels"].append({"name": "more", "sensitivity": 0.01, **channel})
    with pytest.raises(UserError) as caught:
        geometry_from_dict(content)
    assert place in caught.value.place and words in caught.value.fault


def test_moments_go_through_their_shafts():
    geometry = hexapod_with_shafts()
    system = balance_model(geometry).system()
    T = response(system, solve(system, np.array([0.0])))[0]
    torques = [geometry.channel_names.index(f"{name} torque") for name in ("hub", "drive", "propeller")]
    expected = 0.02 * np.array([[0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 1], [0, 0, 0, 1, 0, 0]])
    np.testing.assert_allclose(T[torques], expected, atol=1e-12)
    cells = T[[i for i, channel in enumerate(geometry.channels) if channel.cell and channel.measures_dc]]
    assert np.abs(cells[:, 3]).max() > 0.1 * np.abs(cells[:, 2]).max() and not cells[:, 5].any()


@pytest.mark.parametrize(
    ("change", "place", "fault"),
    [
        (lambda c: c["torque_meters"][2].update(name="hub"), "torque_meters[2]", "already"),
        (lambda c: c["torque_meters"][0].pop("name"), "torque_meters[0]", "no `name`"),
        (
            lambda c: c["torque_meters"][2].update(carried_by="plate"),
            "torque_meters[2].carried_by",
            "by the ground and",
        ),
        (
            lambda c: c["channels"][-1].update(torque_meter="drve"),
            "channels[14].torque_meter",
            "no torque meter `drve`",
        ),
        (lambda c: c["channels"][-1].update(torque_meter=True), "channels[14].torque_meter", "which of the torque"),
        (lambda c: c.update(torque_meter={"stiffness": 1.0, "inertia": 1.0}), "torque_meters", "declared, too"),
    ],
)
def test_faults_of_torque_meters_name_their_place(change, place, fault):
    content = geometry_to_dict(hexapod_with_shafts())
    change(content)
    with pytest.raises(UserError, match=fault) as raised:
        geometry_from_dict(content)
    assert raised.value.place == place
