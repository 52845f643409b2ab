"""Free simulation of updated models, runs that are kept aside, and the verdict that rests on them."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.conclusions import is_described, judge_hold_out
from balance_cli.diagnosis.result import (
    CONTRADICTED,
    EXPLAINED,
    NOTHING_MISSING,
    PARTLY_EXPLAINED,
    UNEXPLAINED,
    HoldOut,
    RunErrors,
)
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.free_simulation import (
    SimulationTask,
    diagnose_with_free_simulation,
    nonlinear_effects,
    simulation_error,
)
from balance_cli.steps.hold_out import choose_hold_out, hold_out_errors
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.diagnosis_content import delay_effect, diagnosis
from tests.support.rigs import one_degree_of_freedom

ONE = one_degree_of_freedom()
LIMITS = replace(DEFAULT_SETTINGS.free_simulation, max_samples=2000)
SETTINGS = replace(DEFAULT_SETTINGS, free_simulation=LIMITS)


def cubic(k3, side="beside"):
    return DeclaredEffect(name="cubic-stiffness", where=("z",), parameters={"k3": k3, "side": side})


def knowing(*effects):
    """The model as declared, with these effects."""
    geometry = ONE.model_copy(update={"effects": effects})
    return identify(measured_spectra([], geometry), geometry, IdentifyOptions(method="computed"))


@pytest.fixture(scope="module")
def runs():
    """A sweep and another one at a lower level of a rig whose spring hardens."""
    plans = (
        SweepPlan(run="high", excited=("Fz",), level=(60.0,), period=2.0, periods=4),
        SweepPlan(run="low", excited=("Fz",), level=(30.0,), period=2.0, periods=4),
    )
    return simulate_campaign(apply_effects(true_rig(ONE), (cubic(4e10),)), CampaignPlan(runs=plans), seed=5).runs


def test_nonlinear_effects_are_told_where_others_are_physical_only_together():
    plate = sum(body.mass for body in ONE.bodies)
    negative = DeclaredEffect(name="added-mass", parameters={"mass": -2.0 * plate})
    model = replace(knowing(), geometry=ONE.model_copy(update={"effects": (negative, cubic(4e10))}))
    with pytest.raises(np.linalg.LinAlgError):
        balance_model(ONE.model_copy(update={"effects": (negative,)})).system()
    assert nonlinear_effects(model) == ("cubic-stiffness@z",)


def test_the_true_model_follows_from_the_loads_alone_and_the_linear_one_does_not(runs):
    assert simulation_error(runs[0], knowing(), LIMITS) > 0.1
    assert simulation_error(runs[0], knowing(cubic(4e10)), LIMITS) < 0.01


def test_an_effect_that_the_simulation_lacks_gives_no_error(runs):
    mode = DeclaredEffect(name="extra-mode", where=("z",), parameters={"frequency": 90.0, "mass": 1.0})
    assert np.isnan(simulation_error(runs[0], knowing(mode), LIMITS))


def test_a_spring_that_softens_until_it_is_none_diverges(runs):
    assert simulation_error(runs[0], knowing(cubic(-1e13)), LIMITS) == float("inf")


def found(effect):
    return replace(delay_effect(), name=effect.name, where=effect.where)


@pytest.mark.parametrize(("k3", "rejected"), [(4e10, False), (-4e11, True)])
def test_a_nonlinear_effect_that_makes_a_free_simulation_worse_is_rejected(runs, k3, rejected):
    """The engine finds it wherever it may: beside the cell, then nowhere."""
    spectra = measured_spectra(runs[:1], ONE, means=True)
    asked = []

    def diagnose(model, spectra, settings):
        asked.append(settings.excluded)
        effects = () if any(word.startswith("cubic-stiffness") for word in settings.excluded) else (cubic(k3),)
        made = diagnosis(effects=tuple(found(item) for item in effects))
        return made, knowing(*effects) if effects else model

    task = SimulationTask(knowing(), spectra, runs[:1], runs[1:])
    made, updated = diagnose_with_free_simulation(task, diagnose, SETTINGS)
    removed = [trial.label for trial in made.trials if "simulation by the loads alone" in trial.reason]
    assert removed == (["cubic-stiffness@z"] if rejected else [])
    assert asked == ([(), ("cubic-stiffness@z",)] if rejected else [()])
    assert bool(updated.geometry.effects) != rejected


def test_a_force_inside_a_cell_cannot_be_most_of_its_reading(runs):
    """With a large enough one the reading would explain itself, whatever it is."""
    spectra = measured_spectra(runs[:1], ONE, means=True)
    batches = stack_runs(spectra.lines, (), ONE.channel_names)

    def chi2(k3):
        model = balance_model(ONE.model_copy(update={"effects": (cubic(k3, "inside"),)}))
        return data_chi2(batches, model.system())

    assert np.isfinite(chi2(1e10))
    with pytest.raises(np.linalg.LinAlgError, match="most of its reading"):
        chi2(1e20)


def test_an_effect_without_a_physical_start_is_refused_by_its_name(runs):
    impossible = ONE.model_copy(update={"effects": (cubic(-1e13, "inside"),)})
    with pytest.raises(UserError, match="no start with `cubic-stiffness@z,inside` is physical"):
        identify(measured_spectra(runs[:1], impossible), impossible)


def test_a_nonlinear_force_that_is_most_of_what_its_cell_reads_describes_nothing(runs):
    errors = hold_out_errors(runs[0], knowing(), knowing(cubic(1e22, "inside")))
    assert errors.after.frf_error == 1.0 > errors.before.frf_error
    assert not is_described(errors, SETTINGS)


# ---- runs kept aside, and the verdict --------------------------------------------------------------------------------


def test_the_least_level_of_a_repeated_sweep_is_kept_aside_unless_there_are_check_runs(runs):
    high, low = runs
    other = replace(high, name="other", excited=("Fx",))
    check = replace(high, name="check", kind="check")
    assert choose_hold_out([high, other]) == ()
    assert choose_hold_out([high, low, other]) == (low,)
    assert choose_hold_out([high, low, other, check]) == (check,)
    assert choose_hold_out([high, replace(low, rotor_speed=10.0)]) == ()


@pytest.mark.parametrize(
    ("before", "after", "noise", "worse"),
    [(0.3, 0.01, 0.01, False), (0.3, 0.6, 0.01, True), (0.01, 0.012, 0.011, False), (0.03, 0.031, 0.01, False)],
    ids=["better", "worse", "described", "as it was"],
)
def test_a_model_that_is_worse_on_runs_left_out_is_contradicted(before, after, noise, worse):
    response = HoldOut(*(RunErrors({}, {}, error) for error in (before, after, noise)))
    loads = HoldOut(
        *(RunErrors({"Fx": error, "Fz": error}, {"Fy": 9.0}, float("nan")) for error in (before, after, noise))
    )
    for errors in (response, loads):
        made = judge_hold_out(diagnosis(), {"check-1": errors})
        assert made.verdict == (CONTRADICTED if worse else EXPLAINED)
        assert made.hold_out == {"check-1": errors}
        assert any("check-1" in note for note in made.notes) == worse
        # What was not accepted cannot be contradicted, but a run may show that something is missing.
        nothing = diagnosis(NOTHING_MISSING, effects=())
        assert judge_hold_out(nothing, {"check-1": errors}).verdict == (UNEXPLAINED if worse else NOTHING_MISSING)


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [(0.05, 1e-4, EXPLAINED), (0.001, 1e-4, NOTHING_MISSING), (0.003, 0.0018, NOTHING_MISSING)],
    ids=["needed", "a small error", "as it was"],
)
def test_effects_that_a_check_run_needs_are_of_consequence(before, after, verdict):
    """Whatever they are worth by the levels of the sweeps."""
    errors = HoldOut(*(RunErrors({"My": error, "Fx": 0.0}, {}, 1e-4) for error in (before, after, 1e-4)))
    made = judge_hold_out(diagnosis(NOTHING_MISSING), {"check-1": errors})
    assert made.verdict == verdict
    assert any("these matter" in note for note in made.notes) == (verdict == EXPLAINED)


def test_a_run_that_the_model_does_not_describe_shows_that_something_is_missing():
    errors = HoldOut(*(RunErrors({}, {}, error) for error in (0.301, 0.3, 0.01)))
    for verdict, effects, expected in (
        (NOTHING_MISSING, {"effects": ()}, UNEXPLAINED),
        (EXPLAINED, {}, PARTLY_EXPLAINED),
        (PARTLY_EXPLAINED, {}, PARTLY_EXPLAINED),
    ):
        made = judge_hold_out(diagnosis(verdict, **effects), {"check-1": errors})
        assert made.verdict == expected
        assert any("check-1 is not described" in note for note in made.notes) == (verdict != PARTLY_EXPLAINED)
    small = HoldOut(*(RunErrors({}, {}, error) for error in (0.0015, 0.0015, 1e-5)))
    assert judge_hold_out(diagnosis(), {"check-1": small}).verdict == EXPLAINED


def test_runs_kept_aside_are_named():
    assert "sweep-low kept aside" in judge_hold_out(diagnosis(), {}, ["sweep-low"]).notes[-1]
