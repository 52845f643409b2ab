"""Identification of a simulated balance: truth from the integration in time."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.io.errors import UserError
from balance_cli.model.parameters import declared_parameters
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.rigs import one_degree_of_freedom, rotor_balance
from tests.support.truth import response_errors, true_parameters

NOTHING = Spectra((), (), {}, {})


def test_responses_are_those_of_the_rig_within_the_predicted_error(campaign, identified):
    error, predicted = response_errors(campaign.rig, identified)
    ratio = np.percentile(error, 95, axis=0) / np.percentile(predicted, 95, axis=0)
    assert np.all(np.percentile(error, 95, axis=0) < 4e-3)
    assert np.all(ratio < 1.7)


def test_parameters_lie_within_their_sigma(campaign, identified):
    table = identified.parameters
    truth = true_parameters(campaign.rig, declared_parameters(campaign.geometry))
    free = table.declared_sigma > 0
    error = (table.value - truth)[free] / table.sigma[free]
    assert np.abs(error).max() < 4.0
    assert np.sqrt(np.mean(error**2)) < 1.6
    assert np.all(table.sigma[~free] == 0)


def test_chi2_against_the_measured_noise(identified):
    assert 0.85 < identified.quality.chi2_per_dof < 1.2
    assert identified.converged
    assert identified.quality.frf_error < 0.01


def test_what_the_data_leave_open_is_the_scale(identified):
    rests = dict(zip(identified.parameters.names, identified.parameters.informed_by, strict=True))
    assert all(rests[f"stiffness.{cell}"] == "prior" for cell in ("x", "y1", "y2", "z1", "z2", "z3", "z4"))
    assert rests["mass"] == rests["inertia.xx"] == rests["torque_meter.inertia"] == "prior"
    assert all(rests[f"damping_ratio.{i}"] == "data" for i in range(1, 7))
    assert rests["centre_of_gravity.z"] == "data"
    assert rests["sensitivity.x.piezo"] == "exact"
    assert len(identified.unidentifiable) == 2
    assert any("torque_meter.inertia" in words and "mass" not in words for words in identified.unidentifiable)


def test_every_method_and_start_comes_to_the_same_maximum(campaign, identified):
    spectra = measured_spectra(campaign.runs_of_kind("sweep", "static"), campaign.geometry)
    alternative = identify(spectra, campaign.geometry, IdentifyOptions(method="ml"))
    assert alternative.start == "geometry"
    np.testing.assert_allclose(alternative.modes.frequency, identified.modes.frequency, rtol=1e-6)
    assert alternative.quality.chi2 == pytest.approx(identified.quality.chi2, rel=1e-6)


def test_least_squares_alone_is_near_and_worse(campaign, identified):
    spectra = measured_spectra(campaign.runs_of_kind("sweep"), campaign.geometry)
    first = identify(spectra, campaign.geometry, IdentifyOptions(method="ls"))
    np.testing.assert_allclose(first.modes.frequency, identified.modes.frequency, rtol=0.02)
    assert first.quality.chi2_per_dof > identified.quality.chi2_per_dof


def test_the_computed_model_is_the_geometry(campaign):
    model = identify(NOTHING, campaign.geometry, IdentifyOptions(method="computed"))
    np.testing.assert_array_equal(model.parameters.value, model.parameters.declared)
    np.testing.assert_allclose(model.parameters.sigma, model.parameters.declared_sigma, rtol=1e-9)
    assert model.modes.frequency[1] == pytest.approx(25.3, abs=0.01)
    assert np.isnan(model.quality.frf_error)


def test_same_input_same_result(campaign, identified):
    again = identify(measured_spectra(campaign.runs, campaign.geometry), campaign.geometry)
    np.testing.assert_array_equal(again.parameters.value, identified.parameters.value)
    np.testing.assert_array_equal(again.covariance, identified.covariance)


def test_one_level_of_one_component_is_enough_for_one_degree_of_freedom():
    from balance_cli.simulation import SweepPlan, simulate_run, true_rig

    geometry = one_degree_of_freedom()
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(20.0,), periods=8, period=2.0)
    run, _ = simulate_run(true_rig(geometry, stiffness=[4.1e5]), plan, seed=2)
    model = identify(measured_spectra([run], geometry), geometry)
    assert model.modes.frequency[0] == pytest.approx(np.sqrt(4.1e5 / 10.0) / (2 * np.pi), rel=2e-4)
    assert 0.7 < model.quality.chi2_per_dof < 1.3


def test_random_excitation_gives_the_same_rig():
    from balance_cli.simulation import SweepPlan, simulate_run, true_rig

    geometry = one_degree_of_freedom()
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(20.0,), periods=10, period=2.0, excitation="random")
    run, _ = simulate_run(true_rig(geometry, stiffness=[4.1e5]), plan, seed=2)
    model = identify(measured_spectra([run], geometry), geometry)
    frequency = np.sqrt(4.1e5 / 10.0) / (2 * np.pi)
    assert abs(model.modes.frequency[0] - frequency) < max(4 * model.modes.sigma_frequency[0], 2e-4 * frequency)
    assert model.quality.chi2_per_dof < 1.6


def test_identification_without_sweeps_raises():
    with pytest.raises(UserError, match="no sweep"):
        identify(NOTHING, rotor_balance())


def test_a_band_without_lines_is_refused(campaign):
    spectra = measured_spectra(campaign.runs_of_kind("sweep")[:1], campaign.geometry)
    with pytest.raises(UserError, match="--band: no line of the sweeps lies between 1000 and 2000 Hz"):
        identify(spectra, campaign.geometry, IdentifyOptions(band=(1000.0, 2000.0)))


def test_the_papers_form_finds_the_same_modes(campaign, identified):
    spectra = measured_spectra(campaign.runs_of_kind("sweep"), campaign.geometry)
    model = identify(spectra, campaign.geometry, IdentifyOptions(form="paper", damping="full"))
    plate = np.delete(identified.modes.frequency, np.argmin(np.abs(identified.modes.shape[:, :6]).max(axis=1)))
    np.testing.assert_allclose(model.modes.frequency, plate, rtol=2e-3)
    assert model.paper is not None
    with pytest.raises(UserError, match="identified, not computed"):
        identify(spectra, campaign.geometry, IdentifyOptions(form="paper", method="computed"))


def test_a_band_keeps_means_and_leaves_the_other_lines_out(campaign):
    sweeps = campaign.runs_of_kind("sweep")[:2]
    spectra = measured_spectra(sweeps, campaign.geometry, means=True)
    assert spectra.in_band(None) is spectra
    narrow = spectra.in_band((10.0, 40.0))
    for whole, kept in zip(spectra.lines, narrow.lines, strict=True):
        inside = (whole.frequency == 0) | ((whole.frequency >= 10.0) & (whole.frequency <= 40.0))
        np.testing.assert_array_equal(kept.frequency, whole.frequency[inside])
        np.testing.assert_array_equal(kept.channels, whole.channels[inside])
        assert 0.0 in kept.frequency and len(kept.frequency) < len(whole.frequency)


def test_a_diagnosis_stays_in_the_band_of_its_model(campaign):
    runs = campaign.runs_of_kind("sweep")[:3]
    spectra = measured_spectra(runs, campaign.geometry, means=True)
    model = identify(measured_spectra(runs, campaign.geometry), campaign.geometry, IdentifyOptions(band=(10.0, 40.0)))
    found, updated = diagnose(model, spectra, settings=replace(DEFAULT_SETTINGS, time_limit=0.0))
    assert model.band == updated.band == (10.0, 40.0)
    edges, size = found.residual.edges, found.residual.after
    outside = (edges[1:] < 10.0) & (edges[:-1] > 0.0) | (edges[:-1] > 40.0)
    assert np.isnan(size[:, outside]).all() and not np.isnan(size[:, ~outside]).all()
