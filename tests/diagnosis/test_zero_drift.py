"""Zeros of channels: a constant one is of no consequence; one that drifts is named and explains nothing."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, PARTLY_EXPLAINED
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.diagnosis.zero_drift import (
    ZERO_DRIFT_TEST,
    Zeros,
    add_drift_variance,
    find_zeros,
    judge_zero_drift,
    share_with_forces,
)
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import identify
from tests.support.channels import with_channel
from tests.support.diagnosis_content import diagnosis
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
MODEL = balance_model(RIG)
SYSTEM = MODEL.system(MODEL.parameters.value)
SETTINGS = DEFAULT_SETTINGS.data_tests
STRAIN = tuple(name for name in RIG.channel_names if name.endswith("strain"))


def campaign(effects=()):
    sweeps = (
        SweepPlan(run=f"sweep-{name}-{number}", excited=(name,), level=(level * number,), period=1.0, periods=5)
        for name, level in HIGH_SWEEP_LEVELS.items()
        for number in (1, 2)
    )
    rig = apply_effects(true_rig(RIG), effects)
    return simulate_campaign(rig, CampaignPlan(runs=tuple(sweeps)), seed=5).runs


def with_zeros(runs, sigma, constant=0.0, channels=STRAIN, seed=2):
    """The runs with a zero in each channel, of which `sigma` [V] differs from run to run."""
    rng = np.random.default_rng(seed)
    shared = {name: constant * rng.normal() for name in channels}
    changed = []
    for run in runs:
        zeros = {name: shared[name] + sigma * rng.normal() for name in channels}
        for name, zero in zeros.items():
            run = with_channel(run, name, lambda volts, zero=zero: volts + zero) if run.kind == "sweep" else run
        changed.append(run)
    return changed


def zeros_of(runs):
    return find_zeros(SYSTEM, measured_spectra(runs, RIG, means=True), SETTINGS)


def drift_of(runs):
    return zeros_of(runs).drift


@pytest.fixture(scope="module")
def runs():
    return campaign()


def test_zeros_that_stay_drift_nowhere(runs):
    assert zeros_of(runs) == Zeros({}, None)
    zeros = zeros_of(with_zeros(runs, 0.0, constant=0.1, seed=3))
    assert zeros.drift is None
    true = 0.1 * np.random.default_rng(3).normal(size=len(STRAIN))
    assert zeros.offsets == pytest.approx(dict(zip(STRAIN, true, strict=True)), abs=1e-3)


def test_the_drift_of_every_bridge_or_of_one_is_found_with_its_size(runs):
    drift = drift_of(with_zeros(runs, 3e-4, constant=0.1))
    assert set(drift.channels) == set(STRAIN)
    # Chi-square of eleven values each: the mean square over all bridges is known to about 15 %.
    assert np.sqrt(np.mean(drift.sigma**2)) == pytest.approx(3e-4, rel=0.4)
    assert drift.p_value < 1e-6
    alone = drift_of(with_zeros(runs, 3e-4, channels=("z1.strain",)))
    assert alone.channels == ("z1.strain",)


def test_what_a_quadratic_cell_shifts_is_no_drift():
    squared = DeclaredEffect(name="quadratic-stiffness", where=("x",), parameters={"k2": 3e9, "side": "beside"})
    shifted = campaign((squared,))
    means = measured_spectra(shifted, RIG, means=True).lines
    assert max(abs(run.channels[run.frequency == 0]).max() for run in means) > 1e-4
    assert zeros_of(shifted) == Zeros({}, None)


def test_the_means_carry_the_variance_of_the_drift_and_no_other_line_does(runs):
    spectra = measured_spectra(with_zeros(runs, 3e-4), RIG, means=True)
    drift = find_zeros(SYSTEM, spectra, SETTINGS).drift
    for old, new in zip(spectra.lines, add_drift_variance(spectra, drift).lines, strict=True):
        at_rest = old.frequency == 0
        assert np.array_equal(new.covariance[~at_rest], old.covariance[~at_rest])
        column = old.channel_names.index(drift.channels[0])
        before, after = (run.covariance[at_rest, column, column].real for run in (old, new))
        assert after - before == pytest.approx(4.0 * drift.sigma[0] ** 2)


@pytest.mark.parametrize(("ratio", "verdict"), [(0.5, NOTHING_MISSING), (2.0, PARTLY_EXPLAINED)])
def test_a_drift_matters_beyond_the_scatter_of_static_readings(runs, ratio, verdict):
    drift = drift_of(with_zeros(runs, 3e-4))
    drift = replace(drift, static_sigma=drift.sigma / ratio)
    judged = judge_zero_drift(replace(diagnosis(), verdict=NOTHING_MISSING), drift)
    assert judged.verdict == verdict
    assert judged.data_tests[-1].name == ZERO_DRIFT_TEST
    assert drift.channels[0] in judged.notes[-1]


def test_everyday_zeros_leave_the_verdict_of_a_sound_rig(runs):
    zeros = measured_spectra(with_zeros(runs, 0.0, constant=0.02), RIG, means=True)
    result, _ = diagnose(identify(zeros, RIG), zeros)
    assert result.verdict == NOTHING_MISSING
    assert {effect.label for effect in result.effects} == {f"channel-offset@{name}" for name in STRAIN}
    assert all(effect.is_of_no_consequence for effect in result.effects)


def random_forces(runs, sigma, seed=4):
    """A force [N] of each run."""
    return sigma * np.random.default_rng(seed).normal(size=len(runs))


def with_cell_forces(runs, cell, forces):
    """The runs with a constant force [N] beside a cell, another in each sweep, as the loads that it amounts to."""
    spring = next(each for each in RIG.cells if each.name == cell)
    axis, lever = np.array(spring.axis), np.subtract(spring.position, RIG.hub)
    per_newton = response(SYSTEM, solve(SYSTEM, np.zeros(1)))[0].real @ np.concatenate([axis, np.cross(lever, axis)])
    changed = []
    for run, force in zip(runs, forces, strict=True):
        for name, volts in zip(RIG.channel_names, force * per_newton, strict=True):
            run = with_channel(run, name, lambda v, volts=volts: v + volts) if name in STRAIN else run
        changed.append(run)
    return changed


def system_with_contact(cell, force=5.0):
    contact = DeclaredEffect(name="dry-friction", where=(cell,), parameters={"force": force, "stick_stiffness": 1e6})
    model = balance_model(RIG.model_copy(update={"effects": (contact,)}))
    return model.system(model.parameters.value)


def test_forces_that_a_contact_holds_are_not_named_a_drift_of_zeros(runs):
    spectra = measured_spectra(with_cell_forces(runs, "z1", random_forces(runs, 2.0)), RIG, means=True)
    drift = find_zeros(SYSTEM, spectra, SETTINGS).drift
    assert drift.note.startswith("zeros, which")
    drift = replace(drift, static_sigma=drift.sigma / 2.0)
    assert drift.is_significant
    held = share_with_forces(drift, system_with_contact("z1"), spectra, SETTINGS)
    assert held.contacts.places == ("z1",)
    assert held.contacts.left is None
    assert not held.is_significant
    assert "what the contact at z1 holds at rest" in held.note
    assert "what the contact at z1 holds at rest" in held.test.finding
    assert judge_zero_drift(replace(diagnosis(), verdict=EXPLAINED), held).verdict == EXPLAINED
    # A contact elsewhere does not shift the channels in these proportions.
    assert share_with_forces(drift, system_with_contact("x"), spectra, SETTINGS) == drift
    assert share_with_forces(drift, SYSTEM, spectra, SETTINGS) == drift


def test_zeros_that_drift_beside_a_contact_are_zeros(runs):
    spectra = measured_spectra(with_zeros(runs, 3e-4), RIG, means=True)
    drift = find_zeros(SYSTEM, spectra, SETTINGS).drift
    assert share_with_forces(drift, system_with_contact("z1"), spectra, SETTINGS).contacts is None


def square_of_rate(run, cell):
    """Mean of |v| v [m2/s2] of a cell in the last period of a run, by its channel that sees the dynamics alone."""
    channel = next(item for item in RIG.channels if item.cell == cell and item.time_constant is not None)
    period = run.read().channels[-round(run.period * run.sample_rate) :, run.channel_names.index(channel.name)]
    spectrum = np.fft.rfft(period) * 2j * np.pi * np.fft.rfftfreq(len(period), 1.0 / run.sample_rate)
    stiffness = next(item.effective_stiffness for item in RIG.cells if item.name == cell)
    v = np.fft.irfft(spectrum, 8 * len(period)) * 8 / (channel.sensitivity * stiffness)
    return np.mean(np.abs(v) * v)


def test_means_of_a_force_that_the_motion_determines_are_no_drift(runs):
    squares = np.array([square_of_rate(run, "z1") for run in runs])
    c2 = 0.5 / np.sqrt(np.mean(squares**2))
    spectra = measured_spectra(with_cell_forces(runs, "z1", -c2 * squares), RIG, means=True)
    drift = find_zeros(SYSTEM, spectra, SETTINGS).drift
    assert drift is not None
    damper = DeclaredEffect(name="quadratic-damping", where=("z1",), parameters={"c2": c2})
    model = balance_model(RIG.model_copy(update={"effects": (damper,)}))
    assert share_with_forces(drift, model.system(model.parameters.value), spectra, SETTINGS) is None


def test_bridges_that_curve_are_no_drift():
    """Each shifts its own mean with the power of its reading; beside that, its zero is seen as if it were linear."""
    curvature = {f"quadratic_{name}": 0.01 * (-1) ** i for i, name in enumerate(STRAIN)}
    curved = campaign((DeclaredEffect(name="channel-nonlinearity", where=("strain",), parameters=curvature),))
    true = 0.1 * np.random.default_rng(3).normal(size=len(STRAIN))
    zeros = zeros_of(with_zeros(curved, 0.0, constant=0.1, seed=3))
    assert zeros.drift is None
    assert zeros.offsets == pytest.approx(dict(zip(STRAIN, true, strict=True)), abs=1e-3)
    drift = drift_of(with_zeros(curved, 3e-4, constant=0.1))
    assert np.sqrt(np.mean(drift.sigma**2)) == pytest.approx(3e-4, rel=0.4)


def test_what_a_model_with_curved_bridges_leaves_is_no_drift(runs):
    curvature = {f"quadratic_{name}": 0.01 * (-1) ** i for i, name in enumerate(STRAIN)}
    effect = DeclaredEffect(name="channel-nonlinearity", where=("strain",), parameters=curvature)
    spectra = measured_spectra(campaign((effect,)), RIG, means=True)
    model = balance_model(RIG.model_copy(update={"effects": (effect,)}))
    before = drift_of(with_zeros(runs, 3e-4))
    assert before is not None
    assert share_with_forces(before, model.system(model.parameters.value), spectra, SETTINGS) is None


def test_bridges_are_found_at_their_zeros():
    """Their coefficients and gains refer to the unloaded rig, wherever the zeros of their bridges stand."""
    curvature = {f"quadratic_{name}": 0.05 * (-1) ** i for i, name in enumerate(STRAIN)}
    curved = campaign((DeclaredEffect(name="channel-nonlinearity", where=("strain",), parameters=curvature),))
    runs = with_zeros(curved, 0.0, constant=0.3, seed=3)
    spectra = measured_spectra(runs, RIG, means=True)
    result, _ = diagnose(identify(spectra, RIG), spectra)
    assert result.verdict == EXPLAINED
    by_label = {item.label: item for item in result.effects}
    assert set(by_label) == {"channel-nonlinearity@strain", *(f"channel-offset@{name}" for name in STRAIN)}
    found = {item.name: item for item in by_label["channel-nonlinearity@strain"].parameters}
    for name, value in curvature.items():
        assert abs(found[name].value - value) < 4.0 * found[name].sigma
