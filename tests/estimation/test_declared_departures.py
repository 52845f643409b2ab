from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.declared_departures import declared_agreement
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.steps.identify import IdentifyOptions, identify


def declared_otherwise(geometry: Geometry, shift: float) -> Geometry:
    """The same rig with its first body declared higher, so that the center of gravity lies `shift` [m] higher."""
    bodies = list(geometry.bodies)
    total = sum(body.mass for body in bodies)
    x, y, z = bodies[0].position
    bodies[0] = bodies[0].model_copy(update={"position": (x, y, z + shift * total / bodies[0].mass)})
    return geometry.model_copy(update={"bodies": tuple(bodies)})


def test_a_rig_within_its_tolerances_agrees(identified):
    agreement = declared_agreement(identified)
    assert agreement.departures == ()
    assert agreement.dof > 5
    assert agreement.p_value > 1e-3


def test_a_computed_model_has_nothing_to_compare(campaign):
    model = identify(measured_spectra([], campaign.geometry), campaign.geometry, IdentifyOptions(method="computed"))
    assert declared_agreement(model).dof == 0


def test_a_center_of_gravity_declared_wrong_is_named_although_the_data_fit(campaign, identified):
    geometry = declared_otherwise(campaign.geometry, 0.05)
    model = identify(measured_spectra(campaign.runs, geometry), geometry)
    agreement = declared_agreement(model)
    assert model.quality.chi2_per_dof < 1.2 * max(1.0, identified.quality.chi2_per_dof)
    assert agreement.departures[0].name == "centre_of_gravity.z"
    assert agreement.departures[0].sigmas < -4.0
    assert agreement.p_value < 1e-4


@pytest.mark.parametrize("shift", [0.0, 1.0, 4.0, -6.0])
def test_sigmas_are_those_of_a_closed_form(identified, shift):
    """One parameter known well from data: its shift in units of the declared standard deviation."""
    table = identified.parameters
    i = table.names.index("centre_of_gravity.z")
    value = table.declared.copy()
    value[i] += shift * table.declared_sigma[i]
    covariance = np.diag(table.declared_sigma**2)
    covariance[i, i] *= 0.19
    model = replace(identified, parameters=replace(table, value=value), covariance=covariance)
    agreement = declared_agreement(model)
    assert agreement.dof == 1
    assert agreement.chi2 == pytest.approx(shift**2 / 0.81)
    listed = [departure.sigmas for departure in agreement.departures]
    assert listed == ([pytest.approx(shift / 0.9)] if abs(shift) > 3 else [])
