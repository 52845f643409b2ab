"""What a plan predicts, against what identification and score tests of simulated campaigns achieve."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.cli.plan_text import plan_file_text, plan_text
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.score_statistics import scores
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.effects import EFFECTS as EFFECTS_OF_LIBRARY
from balance_cli.planning.candidate_runs import candidate_runs, number_runs
from balance_cli.planning.channel_noise import planning_noise
from balance_cli.planning.detectability import (
    DetectionLevel,
    gain_threshold,
    project,
    required_noncentrality,
    smallest_sizes,
)
from balance_cli.planning.extended_model import extended_model
from balance_cli.planning.forecast import unpredicted_effects
from balance_cli.planning.hall import Exciter, Hall, open_hall, record_settings
from balance_cli.planning.information import add_information, no_information
from balance_cli.planning.stored_forecast import read_stored_plan
from balance_cli.report.page import build_page
from balance_cli.report.sources import Sources
from balance_cli.simulation import CampaignPlan, simulate_campaign, true_rig
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.identify import identify
from balance_cli.steps.plan import PlanningRig, PlanOptions, plan_campaign, planning_rig
from tests.support.other_rigs import other_rig, short_campaign

EFFECTS = ("channel-gain", "added-mass", "time-delay")


def hall_of(geometry, letter, **changes):
    """A hall with the sweeps of the short campaign of a rig."""
    sweeps = [run for run in short_campaign(letter).runs if run.kind == "sweep"]
    settings = {
        "exciters": {run.excited[0]: {"rms": run.level[0]} for run in sweeps},
        "band": sweeps[0].band,
        "period": sweeps[0].period,
        "sample_rate": sweeps[0].sample_rate,
        "periods": (4, 8),
        "levels": (1.0,),
        "effects": EFFECTS,
        "change_minutes": 0.1,
        "overhead_minutes": 0.05,
        "spectrum": "flat",
    }
    return Hall(format="balance-hall/1", **{**settings, **changes})


@pytest.fixture(scope="module")
def rig_a():
    geometry = other_rig("A")
    return planning_rig(geometry, hall_of(geometry, "A"))


@pytest.fixture(scope="module")
def plan_a(rig_a):
    """A sweep of each component; their periods are long beside the decay of the modes."""
    geometry = rig_a.rig.geometry
    hall = hall_of(geometry, "A", period=1.0, periods=(5,))
    runs = candidate_runs(geometry, hall, record_settings(geometry, hall), rig_a.model.system)
    return CampaignPlan(runs=tuple(item.plan for item in runs))


@pytest.fixture(scope="module")
def information_a(rig_a, plan_a):
    return [rig_a.information(run, range(3)) for run in plan_a.runs]


def test_predicted_sigma_is_that_of_the_identified_model(rig_a, plan_a, information_a):
    geometry = rig_a.rig.geometry
    predicted = project(add_information(information_a, rig_a.model), rig_a.model)
    sigma = np.sqrt(np.diag(predicted.covariance))
    free = rig_a.model.model.parameters.free
    names = np.array(rig_a.model.model.parameters.names)[free][rig_a.model.indices.fitted]
    achieved = []
    for seed in (21, 22):
        runs, _ = simulate_campaign(true_rig(geometry), plan_a, seed=seed)
        table = identify(measured_spectra(runs, geometry), geometry).parameters
        achieved.append([table.sigma[table.names.index(name)] for name in names])
    ratio = sigma / np.mean(achieved, axis=0)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    assert np.all(np.abs(ratio - 1.0) < 0.1)


def test_scores_of_campaigns_with_the_smallest_size_are_as_large_as_predicted(rig_a, plan_a, information_a):
    geometry = rig_a.rig.geometry
    total = add_information(information_a, rig_a.model)
    sizes = smallest_sizes(project(total, rig_a.model), rig_a.model, DetectionLevel())
    size = next(item for item in sizes if item.effect == "channel-gain")
    where = (size.label.partition("@")[2],)
    needed = required_noncentrality(1, rig_a.model.candidate_count, DetectionLevel(), total.noise_dof)
    effect = DeclaredEffect(name="channel-gain", where=where, parameters={"gain": 1.0 + size.value})
    candidate = candidate_at("channel-gain", where, geometry)
    gains = []
    for seed in range(2):
        rig = apply_effects(true_rig(geometry), [effect])
        runs, _ = simulate_campaign(rig, plan_a, seed=seed + 40)
        spectra = measured_spectra(runs, geometry)
        fitted = identify(spectra, geometry)
        batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
        theta = fitted.parameters.value
        score = scores(balance_model(geometry).at(theta), batches, [candidate], DEFAULT_SETTINGS.score)[0]
        gains.append(score.gain)
    # The mean of n gains of noncentrality L has the expectation 1 + L and the variance 2 (1 + 2 L) / n.
    assert abs(np.mean(gains) - 1.0 - needed) < 3.5 * np.sqrt(2.0 * (1.0 + 2.0 * needed) / len(gains))


def test_no_loads_are_forecast_of_channels_that_do_not_determine_them():
    geometry = other_rig("C")
    channels = tuple(channel for channel in geometry.channels if not channel.torque_meter)
    without_torque = geometry.model_copy(update={"channels": channels})
    assert planning_rig(geometry, hall_of(geometry, "C")).forecast is not None
    assert planning_rig(without_torque, hall_of(geometry, "C")).forecast is None


def test_information_grows_with_every_run(rig_a, information_a):
    few, all_runs = (
        project(add_information(part, rig_a.model), rig_a.model) for part in (information_a[:3], information_a)
    )
    assert np.all(np.diag(all_runs.covariance) <= np.diag(few.covariance) * (1 + 1e-6))
    assert np.all(np.diag(all_runs.V) >= np.diag(few.V) * (1 - 1e-6))


def test_nothing_is_found_before_the_first_run(rig_a):
    before = project(no_information(rig_a.model), rig_a.model)
    assert all(np.isinf(item.size) for item in smallest_sizes(before, rig_a.model, DetectionLevel()))


@pytest.mark.parametrize(("parameters", "count", "power"), [(1, 1, 0.9), (3, 400, 0.9), (6, 50, 0.5)])
def test_noncentrality_has_the_stated_power(parameters, count, power):
    detection = DetectionLevel(level=0.01, power=power)
    needed = required_noncentrality(parameters, count, detection, np.inf)
    threshold = stats.chi2.isf(0.01 / count, parameters)
    assert gain_threshold(parameters, count, 0.01, np.inf) == pytest.approx(threshold)
    assert stats.ncx2.sf(threshold, parameters, needed) == pytest.approx(power, abs=1e-6)


@pytest.mark.parametrize(("parameters", "dof"), [(1, 60.0), (3, 400.0)])
def test_noncentrality_has_the_stated_power_where_the_noise_is_measured(parameters, dof):
    detection = DetectionLevel(level=0.01)
    needed = required_noncentrality(parameters, 50, detection, dof)
    threshold = gain_threshold(parameters, 50, 0.01, dof)
    assert stats.ncf.sf(threshold / parameters, parameters, dof, needed) == pytest.approx(0.9, abs=1e-4)
    assert needed > required_noncentrality(parameters, 50, detection, np.inf)


@pytest.fixture(scope="module")
def short_plan_a():
    """A plan of rig A with few candidates, and its hall."""
    geometry = other_rig("A")
    hall = hall_of(geometry, "A", effects=("channel-gain",), periods=(4,))
    return plan_campaign(geometry, PlanOptions(minutes=1.0, hall=hall)), hall


def test_plan_keeps_to_time_and_exciters(short_plan_a):
    planned, hall = short_plan_a
    assert 0 < planned.minutes <= 1.0
    assert all(item.plan.level[0] <= hall.exciters[item.plan.excited[0]].rms for item in planned.chosen)
    after = [item.sizes[-1] for item in planned.effects]
    assert all(np.isfinite(after)) and all(np.isinf(item.sizes[0]) for item in planned.effects)


def test_nothing_is_rehearsed_or_ranked_after_the_time_limit(short_plan_a, monkeypatch):
    _, hall = short_plan_a
    calls, information = [], PlanningRig.information

    def counted(self, *words):
        calls.append(words)
        return information(self, *words)

    monkeypatch.setattr(PlanningRig, "information", counted)
    shaped = hall.model_copy(update={"spectrum": "optimal"})
    planned = plan_campaign(other_rig("A"), PlanOptions(minutes=1.0, hall=shaped, time_limit=1e-9))
    assert not planned.complete and len(calls) == 1
    assert planned.chosen and len(planned.ranking) == 1
    assert all(item.plan.power is None or not item.plan.power for item in planned.chosen)


def test_same_call_gives_the_same_plan(short_plan_a):
    planned, hall = short_plan_a
    again = plan_campaign(other_rig("A"), PlanOptions(minutes=1.0, hall=hall))
    assert planned.campaign == again.campaign and planned.effects == again.effects


def test_sigma_of_loads_is_told_for_every_run_and_falls(short_plan_a):
    loads = short_plan_a[0].loads
    stages = np.array([loads.before, *loads.after_run])
    assert stages.shape == (len(short_plan_a[0].chosen) + 1, len(loads.frequency), len(loads.components))
    assert np.all(np.diff(stages, axis=0) <= 1e-9 * stages[:-1]) and np.array_equal(loads.after, stages[-1])
    assert np.all(loads.after >= loads.noise)


def test_file_of_a_plan_keeps_noise_and_forecast_for_simulation_and_page(short_plan_a, tmp_path):
    planned = short_plan_a[0]
    path = tmp_path / "plan.yaml"
    path.write_text(plan_file_text(planned))
    stored = read_stored_plan(path)
    assert stored.plan.runs == planned.campaign.runs and stored.plan.rig == planned.rig
    assert stored.plan.noise.channels["l1.strain"] == pytest.approx(1e-3) and stored.plan.noise.load == 0.02
    effect = planned.effects[0]
    assert stored.forecast.effects[0].after == pytest.approx(effect.sizes[1:], rel=1e-5)
    sigma = stored.forecast.loads.sigma_after_run["Fz"][-1]
    assert sigma == pytest.approx(planned.loads.after[:, planned.loads.components.index("Fz")], rel=1e-5)
    page = build_page(Sources(plans=(stored,)))
    assert page.sections["plan"] == "Plan of a campaign" and "plan-1-sizes" in page.pictures
    assert all(item.plan.run in page.html for item in planned.chosen) and effect.label in page.html
    edited = path.read_text().replace("power: 0.9", "power: much")
    path.write_text(edited)
    with pytest.raises(UserError, match="valid number") as error:
        read_stored_plan(path)
    assert error.value.place == "forecast.power"


def test_text_says_which_runs_could_be_one_longer_record(short_plan_a):
    first = short_plan_a[0].chosen[0]
    name = first.plan.run.partition("-")[2]
    for count, remark in ((2, None), (4, f"01-{name} to 04-{name} are 4 times the same run")):
        chosen = number_runs([replace(first, plan=first.plan.model_copy(update={"run": name}))] * count)
        text = "\n".join(plan_text(replace(short_plan_a[0], chosen=chosen, loads=None)))
        assert (remark in text) if remark else ("the same run" not in text)


def test_text_names_components_without_a_sweep(short_plan_a):
    planned = short_plan_a[0]
    swept = {name for item in planned.chosen for name in item.plan.excited}
    missing = [limit.component for limit in planned.limits if limit.component not in swept]
    text = "\n".join(plan_text(replace(planned, chosen=planned.chosen[:1], loads=None)))
    kept = planned.chosen[0].plan.excited[0]
    others = ", ".join(limit.component for limit in planned.limits if limit.component != kept)
    assert f"No sweep of {others}:" in text
    assert ("No sweep of" in "\n".join(plan_text(planned))) == bool(missing)


def test_text_says_that_weak_lines_are_poor_for_measured_responses(short_plan_a):
    first = short_plan_a[0].chosen[0]
    for power, remark in (((1.0, 0.04), "have 20 % of the strongest"), ((1.0, 0.5), None)):
        sweep = first.plan.model_copy(update={"power": tuple(zip((5.0, 30.0), power, strict=True))})
        text = "\n".join(plan_text(replace(short_plan_a[0], chosen=(replace(first, plan=sweep),), loads=None)))
        assert (remark in text and "spectrum: flat" in text) if remark else "spectrum: flat" not in text


def test_noise_of_a_plan_is_that_of_its_rehearsal(short_plan_a):
    planned = short_plan_a[0]
    noise = planning_noise(planned.noise, (), 1.0).scale_by(2.0)
    channels = other_rig("A").channels
    expected = [2.0 * planning_noise(None, (), 1.0).sigma_of_channel(channel) for channel in channels]
    assert [noise.sigma_of_channel(channel) for channel in channels] == pytest.approx(expected)


def test_threshold_follows_the_noise_of_the_runs_that_show_an_effect(rig_a, information_a):
    """An effect that one of six runs shows is tested against the noise of that run alone."""
    total = add_information(information_a, rig_a.model)
    projected = project(total, rig_a.model)
    dof = [part.noise_dof for part in information_a]
    assert len(projected.noise_dof) == len(rig_a.model.candidates)
    assert np.all(projected.noise_dof <= sum(dof) * (1 + 1e-9)) and np.all(projected.noise_dof >= 0.9 * min(dof))


def test_every_effect_of_the_library_is_planned_or_named(rig_a):
    """An effect that is added to the library is in the next plan without a change of the planning."""
    geometry = rig_a.rig.geometry
    everything = extended_model(balance_model(geometry).at())
    planned = {item.effect.name for item in everything.candidates}
    unpredicted = set(unpredicted_effects(everything))
    for effect in EFFECTS_OF_LIBRARY:
        assert effect.name in planned | unpredicted, effect.name


def test_noise_of_runs_already_made_is_measured(plan_a):
    geometry, sweep = other_rig("A"), plan_a.runs[0]
    runs, _ = simulate_campaign(true_rig(geometry), CampaignPlan(runs=(sweep,)), seed=1)
    noise = planning_noise(None, measured_spectra(runs, geometry).lines, sweep.sample_rate)
    ratio = [noise.sigma_of_channel(c) / planning_noise(None, (), 1.0).sigma_of_channel(c) for c in geometry.channels]
    # Two hundred lines of two steady periods: the standard error of a channel's sigma is about 0.04.
    assert np.allclose(ratio, 1.0, atol=0.15) and np.mean(ratio) == pytest.approx(1.0, abs=0.05)
    assert noise.load == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"band": (5.0, 3000.0)}, "half of the sample rate"),
        ({"period": 1e-3}, "has no two lines"),
        ({"periods": (1000,), "period": 100.0}, "more than"),
        ({"rotor_speeds": (1e4,)}, "rotor speed"),
        ({"effects": ("gremlin",)}, "is no effect"),
    ],
)
def test_constraints_that_cannot_hold_are_refused(changes, fault):
    geometry = other_rig("A")
    with pytest.raises(UserError, match=fault):
        planning_rig(geometry, hall_of(geometry, "A", **changes))


def test_exciters_of_components_that_are_not_carried_are_refused():
    geometry = other_rig("A").model_copy(update={"freedom": ("z",)})
    hall = open_hall().model_copy(update={"exciters": {"Fx": Exciter(rms=1.0)}})
    with pytest.raises(UserError, match="does not carry Fx"):
        planning_rig(geometry, hall)


def test_open_hall_takes_band_and_rate_from_the_rig():
    for letter in "ABCDE":
        settings = record_settings(other_rig(letter), open_hall())
        assert settings.band[1] < settings.sample_rate / 2.0
        assert settings.period * settings.sample_rate == pytest.approx(round(settings.period * settings.sample_rate))
