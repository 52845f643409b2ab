"""A diagnosis does not depend on units of time, force and length; a body that nobody declared is a candidate."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.result import EXPLAINED, UNEXPLAINED
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.score_statistics import score_in_two_stages
from balance_cli.diagnosis.selection.cross_validation import cross_validation_gain
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.declared_departures import declared_agreement
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.simulation.rig import apply_effects, metric_side
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import identify
from tests.support.rigs import one_degree_of_freedom, rotor_balance
from tests.support.scaled import Scale

ONE = one_degree_of_freedom()
EFFECTS = (
    DeclaredEffect(name="cubic-stiffness", where=("z",), parameters={"k3": 4e10, "side": "beside"}),
    DeclaredEffect(name="load-offset", where=("Fz",), parameters={"offset": 5.0}),
)


@pytest.fixture(scope="module")
def recorded():
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(60.0,), period=4.0, periods=6)
    return simulate_campaign(apply_effects(true_rig(ONE), EFFECTS), CampaignPlan(runs=(plan,)), seed=5).runs


def diagnosed(runs, scale):
    geometry = scale.geometry(ONE)
    scaled = [scale.run(run) for run in runs]
    return diagnose(
        identify(measured_spectra(scaled, geometry), geometry), measured_spectra(scaled, geometry, means=True)
    )


def test_slower_stronger_and_smaller_is_the_same_diagnosis(recorded):
    """Times of ten, forces of a thousand, lengths of a tenth."""
    plain, scale = Scale(1.0, 1.0, 1.0), Scale(10.0, 1000.0, 0.1)
    (one, first), (other, second) = diagnosed(recorded, plain), diagnosed(recorded, scale)
    assert one.verdict == other.verdict == EXPLAINED
    assert other.chi2_per_dof_after == pytest.approx(one.chi2_per_dof_after, rel=1e-3)
    assert [effect.label for effect in other.effects] == [effect.label for effect in one.effects]
    for here, there in zip(one.effects, other.effects, strict=True):
        assert there.evidence.gain == pytest.approx(here.evidence.gain, rel=1e-3)
        for value, scaled in zip(here.parameters, there.parameters, strict=True):
            assert scaled.value == pytest.approx(value.value * scale.of(value.unit), rel=1e-3)
            assert scaled.sigma == pytest.approx(value.sigma * scale.of(value.unit), rel=1e-2)
    assert first.quality.frf_band == (5.0, 150.0)
    assert second.quality.frf_band == pytest.approx((0.2, 15.0), rel=0.3)
    assert second.quality.frf_error == pytest.approx(first.quality.frf_error, rel=0.1)


def test_after_the_time_limit_the_best_model_so_far_is_returned_and_said_to_be_that(recorded):
    spectra = measured_spectra(recorded, ONE, means=True)
    hasty = replace(SETTINGS, time_limit=0.0)
    made, _ = diagnose(identify(measured_spectra(recorded, ONE), ONE), spectra, settings=hasty)
    assert made.verdict == UNEXPLAINED
    assert made.chi2_per_dof_after <= made.chi2_per_dof_before
    assert any("time limit of 0 s of computing" in note for note in made.notes)
    assert "time limit ended the search" in made.meaning
    assert any("before its refit" in trial.reason for trial in made.trials)


def test_a_body_that_nobody_declared_relieves_the_declared_center_of_gravity():
    """With the plate's damping ratios as they are, mass properties alone describe the data: only the priors object."""
    geometry, place = rotor_balance(), np.array([0.10, 0.05, 0.60])
    mass, cg, inertia = metric_side(geometry)
    total = mass + 20.0
    center = (mass * cg + 20.0 * place) / total
    for part, arm in ((mass, cg - center), (20.0, place - center)):
        inertia = inertia + part * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    sweeps = (
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=6)
        for name, level in HIGH_SWEEP_LEVELS.items()
    )
    rig = true_rig(geometry, mass=total, cg=center, inertia=inertia)
    runs = simulate_campaign(rig, CampaignPlan(runs=(*static_plans(), *sweeps)), seed=3).runs
    spectra = measured_spectra(runs, geometry, means=True)
    found = identify(spectra, geometry)
    assert found.quality.chi2_per_dof < 1.1
    assert [item.name for item in declared_agreement(found).departures] == ["centre_of_gravity.z"]
    model, theta = balance_model(geometry), found.parameters.value
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    (score,) = score_in_two_stages(model.at(theta), batches, [candidate_at("added-mass", (), geometry)], SETTINGS)
    start = score.candidate.starts[score.start]
    assert score.p_value < 1e-10
    assert start["damping_share"] == 1.0
    assert float(score.step[0]) == pytest.approx(20.0, rel=0.2)
    assert [start[axis] for axis in "xyz"] == pytest.approx(place, abs=0.06)
    # The declared values are data: what they alone support is not refused for lack of a line that does.
    assert not cross_validation_gain(model.at(theta), batches, score, SETTINGS) <= 0.0
