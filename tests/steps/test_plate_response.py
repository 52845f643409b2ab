"""What the channels read of a moment on the plate about the shaft of a torque meter."""

from __future__ import annotations

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.calibrate_all_trims import plate_response
from tests.support.rigs import one_degree_of_freedom
from tests.support.static_runs import loading, rigid_matrix, static_run


def thrust_and_torque(axis: str, freedom: list[str], **changes: object) -> Geometry:
    """Cells along x and two along z, and a torque meter on ground whose shaft is parallel to `axis`."""
    cells = [
        {"name": "x", "position": [-0.1, 0, 0.1], "axis": [1, 0, 0], "stiffness": 9e5, "full_range": 500.0},
        {"name": "a", "position": [0.3, 0, 0], "axis": [0, 0, 1], "stiffness": 1e6, "full_range": 1000.0},
        {"name": "b", "position": [-0.3, 0, 0], "axis": [0, 0, 1], "stiffness": 1e6, "full_range": 1000.0},
    ]
    channels = [
        *({"name": f"{cell['name']}.strain", "cell": cell["name"], "sensitivity": 0.01} for cell in cells),
        {"name": "torque", "torque_meter": True, "sensitivity": 0.05},
    ]
    meter = {"stiffness": 8e3, "inertia": 0.05, "axis": axis}
    return one_degree_of_freedom(
        **{"freedom": freedom, "cells": cells, "channels": channels, "torque_meter": meter, **changes}
    )


def test_cells_read_nothing_about_a_shaft_about_which_the_plate_cannot_turn() -> None:
    rig = thrust_and_torque("x", ["x", "z", "theta"])
    # Loads Fx, Fz, Mx, My, of which the plate carries all but Mx.
    response = plate_response(rig, rig.channel_names)
    assert response is not None
    np.testing.assert_array_equal(response[:, 2], 0.0)
    assert np.isnan(response[:, [0, 1, 3]]).all()


def test_cells_read_the_moment_where_the_plate_turns() -> None:
    rig = thrust_and_torque("y", ["x", "z", "theta"])
    # About the hub, which two cells 0.6 m apart carry; the meter reads the moment of the shaft alone.
    response = plate_response(rig, rig.channel_names)
    assert response is not None
    np.testing.assert_allclose(response[:, 2], [0.0, -0.01 / 0.6, 0.01 / 0.6, 0.0], atol=1e-12)


@pytest.mark.parametrize(("axis", "component"), [("x", "Mx"), ("z", "Mz")])
def test_a_rig_of_thrust_and_torque_is_calibrated(axis: str, component: str) -> None:
    force = f"F{axis}"
    rig = thrust_and_torque(axis, [axis])
    truth = rigid_matrix(rig)
    run = static_run(rig, truth, loading(components=(force, component)), np.random.default_rng(1))
    calibration = calibrate([run], rig)
    assert calibration.trims["bare"].components == (force, component)
    assert calibration.all_trims is not None
