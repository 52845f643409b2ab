"""Errors on hold-out runs: those of `reduce`, without a calibration, and those of the sweeps."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.conclusions import is_described, judge_hold_out
from balance_cli.diagnosis.result import EXPLAINED
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.reduction.model_sources import model_source
from balance_cli.steps.hold_out import OTHER_EXCITERS, hold_out_errors
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.diagnosis_content import diagnosis
from tests.support.rigs import one_degree_of_freedom, rotor_balance
from tests.support.truth import response_errors

NOTHING = Spectra((), (), {}, {})


def computed(geometry):
    return identify(NOTHING, geometry, IdentifyOptions(method="computed"))


@pytest.fixture(scope="module")
def errors(campaign, identified):
    """Of the check run: the declared rig before, the identified one after."""
    return hold_out_errors(campaign.runs_of_kind("check")[0], computed(campaign.geometry), identified)


def test_errors_of_hub_loads_are_those_of_a_reduction(campaign, calibration, identified, errors):
    run = campaign.runs_of_kind("check")[0]
    reduced = reduce_run(run, campaign.geometry, calibration, model_source(identified)).check
    assert errors.after.load_error == reduced.load_error
    assert errors.after.interaction == reduced.interaction
    assert errors.noise.load_error == reduced.load_noise
    assert errors.noise.interaction == reduced.interaction_noise
    assert set(errors.after.load_error) | set(errors.after.interaction) == {"Fx", "Fy", "Fz", "Mx", "My", "Mz"}


def test_a_right_model_comes_near_the_noise_and_a_wrong_one_does_not(errors):
    for kind in ("load_error", "interaction"):
        before, after, noise = (getattr(part, kind) for part in (errors.before, errors.after, errors.noise))
        assert all(after[name] < 4 * noise[name] + 2e-3 for name in after), kind
        assert sum(before.values()) > 20 * sum(after.values())
    assert errors.noise.frf_error < errors.after.frf_error < 5e-3
    assert errors.before.frf_error > 0.05


def test_what_no_sweep_informs_is_expected_to_be_off_by_its_tolerance(campaign, identified):
    """The declared rig is off by what its tolerances permit; an identified one by little more than noise."""
    run, declared = campaign.runs_of_kind("check")[0], computed(campaign.geometry)
    errors, known = hold_out_errors(run, declared, declared), hold_out_errors(run, identified, identified)
    assert errors.after.frf_error > 50 * errors.noise.frf_error
    assert 0.2 < errors.after.frf_error / errors.expected.frf_error < 4
    ratios = np.array(
        [errors.after.load_error[name] / errors.expected.load_error[name] for name in errors.after.load_error]
    )
    assert 0.1 < np.sqrt(np.mean(ratios**2)) < 3
    assert is_described(errors, DEFAULT_SETTINGS)
    assert not is_described(replace(errors, expected=None), DEFAULT_SETTINGS)
    assert (
        known.noise.frf_error < known.expected.frf_error < 0.01 * errors.expected.frf_error + 5 * known.noise.frf_error
    )
    assert known.expected.load_error.keys() == known.after.load_error.keys()


def test_the_error_of_the_response_is_that_of_the_true_rig(campaign, identified, errors):
    """The channels' noise is small: what is left is how far the response is off at the harmonics."""
    relative, _ = response_errors(campaign.rig, identified)
    assert errors.after.frf_error < 3 * np.percentile(relative, 95)


def test_a_sweep_has_the_error_of_its_response_alone(campaign, identified):
    run = campaign.runs_of_kind("sweep")[0]
    found = hold_out_errors(run, computed(campaign.geometry), identified)
    fit = identified.quality.runs[run.name]
    assert found.after.frf_error == pytest.approx(fit.frf_error)
    assert found.noise.frf_error == pytest.approx(fit.frf_noise_floor)
    assert found.before.frf_error > 10 * found.after.frf_error
    assert found.after.load_error == found.after.interaction == found.noise.load_error == {}


def test_what_the_noise_leaves_of_a_response_is_what_a_good_fit_leaves(identified):
    """The noise of the loads is part of it: beside a mode it is the larger."""
    sweeps = [run for run in identified.quality.runs.values() if np.isfinite(run.frf_error)]
    assert len(sweeps) == 6
    for run in sweeps:
        assert run.frf_error == pytest.approx(run.frf_noise_floor, rel=0.15)


def test_a_sweep_is_held_to_its_noise_without_what_a_spring_that_hardens_does():
    """In a record that does not repeat the distortion would pass for noise."""
    from balance_cli.simulation import Noise, SweepPlan, simulate_run, true_rig
    from balance_cli.simulation.rig import apply_effects

    geometry = one_degree_of_freedom()
    effect = DeclaredEffect(name="cubic-stiffness", where=("z",), parameters={"k3": 4e10, "side": "beside"})
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(60.0,), excitation="random", period=10.0, periods=2)
    run, _ = simulate_run(apply_effects(true_rig(geometry), [effect]), plan, Noise(), seed=5)
    knowing = computed(geometry.model_copy(update={"effects": (effect,)}))
    found = hold_out_errors(run, computed(geometry), knowing)
    assert found.before.frf_error > 0.1
    assert found.after.frf_error < 0.01
    assert found.after.frf_error < 1.5 * found.noise.frf_error < 3.0 * found.after.frf_error


def test_cross_axis_loads_of_an_exciter_act_too(campaign):
    """The applied loads, with which a reduction is compared, include the exciter cross-axis matrix of the model."""
    from balance_cli.simulation import Noise, short_plan, simulate_run, true_rig
    from balance_cli.simulation.extensions.library import extension
    from balance_cli.simulation.rig import apply_effects

    geometry = rotor_balance()
    (plan,) = (one for one in short_plan().runs if one.kind == "check")
    applied = sorted(plan.harmonics)
    excited, spilt = applied[0], next(name for name in ("Fx", "Fy", "Fz") if name not in applied)
    place = (excited, spilt)
    rig = apply_effects(true_rig(geometry), [extension("exciter-misalignment", place, fraction=0.04)])
    run, _ = simulate_run(rig, plan, Noise().scale_by(0.1), seed=5)
    effect = DeclaredEffect(name="exciter-misalignment", where=place, parameters={"fraction": 0.04})
    knowing = computed(geometry.model_copy(update={"effects": (effect,)}))
    found = hold_out_errors(run, computed(geometry), knowing)
    assert found.before.interaction[spilt] > 0.01
    assert found.after.interaction[spilt] < 0.1 * found.before.interaction[spilt]
    assert found.after.frf_error < 0.1 * found.before.frf_error


@pytest.mark.parametrize("attached", [True, False])
def test_a_check_run_may_be_made_without_the_exciters_of_the_sweeps(attached):
    """A mass that moves across the axis of an exciter, known from the sweeps: the check run has it, or has not."""
    from balance_cli.simulation import Noise, short_plan, simulate_run, true_rig
    from balance_cli.simulation.extensions.library import extension
    from balance_cli.simulation.rig import apply_effects

    geometry = rotor_balance()
    (plan,) = (one for one in short_plan().runs if one.kind == "check")
    place = (sorted(plan.harmonics)[0], "Fx")
    effects = [extension("exciter-mass", place, mass=2.0)] if attached else []
    run, _ = simulate_run(apply_effects(true_rig(geometry), effects), plan, Noise().scale_by(0.1), seed=5)
    effect = DeclaredEffect(name="exciter-mass", where=place, parameters={"mass": 2.0})
    knowing = computed(geometry.model_copy(update={"effects": (effect,)}))
    found = hold_out_errors(run, computed(geometry), knowing)
    assert (found.other_set_up is None) == attached
    assert found.after.frf_error < 3 * found.noise.frf_error
    assert found.before.frf_error > (10 * found.after.frf_error if attached else 0.0)
    notes = judge_hold_out(diagnosis(EXPLAINED), {"check-1": found}).notes
    assert [note for note in notes if "other exciters" in note] == ([] if attached else [f"check-1: {OTHER_EXCITERS}"])


@pytest.mark.parametrize("kind", ["wind", "static"])
def test_runs_without_loads_to_compare_with_are_refused(campaign, identified, kind):
    run = campaign.runs_of_kind(kind)[0]
    with pytest.raises(UserError, match=f"a {kind} run has no known loads") as error:
        hold_out_errors(run, identified, identified)
    assert "check runs" in error.value.remedy
    with pytest.raises(UserError, match="no `loads`"):
        hold_out_errors(replace(campaign.runs_of_kind("check")[0], has_loads=False), identified, identified)


def test_a_dead_channel_is_left_out_of_the_comparison(campaign, identified):
    from tests.support.channels import with_channel

    whole = campaign.runs_of_kind("check")[0]
    found = hold_out_errors(with_channel(whole, "z3.piezo", np.zeros_like), identified, identified)
    assert found.after.frf_error < 5e-3
    assert all(value < 0.02 for value in found.after.load_error.values())


@pytest.mark.parametrize(("kind", "k3"), [("check", 3e14), ("sweep", 3e13)])
def test_the_nonlinear_contribution_is_removed_where_the_model_has_it(kind, k3):
    from balance_cli.simulation import Noise, short_plan, simulate_run, true_rig
    from balance_cli.simulation.extensions.library import extension
    from balance_cli.simulation.rig import apply_effects

    geometry = rotor_balance()
    plan = next(one for one in short_plan().runs if one.kind == kind)
    place = ("x",)
    rig = apply_effects(true_rig(geometry), [extension("cubic-stiffness", place, k3=k3)])
    run, _ = simulate_run(rig, plan, Noise().scale_by(0.1), seed=6)
    effect = DeclaredEffect(name="cubic-stiffness", where=(*place, "inside"), parameters={"k3": k3})
    knowing = computed(geometry.model_copy(update={"effects": (effect,)}))
    found = hold_out_errors(run, computed(geometry), knowing)
    assert found.before.frf_error > 5 * found.after.frf_error


def test_a_rig_that_does_not_oscillate_has_hold_out_errors():
    """Its start transient decays by its slowest real pole."""
    from balance_cli.simulation import Noise, RotorPlan, simulate_run, true_rig

    geometry = one_degree_of_freedom().model_copy(update={"damping_ratio": 1.4})
    plan = RotorPlan(run="check", rotor_speed=8.0, duration=6.0, harmonics={"Fz": (30.0, 10.0, 8.0)})
    run, _ = simulate_run(true_rig(geometry), plan, Noise().scale_by(0.1), seed=5)
    model = computed(geometry)
    found = hold_out_errors(run, model, model)
    assert found.after.load_error["Fz"] < 2e-3
