"""Reduction by measured responses: of a rig without masses, and of one whose mass has changed since the sweeps."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import load_response
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.rigs import rotor_balance


@pytest.fixture(scope="module")
def transfer(campaign):
    return estimate_responses(campaign.runs_of_kind("sweep"), campaign.geometry)


def without_mechanics(geometry):
    """The rig by its cells and freedom alone."""
    declared = geometry.model_dump(mode="json", exclude_none=True)
    declared = {key: value for key, value in declared.items() if key not in ("bodies", "damping_ratio", "effects")}
    declared["tolerances"] = {"sensitivity": 0.0}
    return Geometry.model_validate(declared)


def test_masses_of_the_geometry_are_not_needed(campaign, calibration, transfer):
    bare = without_mechanics(campaign.geometry)
    assert not bare.bodies
    check = campaign.runs_of_kind("check")[0]
    full = reduce_run(check, campaign.geometry, calibration, transfer_source(transfer, "local"))
    measured = estimate_responses(campaign.runs_of_kind("sweep"), bare)
    loads = reduce_run(check, bare, calibration, transfer_source(measured, "local"))
    np.testing.assert_allclose(loads.amplitude, full.amplitude, rtol=1e-9, atol=1e-12)
    cosine, sine = campaign.truths[check.name].harmonics(*loads.interval)
    error = np.abs(loads.amplitude - (cosine - 1j * sine))[1:]
    assert np.all(error < 5.0 * np.hypot(loads.sigma_cosine, loads.sigma_sine)[1:])


def test_cells_of_a_rigid_plate_hardly_show_a_changed_mass():
    """A hub load moves a rigid plate as the inertia of a mass does: redundant channels see a tenth of it at most.

    That is what is left: the shaft carries Mz beside the plate, so that no hub load replaces the yawing moment of a
    mass. Loads by the response of the sweeps are then wrong without a flag; a check run shows it.
    """
    physical = balance_model(rotor_balance())
    heavier = physical.parameters.value.copy()
    heavier[physical.parameters.names.index("mass")] *= 1.05
    frequency = 17.5 * np.arange(1, 9)
    before, after = (load_response(physical.system(theta), frequency) for theta in (physical.parameters.value, heavier))
    for T, changed in zip(before, after, strict=True):
        difference = changed - T
        left = difference - T @ np.linalg.lstsq(T, difference, rcond=1e-12)[0]
        assert np.abs(difference).max() > 1e-3 * np.abs(T).max()
        assert np.abs(left).max() < 0.1 * np.abs(difference).max()
