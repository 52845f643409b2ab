"""One cause in a group of channels: offered, begun from the channels alone, preferred to many, and testable by name."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.channel_groups import channel_groups
from balance_cli.campaign.rig.geometry import Acquisition, DeclaredEffect
from balance_cli.campaign.rig.geometry_checks import geometry_faults
from balance_cli.diagnosis.exclusions import without_channel, without_run
from balance_cli.diagnosis.search.candidates import candidates, check_exclusion, suspected_candidates
from balance_cli.diagnosis.search.initial_candidates import initial_candidates
from balance_cli.diagnosis.selection.common_causes import merge_common_causes
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.selection.hypotheses import examine_hypotheses
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import declared_effects
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.waveforms import LEAST_FILTER_GAIN
from balance_cli.simulation import CampaignPlan, StaticPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.simulation.rig import apply_effects
from tests.support.other_rigs import other_rig
from tests.support.rigs import one_degree_of_freedom, rotor_balance

RIG = rotor_balance()
STRAIN, PIEZO = channel_groups(RIG)["strain"], channel_groups(RIG)["piezo"]
DELAY = 1.36e-4


def spectra_of(*effects):
    rig = apply_effects(true_rig(RIG), effects)
    sweeps = (
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(HIGH_SWEEP_LEVELS[name],), period=1.0, periods=8)
        for name in ("Fx", "Fz", "Mz")
    )
    runs, _ = simulate_campaign(rig, CampaignPlan(runs=(*static_plans(), *sweeps)), seed=3)
    return measured_spectra(runs, RIG, means=True)


def effect(name, where, **parameters):
    return DeclaredEffect(name=name, where=(where,), parameters=parameters)


@pytest.fixture(scope="module")
def late():
    """One box that records every piezo channel late."""
    return spectra_of(effect("time-delay", "piezo", delay=DELAY))


def fit_with(spectra, *effects):
    geometry = RIG.model_copy(update={"effects": effects})
    model, batches = balance_model(geometry), stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    return fit_all_lines(model.at(), batches, SETTINGS.fit), batches


def labels(geometry):
    return {item.label for item in declared_effects(geometry)}


def test_groups_are_those_declared_and_those_that_most_rigs_have():
    groups = channel_groups(RIG)
    assert list(groups) == ["strain", "piezo", "all"]
    assert "torque" not in groups["strain"] and "torque" in groups["all"]
    acquisition = Acquisition(groups={"slow": groups["strain"], "box": ("x.piezo", "z1.strain"), "one": ("torque",)})
    declared = channel_groups(RIG.model_copy(update={"acquisition": acquisition}))
    assert list(declared) == ["slow", "box", "piezo", "all"]


def test_a_group_of_unknown_channels_is_refused():
    acquisition = Acquisition(groups={"box": ("x.piezo", "x.pieso"), "z1": ("x.piezo",)})
    faults = [str(fault) for fault in geometry_faults(RIG.model_copy(update={"acquisition": acquisition}))]
    assert len(faults) == 2
    assert "acquisition.groups.box" in faults[0] and "x.pieso" in faults[0]
    assert "acquisition.groups.z1" in faults[1]


@pytest.mark.parametrize("letter", ["A", "B", "C", "E"])
def test_every_rig_has_groups_among_its_candidates(letter):
    rig = other_rig(letter)
    places = {item.placed_effect.where for item in candidates(rig) if item.effect.name == "time-delay"}
    assert places == {(name,) for name in (*rig.channel_names, *channel_groups(rig))}


def test_a_gain_of_all_cells_is_no_candidate():
    """It is one of the declared masses and stiffnesses."""
    places = {item.placed_effect.where for item in candidates(RIG) if item.effect.name == "channel-gain"}
    assert places == {(name,) for name in (*RIG.channel_names, "strain", "piezo")}
    strain = RIG.model_copy(update={"channels": tuple(c for c in RIG.channels if c.measures_dc)})
    places = {item.placed_effect.where for item in candidates(strain) if item.effect.name == "channel-gain"}
    assert places == {(name,) for name in strain.channel_names}


def test_one_late_box_is_one_cause(late):
    (common,) = initial_candidates(late.lines, RIG, SETTINGS)
    starts = {item.label: item.starts[0]["delay"] for item in common.candidates}
    assert starts == pytest.approx({"time-delay@piezo": DELAY, "time-delay@strain": -DELAY}, rel=0.01)


def test_a_channel_that_differs_is_a_cause_of_its_own():
    each = [effect("time-delay", name, delay=DELAY * (3.0 if name == "z1.piezo" else 1.0)) for name in PIEZO]
    found = initial_candidates(spectra_of(*each).lines, RIG, SETTINGS)
    places = {item.placed_effect.where[0] for each in found for item in each.candidates}
    assert "piezo" not in places and places >= set(PIEZO) - {"y2.piezo"}


def test_delays_of_all_channels_become_that_of_their_group(late):
    fit, batches = fit_with(late, *(effect("time-delay", name, delay=DELAY) for name in PIEZO))
    merged, trials = merge_common_causes(fit, SelectionTask(batches, SETTINGS, lambda _: False), 5)
    assert labels(merged.model.geometry) == {"time-delay@piezo"}
    assert merged.theta[merged.model.parameters.index("time-delay@piezo.delay")] == pytest.approx(DELAY, rel=0.01)
    assert [trial.decision for trial in trials] == ["removed"] * len(PIEZO) + ["accepted"]
    assert merged.chi2 - fit.chi2 < 30.0
    given, none = merge_common_causes(
        fit, SelectionTask(batches, SETTINGS, lambda _: False, given_labels=labels(fit.model.geometry)), 5
    )
    assert given is fit and none == ()


def test_low_passes_of_all_exciters_become_one():
    """Six exciters that follow their commands alike are one cause."""
    spectra = spectra_of(effect("exciter-low-pass", "all", cutoff=200.0, natural_period=4e-3))
    each = [
        effect("exciter-low-pass", name, cutoff=200.0, natural_period=4e-3) for name in ("Fx", "Fy", "Fz", "Mx", "Mz")
    ]
    fit, batches = fit_with(spectra, *each)
    merged, _ = merge_common_causes(fit, SelectionTask(batches, SETTINGS, lambda _: False), 5)
    assert labels(merged.model.geometry) == {"exciter-low-pass@all"}


def test_bridges_that_curve_are_one_cause_with_a_coefficient_each():
    """Nothing is saved by their group in place of them: each of them keeps its own coefficient."""
    curvature = {f"quadratic_{name}": (-1) ** i * 0.03 for i, name in enumerate(STRAIN)}
    spectra = spectra_of(effect("channel-nonlinearity", "strain", **curvature))
    fit, batches = fit_with(spectra, effect("channel-nonlinearity", "strain"))
    found = dict(zip(fit.model.parameters.names, fit.theta, strict=True))
    for name, value in curvature.items():
        assert found[f"channel-nonlinearity@strain.{name}"] == pytest.approx(value, abs=0.003)
    each = [effect("channel-nonlinearity", name, quadratic=curvature[f"quadratic_{name}"]) for name in STRAIN]
    single, batches = fit_with(spectra, *each)
    assert single.chi2 == pytest.approx(fit.chi2, abs=1.0)
    assert merge_common_causes(single, SelectionTask(batches, SETTINGS, lambda _: False), 5) == (single, ())
    places = {item.placed_effect.where for item in candidates(RIG) if item.effect.name == "channel-nonlinearity"}
    assert places == {(name,) for name in (*RIG.channel_names, "strain", "piezo")}


def test_gains_that_differ_stay_as_many():
    gains = np.linspace(1.01, 1.03, len(PIEZO))
    each = [effect("channel-gain", name, gain=float(gain)) for name, gain in zip(PIEZO, gains, strict=True)]
    fit, batches = fit_with(spectra_of(*each), *each)
    assert merge_common_causes(fit, SelectionTask(batches, SETTINGS, lambda _: False), 5) == (fit, ())


def test_a_suspect_is_tested_and_kept_only_where_it_is_significant(late):
    fit, batches = fit_with(late)
    words = ("time-delay@piezo", "channel-offset@x.strain")
    result = examine_hypotheses(fit, batches, 7, replace(SETTINGS, suspected=words))
    assert labels(result.fit.model.geometry) == {"time-delay@piezo"} == set(result.support)
    assert [trial.label for trial in result.trials] == list(words)
    assert [trial.decision for trial in result.trials] == ["accepted", "rejected"]
    assert result.support["time-delay@piezo"].candidates == 1


def test_words_of_the_user_name_effects_and_places():
    assert [item.label for item in suspected_candidates("time-delay@piezo", RIG)] == ["time-delay@piezo"]
    assert len(suspected_candidates("dry-friction", RIG)) == len(RIG.cells)
    check_exclusion("crosstalk@x.strain", RIG)
    check_exclusion("support-flexibility", RIG)
    for word in ("crosstalk@nowhere", "no-effect", "time-delay@z9"):
        with pytest.raises(UserError):
            check_exclusion(word, RIG)
        with pytest.raises(UserError):
            suspected_candidates(word, RIG)


def test_a_cell_keeps_its_force_without_one_of_its_channels(late):
    rest = without_channel(late, "x.piezo", RIG)
    for run, less in zip(late.lines, rest.lines, strict=True):
        assert less.channel_names == tuple(name for name in run.channel_names if name != "x.piezo")
        assert less.covariance.shape[1] == run.covariance.shape[1] - 1 == less.window.covariance.shape[1]
        passed = np.abs(anti_alias_response(RIG.acquisition, run.waveform.frequency)) >= LEAST_FILTER_GAIN
        assert passed[0] and not passed[-1]
        np.testing.assert_allclose(less.waveform.share[:, less.channel_names.index("x.strain")], passed)
        others = less.channel_names.index("z1.strain"), run.channel_names.index("z1.strain")
        np.testing.assert_array_equal(less.waveform.share[:, others[0]], run.waveform.share[:, others[1]])
    assert "x.piezo" not in rest.statics[0].channel_names
    assert set(rest.channels_left_out) == {run.run for run in (*late.lines, *late.statics)}
    assert [run.run for run in without_run(late, "sweep-Fx").lines] == ["sweep-Fz", "sweep-Mz"]


def test_a_run_that_recorded_one_channel_alone_goes_with_it():
    """A static run has strain channels only: where the rig has one of them, it records nothing without it."""
    channels = [
        {"name": "z.strain", "cell": "z", "sensitivity": 0.01},
        {"name": "z.piezo", "cell": "z", "sensitivity": 0.05, "time_constant": 3.0},
    ]
    rig = one_degree_of_freedom(channels=channels)
    plans = (
        StaticPlan(run="static", largest={"Fz": 300.0}),
        SweepPlan(run="sweep", excited=("Fz",), level=(60.0,), period=1.0, periods=8),
    )
    spectra = measured_spectra(simulate_campaign(true_rig(rig), CampaignPlan(runs=plans), seed=3)[0], rig, means=True)
    assert len(spectra.statics) == 1
    rest = without_channel(spectra, "z.strain", rig)
    assert not rest.statics
    (batch, *_) = stack_runs(rest.lines, rest.statics, rig.channel_names)
    assert batch.run_names == ("sweep",)
    assert without_channel(spectra, "z.piezo", rig).statics[0].channel_names == ("z.strain",)
