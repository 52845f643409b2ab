"""A gyroscopic moment is in no sweep at rest: check runs show it, and the loads of wind-on runs have its error."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.harmonic_loads import harmonic_loads
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.simulation import CampaignPlan, Noise, simulate_campaign, true_rig
from balance_cli.simulation.extensions.library import extension
from balance_cli.steps.hold_out import hold_out_errors
from balance_cli.steps.hold_out_model_error import add_hold_out_error, note_contradicted_loads
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.diagnosis_content import diagnosis
from tests.support.other_rigs import other_rig, short_campaign

GEOMETRY = other_rig("A")
COUPLING = extension("gyroscopic-coupling", polar_inertia=0.2)
# A well identified model: the tolerances of the declaration are far larger than what sweeps leave.
IDENTIFIED = 1e-3


@pytest.fixture(scope="module")
def model():
    computed = identify(measured_spectra([], GEOMETRY), GEOMETRY, IdentifyOptions(method="computed"))
    return replace(computed, covariance=IDENTIFIED**2 * computed.covariance)


def rotor_runs(*effects):
    plans = {plan.run: plan for plan in short_campaign("A", revolutions=80).runs}
    wind = plans["wind-1"]
    checks = [
        plans[run].model_copy(update={"harmonics": {name: wind.harmonics[name] for name in names}})
        for run, names in (("check-1", ("Fx", "Fy", "Fz")), ("check-2", ("Mx", "My", "Mz")))
    ]
    rig = true_rig(GEOMETRY).with_extensions(*effects)
    return simulate_campaign(rig, CampaignPlan(runs=(*checks, wind)), Noise(), 4)


def with_check_runs(model, runs):
    checks = [run for run in runs if run.kind == "check"]
    return add_hold_out_error(model, checks, {run.name: hold_out_errors(run, model, model) for run in checks})


def tilting_moments(model, run):
    """Reduced Mx and My of harmonics 1 to 8 and their standard deviation, (8, 2) each."""
    source = model_source(model)
    record = rotor_record(run, GEOMETRY, source)
    solution = harmonic_loads(record, GEOMETRY, source)
    m = solution.loads.shape[1]
    variance = np.diagonal(solution.inflated_covariance, axis1=1, axis2=2)
    return solution.loads[:, 3:5], np.sqrt(variance[:, 3:5] + variance[:, m + 3 : m + 5])


def test_loads_have_the_error_that_check_runs_show(model):
    runs, _ = rotor_runs(COUPLING)
    still, _ = rotor_runs()
    tested = with_check_runs(model, runs)
    assert tested.response_error is not None
    wrong, stated = tilting_moments(model, runs[2])
    same, widened = tilting_moments(tested, runs[2])
    right, _ = tilting_moments(model, still[2])
    error = np.abs(wrong - right)
    assert np.mean(error > 3 * stated) > 0.5
    np.testing.assert_allclose(same, wrong, rtol=0.05, atol=0.05 * np.abs(wrong).max())
    assert np.mean(np.abs(same - right) < 2 * widened) > 0.9


def test_a_model_that_describes_its_check_runs_stays(model):
    runs, _ = rotor_runs()
    assert with_check_runs(model, runs) is model


def test_components_that_check_runs_contradict_are_flagged_in_other_runs(model):
    """Between the frequencies of check runs their error is a guess: a load was 14 % off, 14 sigma, unflagged."""
    runs, _ = rotor_runs(COUPLING)
    tested = with_check_runs(model, runs)
    assert tested.contradicted is not None and 0 < len(tested.contradicted) < 3
    assert set(tested.contradicted) <= {"Mx", "My"} and min(tested.contradicted.values()) > 0.1
    noted = note_contradicted_loads(diagnosis(), tested)
    assert any("check runs contradict loads" in note for note in noted.notes)
    flagged, plain = (reduce_run(runs[2], GEOMETRY, None, model_source(each)) for each in (tested, model))
    for name, *flags in zip(flagged.components, *flagged.flags[1:], strict=True):
        assert all("model contradicted" in flag for flag in flags) or name not in tested.contradicted
    assert any("check runs that were held out" in note for note in flagged.notes)
    assert not any("check runs that were held out" in note for note in plain.notes)
