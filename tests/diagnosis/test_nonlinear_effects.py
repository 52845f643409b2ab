"""Effects that no response shows: forces that are not linear, and offsets; truth from the simulation in time."""

from dataclasses import fields, replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.likelihood import data_chi2, data_curvature
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.effects.contact import find_last_slip
from balance_cli.model.fitted_effects import declare_fitted_effects
from balance_cli.model.placed_effects import add_effects, declared_effects, without_effects
from balance_cli.reduction.model_sources import model_source
from balance_cli.signals.sampled_waveform import OVERSAMPLING
from balance_cli.simulation import CampaignPlan, RotorPlan, SweepPlan, draw_rig, short_plan, simulate_campaign
from balance_cli.simulation import true_rig as true_rig_of
from balance_cli.simulation.preset_plans import HARMONIC_SHAPE
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import identified_effects, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
TRUTH = {
    ("cubic-stiffness", ("x",), "inside"): {"k3": 3e11},
    ("cubic-stiffness", ("x",), "beside"): {"k3": 3e11},
    ("quadratic-stiffness", ("z1",), "inside"): {"k2": 3e8},
    ("quadratic-stiffness", ("z1",), "beside"): {"k2": -3e8},
    ("dry-friction", ("x",), None): {"force": 0.5, "stick_stiffness": 1.5e6},
    ("mains-pickup", ("x.strain",), None): {"amplitude": 5e-4, "frequency": 50.0},
    ("channel-offset", ("z2.strain",), None): {"offset": 0.004},
    ("load-offset", ("Fz",), None): {"offset": -1.5},
}
IDS = [f"{name}@{','.join(where)},{side}" for name, where, side in TRUTH]


def declared(name, where, side, parameters):
    return DeclaredEffect(name=name, where=where, parameters={**parameters, **({"side": side} if side else {})})


def with_effects(*effects):
    return RIG.model_copy(update={"effects": effects})


@pytest.fixture(scope="module")
def true_rig():
    rig = draw_rig(RIG, np.random.default_rng(11))
    return replace(rig, damping_ratios=np.maximum(rig.damping_ratios, 0.02))


def campaign_with(rig, *effects):
    """Static runs, and sweeps by Fx, Fz and My, of a rig with these effects."""
    plan = short_plan().select_runs(["static-bare", "static-trim", "sweep-Fx", "sweep-Fz", "sweep-My"])
    kept = {"sweep": {"periods": 9}, "static": {"steps": 5}}
    runs = tuple(one.model_copy(update=kept[one.kind]) for one in plan.runs if one.kind in kept)
    return simulate_campaign(apply_effects(rig, effects), plan.model_copy(update={"runs": runs}), seed=4)[0]


@pytest.fixture(scope="module")
def linear_runs(true_rig):
    return campaign_with(true_rig)


@pytest.fixture(scope="module")
def healthy(linear_runs):
    return identify(measured_spectra(linear_runs, RIG, means=True), RIG)


@pytest.mark.parametrize("key", [key for key in TRUTH if key[2]], ids=[name for name in IDS if "side" in name])
def test_found_on_the_side_where_it_was_simulated(true_rig, healthy, key):
    """Effects without a side are in `tests/model/test_effects.py`."""
    name, where, side = key
    spectra = measured_spectra(campaign_with(true_rig, declared(*key, TRUTH[key])), RIG, means=True)
    model = identify(spectra, with_effects(declared(*key, {})))
    ((parameter,),) = (effect.parameters for effect in identified_effects(model))
    truth = TRUTH[key][parameter.name]
    assert abs(parameter.value - truth) < 4 * parameter.sigma < 0.4 * abs(truth)
    assert abs(healthy.quality.chi2_per_dof - 1.0) < 0.02
    assert model.quality.chi2_per_dof < healthy.quality.chi2_per_dof + 0.02
    other = {"inside": "beside", "beside": "inside"}[side]
    assert identify(spectra, with_effects(declared(name, where, other, {}))).quality.chi2 > model.quality.chi2 + 25


def test_nothing_found_where_nothing_is(linear_runs, healthy):
    spectra = measured_spectra(linear_runs, RIG, means=True)
    model = identify(spectra, with_effects(*(declared(*key, {}) for key in TRUTH)))
    assert healthy.quality.chi2 - model.quality.chi2 < 40
    for effect in identified_effects(model):
        assert abs(effect.parameters[0].value) < 4 * effect.parameters[0].sigma or effect.name == "mains-pickup"


def test_means_leave_the_chi_square_of_a_healthy_rig_right(linear_runs):
    few, all_of_it = (identify(measured_spectra(linear_runs, RIG, means), RIG).quality for means in (False, True))
    more = all_of_it.dof - few.dof
    assert more > 1500
    assert abs((all_of_it.chi2 - few.chi2) / more - 1.0) < 0.1


def test_means_are_not_asked_for_without_need(linear_runs):
    plain, asked = (measured_spectra(linear_runs, RIG, means) for means in (None, False))
    for one, other in zip(plain.lines, asked.lines, strict=True):
        assert one.waveform is None
        np.testing.assert_array_equal(one.channels, other.channels)
    needed = measured_spectra(linear_runs, add_effects(RIG, ["load-offset@Fx"]))
    assert all(lines.frequency[-1] == 0 and lines.waveform is not None for lines in needed.lines)


MAINS_PARAMETERS = ("mains-pickup@y2.strain.amplitude^2", "mains-pickup@y2.strain.frequency")
EVERYTHING = (
    declared("cubic-stiffness", ("x",), "inside", {"k3": 3e11}),
    declared("cubic-stiffness", ("x",), "beside", {"k3": -2e11}),
    declared("quadratic-stiffness", ("x",), "inside", {"k2": 2e8}),
    declared("cubic-stiffness", ("z1",), "beside", {"k3": 3e11}),
    declared("quadratic-stiffness", ("z2",), "beside", {"k2": 0.0}),
    declared("quadratic-stiffness", ("z2",), "inside", {"k2": 1e8}),
    declared("mains-pickup", ("y2.strain",), None, {"amplitude": 2e-4, "frequency": 50.03}),
    declared("mains-pickup", ("y2.piezo",), None, {"amplitude": 1e-3, "frequency": 49.98}),
    declared("dry-friction", ("y1",), None, {"force": 2.0, "stick_stiffness": 1e6}),
    DeclaredEffect(name="structural-damping", where=("all",), parameters={"loss_factor": 0.01}),
    DeclaredEffect(name="time-delay", where=("x.piezo",), parameters={"delay": 1e-3}),
    DeclaredEffect(name="low-pass", where=("z1.strain",), parameters={"cutoff": 300.0}),
    DeclaredEffect(name="channel-gain", where=("z1.piezo",), parameters={"gain": 1.02}),
    DeclaredEffect(name="crosstalk", where=("x.strain", "y1.strain"), parameters={"fraction": 0.01}),
    DeclaredEffect(name="exciter-misalignment", where=("Fx", "Fz"), parameters={"fraction": 0.01}),
    DeclaredEffect(name="support-flexibility", where=("x",)),
    DeclaredEffect(name="channel-offset", where=("x.strain",), parameters={"offset": 0.01}),
    DeclaredEffect(name="load-offset", where=("Fx",), parameters={"offset": 2.0}),
)


def test_slopes_of_the_likelihood_are_the_derivatives(linear_runs):
    kept = [run for run in linear_runs if run.name in ("sweep-Fx", "static-trim")]
    model = balance_model(with_effects(*EVERYTHING)).free_all_parameters()
    spectra = measured_spectra(kept, RIG, means=True)
    batches = stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    theta, scale = model.parameters.value, model.parameters.scale
    gradient = 2.0 * data_curvature(batches, model.system(theta)).gradient
    for i, name in enumerate(model.parameters.names):
        step = 1e-4 * scale[i] * np.eye(len(theta))[i]
        above, below = (data_chi2(batches, model.system(theta + s)) for s in (step, -step))
        numerical = (above - below) / (2e-4 * scale[i])
        noise = 1e-10 * above / (1e-4 * scale[i])
        assert gradient[i] == pytest.approx(numerical, rel=2e-3, abs=noise), name


def test_a_force_at_its_null_changes_nothing_and_still_has_its_slope(linear_runs):
    spectra = measured_spectra([run for run in linear_runs if run.name == "sweep-Fx"], RIG, means=True)
    batches = stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    sides = ("inside", "beside")
    effects = [declared("cubic-stiffness", (cell,), side, {}) for side in sides for cell in RIG.cell_names]
    model = balance_model(with_effects(*effects))
    assert data_chi2(batches, model.system()) == data_chi2(batches, balance_model(RIG).system())
    curvature = data_curvature(batches, model.system())
    assert np.all(np.diag(curvature.information) > 0)


def test_a_cell_that_gives_way_is_no_rig(linear_runs):
    spectra = measured_spectra([run for run in linear_runs if run.name == "static-bare"], RIG, means=True)
    batches = stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    model = balance_model(with_effects(declared("cubic-stiffness", ("x",), "inside", {"k3": -1e15})))
    with pytest.raises(np.linalg.LinAlgError):
        data_chi2(batches, model.system())


def test_a_waveform_gives_back_what_was_recorded(linear_runs):
    run = next(run for run in linear_runs if run.name == "sweep-Fx")
    (lines,) = measured_spectra([run], RIG, means=True).lines
    waveform = lines.waveform
    np.testing.assert_allclose(
        waveform.to_bins(waveform.to_time_domain(waveform.volts)), lines.channels, rtol=0.02, atol=1e-3
    )
    assert len(waveform.to_time_domain(waveform.volts)) == OVERSAMPLING * waveform.samples


def test_the_side_is_kept_and_checked():
    rig = add_effects(RIG, ["cubic-stiffness@x", "cubic-stiffness@x,beside"])
    assert [one.where for one in declared_effects(rig)] == [("x", "beside"), ("x", "inside")]
    model = balance_model(rig)
    again = declare_fitted_effects(rig, model.parameters.names, model.parameters.value.tolist())
    assert [effect.parameters["side"] for effect in again.effects] == ["beside", "inside"]
    assert [effect.where for effect in again.effects] == [("x",), ("x",)]
    assert balance_model(again).parameters.names == model.parameters.names
    with pytest.raises(UserError, match="beside"):
        declared_effects(with_effects(declared("cubic-stiffness", ("x",), "besides", {})))
    with pytest.raises(UserError, match="Did you mean"):
        declared_effects(
            with_effects(DeclaredEffect(name="cubic-stiffness", where=("x",), parameters={"sides": "beside"}))
        )


@pytest.mark.parametrize("recurs", [True, False])
@pytest.mark.parametrize("force", [2.0, 9.0, 30.0])
def test_a_contact_goes_the_way_of_its_rule(recurs, force):
    t = np.arange(3000) / 3000
    d = 1e-5 * np.sin(2 * np.pi * 3 * t) + 6e-6 * np.cos(2 * np.pi * 17 * t + 1)
    kappa, held, before, expected = 1e6, 0.0, 0.0, []
    for now in np.tile(d, 2 if recurs else 1):
        held = float(np.clip(held + kappa * (now - before), -force, force))
        before = now
        expected.append(held)
    last, direction = find_last_slip(d, force / kappa, recurs)
    found = kappa * (d - np.where(last >= 0, d[last], 0.0)) + force * direction
    np.testing.assert_allclose(found, expected[-3000:], atol=1e-9)


def test_a_record_that_does_not_repeat_tells_the_same_force(true_rig):
    """Random excitation: the force goes through the sums of neighbouring lines that the local model made."""
    random = [
        SweepPlan(run=f"random-{name}", excited=(name,), level=(level,), excitation="random", period=8.0, periods=2)
        for name, level in (("Fx", 40.0),)
    ]
    effect = declared("cubic-stiffness", ("x",), "beside", {"k3": 1e12})
    runs, _ = simulate_campaign(apply_effects(true_rig, [effect]), CampaignPlan(runs=tuple(random)), seed=6)
    spectra = measured_spectra(runs, RIG, means=True)
    model = identify(spectra, with_effects(declared("cubic-stiffness", ("x",), "beside", {})))
    rigid = identify(spectra, RIG)
    parameter = identified_effects(model)[0].parameters[0]
    assert abs(parameter.value - 1e12) < 3 * parameter.sigma
    assert parameter.sigma < 1e11
    assert rigid.quality.chi2 > model.quality.chi2 + 100


def test_slopes_of_a_record_that_does_not_repeat(true_rig):
    plan = SweepPlan(run="random", excited=("Fx",), level=(40.0,), excitation="random", period=10.0, periods=1)
    runs, _ = simulate_campaign(true_rig, CampaignPlan(runs=(plan,)), seed=7)
    spectra = measured_spectra(runs, RIG, means=True)
    batches = stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    interference = declared("mains-pickup", ("y2.strain",), None, {"amplitude": 5e-4, "frequency": 50.03})
    model = balance_model(
        with_effects(EVERYTHING[0], EVERYTHING[1], EVERYTHING[-1], interference)
    ).free_all_parameters()
    theta, scale = model.parameters.value, model.parameters.scale
    gradient = 2.0 * data_curvature(batches, model.system(theta)).gradient
    for name in (
        "stiffness.x",
        "sensitivity.x.piezo",
        "cubic-stiffness@x,inside.k3",
        "load-offset@Fx.offset",
        *MAINS_PARAMETERS,
    ):
        i = model.parameters.index(name)
        step = 1e-4 * scale[i] * np.eye(len(theta))[i]
        above, below = (data_chi2(batches, model.system(theta + s)) for s in (step, -step))
        assert gradient[i] == pytest.approx((above - below) / (2e-4 * scale[i]), rel=2e-3), name


def test_the_score_of_mains_interference_has_no_bias_where_there_is_none(true_rig):
    """The mean over many phases of noise is zero, though each amplitude that noise makes is positive."""
    names = [f"mains-pickup@{channel}" for channel in RIG.channel_names if channel.endswith("strain")]
    quiet = true_rig_of(RIG)
    scores = []
    for seed in range(4):
        plan = SweepPlan(run="sweep", excited=("Mz",), level=(12.0,), period=2.0, periods=8)
        runs, _ = simulate_campaign(quiet, CampaignPlan(runs=(plan,)), seed=seed)
        model = balance_model(add_effects(RIG, names))
        spectra = measured_spectra(runs, model.geometry)
        curvature = data_curvature(stack_runs(spectra.lines, spectra.statics, RIG.channel_names), model.system())
        free = [name for name, is_free in zip(model.parameters.names, model.parameters.free, strict=True) if is_free]
        own = [i for i, name in enumerate(free) if name.endswith("amplitude^2")]
        scores += list(curvature.gradient[own] / np.sqrt(np.diag(curvature.information)[own]))
    assert abs(np.mean(scores)) < 3.0 / np.sqrt(len(scores))
    assert 0.4 < np.var(scores) < 2.5


def test_hub_loads_of_a_rig_that_is_not_linear(true_rig):
    """The model knows the force that the cells told, and takes it out before it looks for loads."""
    effect = declared("cubic-stiffness", ("x",), "beside", {"k3": 1e13})
    truly = apply_effects(true_rig, [effect])
    loads = {
        "Fx": tuple(400.0 * share for share in HARMONIC_SHAPE),
        "Mx": tuple(40.0 * share for share in HARMONIC_SHAPE),
    }
    check = RotorPlan(run="check", rotor_speed=17.5, duration=16.0, harmonics=loads)
    plan = short_plan()
    swept = tuple(one.model_copy(update={"periods": 9}) for one in plan.runs if one.kind == "sweep")
    statics = tuple(one.model_copy(update={"steps": 5}) for one in plan.runs if one.kind == "static")
    runs, _ = simulate_campaign(truly, CampaignPlan(runs=(*statics, *swept, check)), seed=5)
    calibration = calibrate([run for run in runs if run.kind == "static"], RIG)
    spectra = measured_spectra(runs, RIG, means=True)
    model = identify(spectra, with_effects(declared("cubic-stiffness", ("x",), "beside", {})))
    blind = replace(model, geometry=without_effects(model.geometry), parameters=first(model.parameters, -1))
    blind = replace(blind, covariance=model.covariance[:-1, :-1])
    errors = [
        reduce_run(runs[-1], RIG, calibration, model_source(one)).check.load_error["Fx"] for one in (model, blind)
    ]
    assert errors[0] < 0.3 * errors[1]
    assert errors[0] < 0.01


def first(table, count):
    """The first parameters of a table."""
    return replace(table, **{item.name: getattr(table, item.name)[:count] for item in fields(table)})
