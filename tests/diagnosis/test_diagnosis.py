"""Diagnosis: score test, model error, cross-validation, and whole diagnoses of simulated campaigns."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.channel_causes import likely_channel_cause
from balance_cli.diagnosis.exclusions import without_channel
from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, PARTLY_EXPLAINED
from balance_cli.diagnosis.search.bounded_gain import best_gain
from balance_cli.diagnosis.search.candidates import candidate_at, candidates, smaller_places
from balance_cli.diagnosis.search.candidates import parameters_of_interest as acting
from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.search.preference import choose_most_linear
from balance_cli.diagnosis.search.rounds import select_leading
from balance_cli.diagnosis.search.score_statistics import Score, score_in_two_stages, scores
from balance_cli.diagnosis.search.search_lines import search_lines
from balance_cli.diagnosis.search.unmodelled_modes import add_unmodelled_modes
from balance_cli.diagnosis.selection import candidate_refits
from balance_cli.diagnosis.selection.alternatives import compare_alternatives
from balance_cli.diagnosis.selection.cross_validation import cross_validation_gain, split_folds
from balance_cli.diagnosis.selection.effect_selection import (
    drop_unsupported_effects,
    prune_effects,
    refit_without_effect,
)
from balance_cli.diagnosis.selection.effect_statistics import confounding_limit, effect_wald_statistic
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines, unexplained_chi2
from balance_cli.diagnosis.selection.mains_frequency import refit_at_best_frequency
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.model_error import add_model_error, estimate_model_error, log_determinant_inflation
from balance_cli.estimation.starting_values import start_from_equations_of_motion
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.effects import EFFECTS
from balance_cli.model.effects.contact import LEAST_FORCE_SHARE, STIFFNESS_BOUNDS
from balance_cli.model.placed_effects import declared_effects
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.other_rigs import other_rig, short_campaign
from tests.support.rigs import one_degree_of_freedom, rotor_balance
from tests.support.unknown_effects import RectifyingChannel, SaturatingChannel, TunedMass

RIG = rotor_balance()
PLAN = CampaignPlan(
    runs=(
        *static_plans(),
        *(
            SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=8)
            for name, level in HIGH_SWEEP_LEVELS.items()
        ),
    )
)


BENDS = RectifyingChannel(where=("z1.piezo",), limit=100.0)


TOGETHER = CampaignPlan(
    runs=(
        *static_plans(),
        *(
            SweepPlan(
                run=f"sweep-{names[0][0]}",
                excited=names,
                level=tuple(HIGH_SWEEP_LEVELS[name] for name in names),
                period=1.0,
                periods=8,
            )
            for names in (COMPONENTS[:3], COMPONENTS[3:])
        ),
    )
)
"""Forces together in one sweep and moments in another, each on lines of its own: a third of the lines to fit."""


def simulated_spectra(*effects, seed=3, plan=PLAN):
    rig = true_rig(RIG)
    for effect in effects:
        rig = apply_effects(rig, [effect]) if isinstance(effect, DeclaredEffect) else rig.with_extensions(effect)
    runs, _ = simulate_campaign(rig, plan, seed=seed)
    return measured_spectra(runs, RIG, means=True)


@pytest.fixture(scope="module")
def healthy():
    return simulated_spectra()


@pytest.fixture(scope="module")
def late():
    """A channel is late by a little: a gain of about a hundred in chi-square."""
    return simulated_spectra(DeclaredEffect(name="time-delay", where=("z1.piezo",), parameters={"delay": 1.5e-6}))


def lines_of(spectra):
    return stack_runs(spectra.lines, spectra.statics, RIG.channel_names)


def lines_and_fit(spectra):
    """The lines and the model without effects fitted to them."""
    batches = lines_of(spectra)
    return batches, fit_all_lines(balance_model(RIG).at(), batches, SETTINGS.fit)


@pytest.fixture(scope="module")
def healthy_fit(healthy):
    return lines_and_fit(healthy)


@pytest.fixture(scope="module")
def late_fit(late):
    return lines_and_fit(late)


# ---- score test ------------------------------------------------------------------------------------------------------


def test_gain_without_bounds_is_that_of_rao():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((4, 4))
    V, s = root @ root.T, rng.standard_normal(4)
    nothing = np.zeros(4, bool)
    gain, used, step = best_gain(s, V, nothing, nothing, SETTINGS.score.min_information_share)
    assert used == 4
    assert gain == pytest.approx(s @ np.linalg.solve(V, s))
    np.testing.assert_allclose(V @ step, s)


def test_gain_with_bounds_is_the_best_that_is_allowed():
    rng = np.random.default_rng(1)
    root = rng.standard_normal((2, 2))
    V, s = root @ root.T + np.eye(2), np.array([-2.0, 1.5])
    grid = np.stack(np.meshgrid(np.linspace(0, 3, 601), np.linspace(-3, 3, 1201), indexing="ij"), axis=-1)
    best = (2 * grid @ s - np.einsum("abi,ij,abj->ab", grid, V, grid)).max()
    gain, _, step = best_gain(s, V, np.array([True, False]), np.zeros(2, bool), SETTINGS.score.min_information_share)
    assert gain == pytest.approx(best, rel=1e-4)
    assert step[0] >= 0.0
    assert 2 * s @ step - step @ V @ step == pytest.approx(gain)
    assert gain < s @ np.linalg.solve(V, s)


@pytest.mark.parametrize("s", [-2.0, 1.5])
@pytest.mark.parametrize("bounds", [(False, False), (True, False), (False, True)])
def test_gain_of_one_parameter_is_that_beside_one_without_information(s, bounds):
    lower, upper = (np.array([bound, False]) for bound in bounds)
    alone = best_gain(np.array([s]), np.array([[4.0]]), lower[:1], upper[:1], SETTINGS.score.min_information_share)
    gain, used, step = best_gain(
        np.array([s, 0.0]), np.diag([4.0, 0.0]), lower, upper, SETTINGS.score.min_information_share
    )
    assert alone.gain == pytest.approx(gain)
    assert (alone.directions, alone.step[0]) == (used, pytest.approx(step[0]))


def test_a_score_is_what_a_refit_gains(late_fit):
    batches, fit = late_fit
    one = candidate_at("time-delay", ("z1.piezo",), RIG)
    (score,) = scores(fit, batches, [one], SETTINGS.score)
    wide = extend_model(fit, add_candidates(RIG, [(one, 0)]))
    gained = fit.chi2 - fit_all_lines(wide, batches, SETTINGS.fit).chi2
    assert score.gain > 50.0
    assert score.gain == pytest.approx(gained, rel=0.02)


def test_the_true_effect_has_the_best_score_and_holds_on_other_lines(late_fit):
    batches, fit = late_fit
    found = score_in_two_stages(fit, batches, candidates(RIG), SETTINGS)
    found = sorted(found, key=lambda score: -score.gain)
    labels = [score.candidate.label for score in found[:2]]
    assert "time-delay@z1.piezo" in labels
    true = next(score for score in found if score.candidate.label == "time-delay@z1.piezo")
    assert cross_validation_gain(fit, batches, true, SETTINGS) > 0.5 * true.gain
    chance = next(score for score in found if 0.0 < score.gain < 0.5)
    assert cross_validation_gain(fit, batches, chance, SETTINGS) < 2.0


def test_a_part_as_stiff_as_can_be_begins_where_it_is(healthy, capfd):
    """At its null a mast has no compliance and no equation of motion, and LAPACK is not asked for one."""
    model, mast = balance_model(RIG), candidate_at("mast-bending", ("x",), RIG)
    null = extend_model(model.at(), add_candidates(RIG, [(mast, 0)]))
    wide = null.model
    found = start_from_equations_of_motion(wide.parameters, lines_of(healthy), wide.system, null.theta)
    np.testing.assert_array_equal(found, null.theta)
    assert capfd.readouterr() == ("", "")


def test_a_search_begins_what_rests_on_a_place_beside_what_leads():
    def scored(name, where, gain):
        candidate = candidate_at(name, where, RIG)
        own = len(acting(candidate.placed_effect.parameters))
        nothing = np.zeros(own)
        return Score(candidate, 0, gain, own, 1.0, np.inf, np.eye(own), nothing, nothing)

    support = ("support-flexibility", ("x", "y", "z", "psi", "theta", "phi"))
    ranked = [
        scored("dry-friction", ("x",), 324.0),
        scored("dry-friction", ("y1",), 300.0),
        scored("transverse-stiffness", ("all",), 218.0),
        scored("structural-damping", ("z1",), 215.0),
        scored("time-delay", ("x.piezo",), 160.0),
        scored(*support, 116.0),
        scored("added-mass", (), 100.0),
    ]
    first = ["dry-friction@x", "transverse-stiffness@all", "structural-damping@z1"]
    labels = [score.candidate.label for score in select_leading(ranked, SETTINGS)]
    assert labels == [*first, "support-flexibility@x,y,z,psi,theta,phi"]
    weak = [*ranked[:5], scored(*support, 30.0)]
    assert [score.candidate.label for score in select_leading(weak, SETTINGS)] == first


def test_folds_are_disjoint_leave_no_line_out_and_have_means_in_several(healthy):
    batches = lines_of(healthy)
    for batch, *parts in zip(batches, *split_folds(batches, SETTINGS.cross_validation), strict=True):
        assert sum(len(part.lines.index) for part in parts) == len(batch.lines.index)
        means = [int(np.sum(part.line_frequency == 0)) for part in parts]
        if np.any(batch.frequency > 0):
            assert sum(means) == len(batch.run_names)
            assert sum(count > 0 for count in means) > len(batch.run_names) // 2


def test_candidates_leave_out_what_the_rig_has():
    have = RIG.model_copy(update={"effects": (DeclaredEffect(name="time-delay", where=("x.piezo",)),)})
    labels = {one.label for one in candidates(have)}
    assert "time-delay@x.piezo" not in labels
    assert "time-delay@x.strain" in labels
    assert not any(label.startswith("extra-mode") for label in labels)
    support = next(one for one in candidates(RIG) if one.effect.name == "support-flexibility")
    assert all(
        len(where) == len(support.placed_effect.where) - 1 for where in smaller_places(support.placed_effect, RIG)
    )
    across = next(one for one in candidates(RIG) if one.label == "exciter-mass@Mz,Fz")
    assert not smaller_places(across.placed_effect, RIG)  # along the moment another mass moves


# ---- model error -----------------------------------------------------------------------------------------------------


def test_no_model_error_where_nothing_is_wrong(healthy_fit):
    batches, fit = healthy_fit
    shares = estimate_model_error(batches, fit.model.system(fit.theta), sigma_limit=3.0)
    assert set(shares.values()) == {0.0}
    assert add_model_error(batches, shares) == batches
    assert log_determinant_inflation(batches, shares) == 0.0


def test_model_error_is_about_as_large_as_what_is_wrong(healthy_fit):
    """All stiffnesses and masses as they are, every sensitivity of what is measured two per cent off by chance."""
    batches, fit = healthy_fit
    theta = fit.theta.copy()
    rng = np.random.default_rng(4)
    for i, name in enumerate(fit.model.parameters.names):
        if name.startswith("sensitivity."):
            theta[i] *= 1.0 + 0.02 * rng.standard_normal()
    shares = estimate_model_error(batches, fit.model.system(theta))
    assert 0.005 < np.median(list(shares.values())) < 0.06


# ---- whole diagnoses -------------------------------------------------------------------------------------------------


def test_nothing_is_missing_where_nothing_is(healthy):
    diagnosis, updated = diagnose(identify(healthy, RIG), healthy)
    assert diagnosis.verdict == NOTHING_MISSING
    assert diagnosis.settings == SETTINGS
    assert not diagnosis.effects
    assert not updated.geometry.effects
    assert diagnosis.chi2_per_dof_after == pytest.approx(1.0, abs=0.05)
    assert "gyroscopic-coupling" in {item.name for item in diagnosis.untestable_effects}
    assert any("one level" in note for note in diagnosis.notes)


def test_two_effects_at_once_are_found_and_the_model_is_closed():
    hidden = (
        DeclaredEffect(name="time-delay", where=("x.piezo",), parameters={"delay": 4e-4}),
        DeclaredEffect(
            name="parallel-stiffness",
            parameters={"x": 0.1, "y": 0.2, "z": 0.15, "stiffness_x": 1e5, "stiffness_y": 1e5, "stiffness_z": 2e5},
        ),
    )
    spectra = simulated_spectra(*hidden, plan=TOGETHER)
    before = identify(spectra, RIG)
    shares = []
    diagnosis, updated = diagnose(before, spectra, progress=lambda what, share: shares.append(share))
    assert diagnosis.verdict == EXPLAINED
    assert {effect.label for effect in diagnosis.effects} == {"time-delay@x.piezo", "parallel-stiffness"}
    delay = next(effect for effect in diagnosis.effects if effect.name == "time-delay").parameters[0]
    assert abs(delay.value - 4e-4) < 4 * delay.sigma
    assert diagnosis.chi2_per_dof_before > 10
    assert updated.quality.chi2_per_dof == pytest.approx(1.0, abs=0.06)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    again, _ = diagnose(updated, spectra)
    assert again.verdict == NOTHING_MISSING


def test_a_misaligned_exciter_is_found_though_weights_hang_straight():
    spectra = simulated_spectra(
        DeclaredEffect(name="exciter-misalignment", where=("Fz", "Fx"), parameters={"fraction": 0.05}), plan=TOGETHER
    )
    found, _ = diagnose(identify(spectra, RIG), spectra)
    assert found.verdict == EXPLAINED
    assert [effect.label for effect in found.effects] == ["exciter-misalignment@Fz,Fx"]
    (fraction,) = found.effects[0].parameters
    assert abs(fraction.value - 0.05) < 4 * fraction.sigma < 0.001


def test_a_strain_channel_that_forgets_is_found_though_it_reads_nothing_at_rest():
    leak = DeclaredEffect(name="high-pass", where=("z1.strain",), parameters={"cutoff": 0.04})
    spectra = simulated_spectra(leak, plan=TOGETHER)
    found, updated = diagnose(identify(spectra, RIG), spectra)
    assert found.verdict == EXPLAINED
    assert [effect.label for effect in found.effects] == ["high-pass@z1.strain"]
    (cutoff,) = found.effects[0].parameters
    assert abs(cutoff.value - 0.04) < 4 * cutoff.sigma
    assert updated.quality.chi2_per_dof < 1.2


# ---- alternatives, and unsupported effects ---------------------------------------------------------------------------


def test_a_better_alternative_replaces_an_effect(late):
    """A crosstalk describes part of a delay. So weak an effect is compared with all candidates."""
    wrong = candidate_at("crosstalk", ("z1.piezo", "x.piezo"), RIG)
    start = extend_model(balance_model(RIG).at(), add_candidates(RIG, [(wrong, 0)]))
    batches = lines_of(late)
    fit = fit_all_lines(start, batches, SETTINGS.fit)
    found = compare_alternatives(fit, SelectionTask(batches, SETTINGS, never_over), {}, 400, 2)
    assert (
        set(found.effect_support) == {"time-delay@z1.piezo"}
        or "time-delay@z1.piezo" in found.effect_support["low-pass@z1.piezo"].equivalent
    )
    assert found.fit.chi2 < fit.chi2 - 50.0
    assert [trial.decision for trial in found.trials] == ["removed", "accepted"]
    assert found.trials[0].label == "crosstalk@z1.piezo,x.piezo"
    (standing,) = found.effect_support.values()
    assert standing.gain > 50.0
    kept = compare_alternatives(
        fit, SelectionTask(batches, SETTINGS, never_over, given_labels=(wrong.label,)), {}, 400, 2
    )
    assert kept.fit is fit
    assert not kept.effect_support


def never_over(what: str) -> bool:
    return False


def test_small_effects_are_dropped_beside_a_large_residual():
    """A channel that bends is in no file of effects; a gain that takes a little off what it leaves is no finding."""
    batches = lines_of(simulated_spectra(BENDS))
    small = candidate_at("channel-gain", ("y2.strain",), RIG)
    start = extend_model(balance_model(RIG).at(), add_candidates(RIG, [(small, 0)]))
    fit = fit_all_lines(start, batches, SETTINGS.fit)
    unexplained = unexplained_chi2(fit, batches, (), SETTINGS.fit)
    assert unexplained > 1e3
    # Of runs whose weights carry a model error all of chi-square is unexplained.
    names = [name for batch in batches for name in batch.run_names]
    one, every = (unexplained_chi2(fit, batches, runs, SETTINGS.fit) for runs in (names[:1], names))
    assert unexplained < one < every == pytest.approx(fit.minimum.data.chi2)
    assert drop_unsupported_effects(fit, SelectionTask(batches, SETTINGS, lambda what: True), 3) == (fit, ()), "no time"
    # What chance explains goes whether or not there is time.
    for announce in (lambda what: True, never_over):
        pruned, removed = prune_effects(fit, SelectionTask(batches, SETTINGS, announce), 400, 3)
        assert [(trial.label, trial.decision) for trial in removed] == [("channel-gain@y2.strain", "removed")]
        assert not pruned.model.geometry.effects
    less, trials = drop_unsupported_effects(fit, SelectionTask(batches, SETTINGS, never_over), 3)
    assert [trial.label for trial in trials] == ["channel-gain@y2.strain"]
    assert not less.model.geometry.effects
    assert drop_unsupported_effects(
        fit, SelectionTask(batches, SETTINGS, never_over, certain_labels=("channel-gain@y2.strain",)), 3
    ) == (fit, ())


STIFF = DeclaredEffect(name="transverse-stiffness", where=("all",), parameters={"stiffness": 2e4})


@pytest.fixture(scope="module")
def stiff():
    """Lines and fit of a campaign with a large mechanical effect."""
    batches = lines_of(simulated_spectra(STIFF, plan=TOGETHER))
    known = candidate_at("transverse-stiffness", ("all",), RIG)
    start = extend_model(balance_model(RIG).at(), add_candidates(RIG, [(known, 0)]))
    return batches, fit_all_lines(start, batches, SETTINGS.fit)


def test_what_a_stiffness_is_worth_does_not_end_at_the_scale_of_the_rig(stiff):
    """The tolerance of the scale, 1.3 %, is the sigma of any stiffness: no gain beyond 5500 could be seen in that."""
    batches, fit = stiff
    (one,) = declared_effects(fit.model.geometry)
    gain, known = effect_wald_statistic(fit, one)
    assert known == 1
    assert gain > 1e5
    assert gain == pytest.approx(refit_without_effect(fit, one, batches, SETTINGS.fit).chi2 - fit.chi2, rel=0.5)


def test_a_large_effect_stays_beside_a_large_residual(stiff, monkeypatch):
    """Whatever Wald makes of it: only chi-square without it lets it go."""
    batches, fit = stiff
    monkeypatch.setattr(
        "balance_cli.diagnosis.selection.effect_selection.effect_wald_statistic", lambda fit, one: (1.0, 1)
    )
    monkeypatch.setattr(
        "balance_cli.diagnosis.selection.effect_selection.unexplained_chi2", lambda fit, batches, runs, settings: 1e5
    )
    assert drop_unsupported_effects(fit, SelectionTask(batches, SETTINGS, never_over), 3) == (fit, ())


def test_fits_that_come_to_no_end_are_tried_with_the_shape_held_at_first(stiff, monkeypatch):
    batches, _ = stiff
    plain = fit_all_lines(balance_model(RIG).at(), batches, SETTINGS.fit)
    path = candidate_at("parallel-stiffness", (), RIG)
    (score,) = scores(plain, batches, [path], SETTINGS.score)
    assert score.gain > SETTINGS.selection.strong_gain
    ends = []

    def creeping(start, batches, settings):
        """The first two fits stop far above a minimum."""
        minimum = fit_all_lines(start, batches, SETTINGS.fit).minimum
        early = len(ends) < 2
        total = replace(minimum.total, chi2=minimum.total.chi2 + 1e6 * early)
        ends.append(Fit.at_minimum(start.model, replace(minimum, total=total, converged=not early)))
        return ends[-1]

    monkeypatch.setattr(candidate_refits, "fit_all_lines", creeping)
    monkeypatch.setattr(candidate_refits, "continue_fit", creeping)
    found = candidate_refits.refit_with_candidate(plain, score, batches, None, SETTINGS)
    assert len(ends) == 4
    assert found is ends[3]
    shape = {path.placed_effect.full_name(item) for item in path.placed_effect.parameters if item.nuisance}
    held, still = (
        {name for name, free in zip(end.model.parameters.names, end.model.parameters.free, strict=True) if not free}
        for end in (ends[2], found)
    )
    assert held - still == shape


def test_frequency_of_the_mains_is_found_from_a_side_lobe():
    hidden = {"amplitude": 2e-3, "frequency": 50.02}
    batches = lines_of(simulated_spectra(DeclaredEffect(name="mains-pickup", where=("y2.strain",), parameters=hidden)))
    beside = DeclaredEffect(
        name="mains-pickup", where=("y2.strain",), parameters={"amplitude": 1e-3, "frequency": 50.2}
    )
    model = balance_model(RIG.model_copy(update={"effects": (beside,)}))
    stuck = fit_all_lines(model.at(), batches, SETTINGS.fit)
    found = refit_at_best_frequency(stuck, declared_effects(model.geometry), batches, SETTINGS)
    place = model.parameters.index("mains-pickup@y2.strain.frequency")
    assert abs(stuck.theta[place] - 50.02) > 0.1
    # The side lobes are 0.2 Hz apart: which of them is the question here.
    assert found.theta[place] == pytest.approx(50.02, abs=1e-2)
    assert found.chi2 < stuck.chi2 - 100.0
    assert refit_at_best_frequency(found, declared_effects(model.geometry), batches, SETTINGS) is found
    sigma = np.array(model.parameters.sigma)
    sigma[place] = 0.0
    held = fit_all_lines(model.with_sigma(sigma).at(), batches, SETTINGS.fit)
    assert refit_at_best_frequency(held, declared_effects(model.geometry), batches, SETTINGS) is held


def test_mains_are_scored_on_their_lines_however_few_are_screened_and_found_when_given_by_hand():
    hidden = {"amplitude": 4e-3, "frequency": 60.03}
    spectra = simulated_spectra(DeclaredEffect(name="mains-pickup", where=("z3.piezo",), parameters=hidden))
    batches, model = lines_of(spectra), balance_model(RIG)
    few = replace(SETTINGS, score=replace(SETTINGS.score, screening_lines=100, full_score_candidates=4))
    pool = [one for one in candidates(RIG) if one.effect.name in ("mains-pickup", "channel-gain")]
    found = max(score_in_two_stages(model.at(), batches, pool, few), key=lambda score: score.gain)
    assert found.candidate.label == "mains-pickup@z3.piezo"
    assert found.candidate.starts[found.start] == {"frequency": 60.0}
    beside = DeclaredEffect(
        name="mains-pickup", where=("z3.piezo",), parameters={"amplitude": 1e-3, "frequency": 60.27}
    )
    identified = identify(spectra, RIG.model_copy(update={"effects": (beside,)}))
    place = identified.parameters.names.index("mains-pickup@z3.piezo.frequency")
    assert identified.parameters.value[place] == pytest.approx(60.03, abs=5e-3)


def test_beside_large_friction_small_effects_are_confounded(stiff):
    batches, fit = stiff
    assert confounding_limit(fit, batches) == (0.0, "")
    friction = candidate_at("dry-friction", ("z1",), RIG)
    start = extend_model(fit, add_candidates(fit.geometry, [(friction, 0)], at_start_values=True))
    beside = fit_all_lines(start, batches, SETTINGS.fit)
    (worth,) = (
        effect_wald_statistic(beside, one) for one in declared_effects(start.geometry) if one.label == friction.label
    )
    assert confounding_limit(beside, batches) == (pytest.approx(1e-4 * worth[0]), friction.label)


SEVERAL_STARTS = ("added-mass", "support-flexibility", "mast-bending", "parallel-stiffness")
"""Effects whose fits take most of the time of a search, and which act on the rig rather than on a channel."""


@pytest.fixture(scope="module")
def saturating():
    """Six cells, with which a search is quickest, and the spectra of a campaign in which a channel saturates at 5 V."""
    rig, plan = other_rig("A"), short_campaign("A", sweeps=30.0)
    plan = plan.select_runs([run.run for run in plan.runs if run.kind in ("static", "sweep")])
    truth = true_rig(rig).with_extensions(SaturatingChannel(where=("l2.piezo",), limit=5.0))
    return rig, measured_spectra(simulate_campaign(truth, plan, seed=3)[0], rig, means=True)


def test_a_channel_that_saturates_is_named_with_its_largest_reading(saturating):
    rig, spectra = saturating
    found, _ = diagnose(identify(spectra, rig), spectra, settings=replace(SETTINGS, excluded=SEVERAL_STARTS))
    (effect,) = found.effects
    assert (found.verdict, effect.label) == (EXPLAINED, "saturation@l2.piezo")
    (compression,) = effect.parameters
    assert abs(compression.value - 5.0**-2) < 4 * compression.sigma


@pytest.mark.parametrize(("excluded", "cause"), [((), "saturation@l2.piezo"), (("saturation",), "")])
def test_the_cause_in_a_channel_is_seen_beside_all_other_data(saturating, excluded, cause):
    rig, spectra = saturating
    rest = identify(without_channel(spectra, "l2.piezo", rig), rig)
    estimate = balance_model(rig).at(np.array(rest.parameters.value))
    batches, settings = (
        stack_runs(spectra.lines, spectra.statics, rig.channel_names),
        replace(SETTINGS, excluded=excluded),
    )
    assert likely_channel_cause(estimate, "l2.piezo", batches, lambda step: False, settings) == cause


def test_a_channel_that_no_effect_describes_is_left_out():
    spectra = simulated_spectra(BENDS, plan=TOGETHER)
    before = identify(spectra, RIG)
    excluded = tuple(item.name for item in EFFECTS if item.name not in ("channel-gain", "time-delay"))
    found, updated = diagnose(before, spectra, settings=replace(SETTINGS, excluded=excluded))
    assert found.verdict == PARTLY_EXPLAINED
    assert not found.effects
    assert (found.left_out.kind, found.left_out.name) == ("channel", "z1.piezo")
    assert found.left_out.chi2_per_dof == pytest.approx(1.0, abs=0.1)
    assert found.left_out.likely_cause == ""
    assert found.location == ""
    assert found.chi2_per_dof_after < 1.1 < found.chi2_per_dof_before
    assert not updated.geometry.effects


TUNED = TunedMass(mass=0.7, frequency=51.3, damping_ratio=0.013, position=(-0.2, 0.15, 0.02), direction=(0.8, 0, 0.6))


@pytest.fixture(scope="module")
def resonating():
    return simulated_spectra(TUNED, plan=TOGETHER)


def test_what_resonates_without_a_cause_is_described_and_named_as_empirical(resonating):
    spectra = resonating
    found, updated = diagnose(identify(spectra, RIG), spectra)
    assert found.verdict == PARTLY_EXPLAINED
    (effect,) = found.effects
    assert effect.label == "extra-mode@x"
    assert effect.evidence.empirical
    values = {item.name: item for item in effect.parameters}
    assert abs(values["frequency"].value - 51.3) < 4 * values["frequency"].sigma < 0.05
    assert abs(values["damping_ratio"].value - 0.013) < 4 * values["damping_ratio"].sigma
    assert values["mass"].value == pytest.approx(0.7 * 0.8**2, rel=0.05)
    assert values["shape_z"].value == pytest.approx(0.75, abs=0.02)
    assert found.chi2_per_dof_before > 100.0
    assert updated.quality.chi2_per_dof == pytest.approx(1.0, abs=0.06)


def with_and_without(label, spectra):
    """Labels of the effects after unmodelled modes are added with and without an effect, and the labels removed."""
    known = candidate_at(label.partition("@")[0], tuple(label.partition("@")[2].split(",")), RIG)
    bare = balance_model(RIG).at()
    extended = extend_model(bare, add_candidates(RIG, [(known, 0)], at_start_values=True))
    state, trials = add_unmodelled_modes(
        [extended, bare], search_lines(spectra, RIG.channel_names, SETTINGS.fit), 1, lambda _: False, SETTINGS
    )
    removed = [trial.label for trial in trials if trial.decision == "removed"]
    return {one.label for one in declared_effects(state.geometry)}, removed


def test_a_resonance_taken_for_a_support_replaces_it(resonating):
    wrong = "support-flexibility@y,theta,phi"
    assert with_and_without(wrong, resonating) == ({"extra-mode@x"}, [wrong])


def test_an_effect_that_is_there_stays_beside_a_resonance():
    there = "transverse-stiffness@all"
    assert with_and_without(there, simulated_spectra(TUNED, STIFF, plan=TOGETHER)) == ({"extra-mode@x", there}, [])


def test_what_it_cannot_work_with(healthy):
    model = identify(healthy, RIG, IdentifyOptions(method="computed"))
    with pytest.raises(UserError, match="no sweep run"):
        diagnose(model, measured_spectra([], RIG))


# ---- one cell --------------------------------------------------------------------------------------------------------

ONE = one_degree_of_freedom()
CUBIC = DeclaredEffect(name="cubic-stiffness", where=("z",), parameters={"k3": 4e10, "side": "beside"})
QUADRATIC = DeclaredEffect(name="quadratic-stiffness", where=("z",), parameters={"k2": 4e6, "side": "beside"})
OFFSET = DeclaredEffect(name="load-offset", where=("Fz",), parameters={"offset": 5.0})


def one_cell(*effects):
    """The diagnosis of a rig with one cell and one freedom by one sweep: no static run, no torque, no other level."""
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(60.0,), period=4.0, periods=6)
    runs, _ = simulate_campaign(apply_effects(true_rig(ONE), effects), CampaignPlan(runs=(plan,)), seed=5)
    model = identify(measured_spectra(runs, ONE), ONE)
    return diagnose(model, measured_spectra(runs, ONE, means=True))


ONE_CELL = {
    "nothing": ((), set()),
    "cubic": ((CUBIC,), {"cubic-stiffness@z,beside"}),
    "cubic and offset": ((CUBIC, OFFSET), {"cubic-stiffness@z,beside", "load-offset@Fz"}),
    "cubic and quadratic": ((CUBIC, QUADRATIC), {"cubic-stiffness@z,beside", "quadratic-stiffness@z,beside"}),
}


@cache
def diagnose_case(case):
    """The diagnosis of a case of ONE_CELL, made once for all tests."""
    return one_cell(*ONE_CELL[case][0])


@pytest.mark.parametrize("case", ONE_CELL)
def test_effects_of_a_rig_with_one_cell_are_found(case):
    (effects, labels), (found, updated) = ONE_CELL[case], diagnose_case(case)
    assert found.verdict == (EXPLAINED if effects else NOTHING_MISSING)
    assert {effect.label for effect in found.effects} == labels
    assert updated.quality.chi2_per_dof < 1.2
    truth = {item.name: [value for value in item.parameters.values() if isinstance(value, float)] for item in effects}
    for effect in found.effects:
        assert effect.choice == (None if effect.name == "load-offset" else ("side", "beside"))
        (item,) = effect.parameters
        assert abs(item.value - truth[effect.name][0]) < 4 * item.sigma


def test_what_has_no_place_in_a_rig_is_not_testable_and_what_was_found_is_not_listed():
    found, _ = diagnose_case("cubic and offset")
    why = {item.name: item.reason for item in found.untestable_effects}
    assert why["crosstalk"] == "a rig with 1 cell, 1 channel that moves in z has no place for it"
    assert not {"load-offset", "cubic-stiffness"} & set(why)
    assert "the fitted parameters" in why["exciter-misalignment"]
    assert "added-mass" in why


def test_of_two_that_do_the_same_the_linear_one_is_preferred():
    assert choose_most_linear([1, 0], [717.6, 715.4], SETTINGS.indistinguishable_chi2) == 1
    assert choose_most_linear([1, 0], [722.0, 715.4], SETTINGS.indistinguishable_chi2) == 0
    assert choose_most_linear([0, 1, 0], [700.0, 690.0, 701.0], SETTINGS.indistinguishable_chi2) == 2


@pytest.mark.parametrize(
    ("force", "stiffness", "share"),
    [(0.3, 3e5, 0.5), (6.0, 3e4, 0.02), (15.0, 2e5, 0.02)],
    ids=["slips", "both", "sticks"],
)
def test_friction_is_found_at_once_whether_it_slips_or_sticks(force, stiffness, share):
    values = {"force": force, "stick_stiffness": stiffness}
    found, _ = one_cell(DeclaredEffect(name="dry-friction", where=("z",), parameters=values))
    assert [(effect.label, effect.evidence.round) for effect in found.effects] == [("dry-friction@z", 1)]
    fitted_values = {item.name: item.value for item in found.effects[0].parameters}
    assert fitted_values["force"] == pytest.approx(force, rel=0.01)
    # A contact that mostly slips contains little information on its stiffness.
    assert fitted_values["stick_stiffness"] == pytest.approx(stiffness, rel=share)
    assert found.chi2_per_dof_after < 0.03 * found.chi2_per_dof_before


def test_a_search_begins_friction_with_the_slip_distance_that_it_scored():
    candidate = candidate_at("dry-friction", ("z",), ONE).extra_starts(ONE)
    assert len(candidate.starts) > 5
    stiffness = ONE.cells[0].effective_stiffness
    slips = []
    for number, start in enumerate(candidate.starts):
        values = candidate.start_from_score(ONE, number, [2.0])
        slips.append(values["force"] / values["stick_stiffness"])
        held = candidate.at_null(start).parameters["stick_stiffness"]
        assert slips[-1] == pytest.approx(LEAST_FORCE_SHARE * ONE.cells[0].full_range / held) or (
            values["stick_stiffness"] == pytest.approx(STIFFNESS_BOUNDS[1] * stiffness)
        )
    assert slips == sorted(slips)
