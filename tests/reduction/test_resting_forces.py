"""Mean loads of a rig with nonlinear forces: sigma contains what a contact holds at rest and what vibration shifts."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.kinematics import elongation_matrix
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.balance import balance_model
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.simulation import CampaignPlan, RotorPlan, simulate_campaign, true_rig
from balance_cli.simulation.plans import ZeroPlan
from balance_cli.simulation.preset_plans import static_plans
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.channels import with_channel
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
FORCE, STICK = 15.0, 3e6
FRICTION = DeclaredEffect(name="dry-friction", where=("z1",), parameters={"force": FORCE, "stick_stiffness": STICK})
SQUARED = DeclaredEffect(name="quadratic-stiffness", where=("x",), parameters={"k2": 2e9, "side": "beside"})
STEADY = {"Fx": 60.0, "Fz": 150.0}


@pytest.fixture(scope="module")
def calibration():
    """A calibration of the rig before the force came in."""
    return calibrate(simulate_campaign(true_rig(RIG), CampaignPlan(runs=static_plans()), seed=1).runs, RIG)


def records(effect, harmonics):
    """A zero record, and one under mean loads and harmonics, of the rig integrated in time with an effect."""
    loads = RotorPlan(run="loaded", rotor_speed=17.5, duration=8.0, harmonics=harmonics, steady=STEADY, scatter=0.0)
    zero = ZeroPlan(run="zero", duration=4.0)
    return simulate_campaign(apply_effects(true_rig(RIG), (effect,)), CampaignPlan(runs=(zero, loads)), seed=2).runs


def source_with(*effects):
    geometry = RIG.model_copy(update={"effects": effects})
    return model_source(identify(measured_spectra([], geometry), geometry, IdentifyOptions(method="computed")))


def mean_errors(loaded, zero, calibration, source):
    """Errors (6,) of the mean loads, and their sigma."""
    reduced = reduce_run(loaded, RIG, calibration, source, zero_record(zero, RIG.channel_names))
    true = np.array([STEADY.get(name, 0.0) for name in reduced.components])
    return reduced.amplitude[0].real - true, reduced.sigma_cosine[0], reduced


def resting(zero, force):
    """The zero record with a contact beside z1 that holds a force: equilibrium of the plate on springs."""
    E = elongation_matrix(RIG, np.zeros(3))
    i = RIG.cell_names.index("z1")
    k = np.array([cell.effective_stiffness for cell in RIG.cells])
    K = E.T @ np.diag(k) @ E + STICK * np.outer(E[i], E[i])
    # The contact alone is displaced so far that it holds the force once the plate has followed.
    unit = -np.linalg.solve(K, E[i] * STICK)
    slider = force / (STICK * (1.0 + E[i] @ unit))
    forces = k * (E @ unit) * slider
    for channel in RIG.channels:
        if channel.measures_dc and channel.cell is not None:
            volts = channel.sensitivity * forces[RIG.cell_names.index(channel.cell)]
            zero = with_channel(zero, channel.name, lambda values, volts=volts: values + volts)
    return zero


def test_a_contact_that_rests_in_the_zero_record_is_in_sigma_of_the_mean_loads(calibration):
    zero, loaded = records(FRICTION, {"Fz": (150.0,), "Mx": (30.0,)})
    source, blind = source_with(FRICTION), source_with()
    z, z_blind = [], []
    for share in np.linspace(-1.0, 1.0, 5):
        error, sigma, reduced = mean_errors(loaded, resting(zero, share * FORCE), calibration, source)
        z.append(error / sigma)
        error, sigma, _ = mean_errors(loaded, resting(zero, share * FORCE), calibration, blind)
        z_blind.append(error / sigma)
    assert any("force at z1" in note for note in reduced.notes)
    print(np.round(z, 2), np.abs(z_blind).max())
    # Without the force in the model the extreme states are many sigma off; with it none is, uniform up to sqrt(3).
    assert np.abs(z_blind).max() > 10.0
    assert np.abs(z).max() < 2.5
    assert np.sqrt(np.mean(np.square(z), axis=0)).max() == pytest.approx(1.0, abs=0.4)


def test_what_vibration_shifts_is_taken_off_the_mean_loads(calibration):
    zero, loaded = records(SQUARED, {"Fx": (400.0,)})
    error, sigma, _ = mean_errors(loaded, zero, calibration, source_with(SQUARED))
    error_blind, sigma_blind, _ = mean_errors(loaded, zero, calibration, source_with())
    assert np.abs(error_blind / sigma_blind).max() > 5.0
    assert np.abs(error).max() < 0.01 * np.abs(error_blind).max()
    assert np.abs(error / sigma).max() < 3.0


@pytest.mark.parametrize(("stiffness", "gap"), [(4e6, 2e-6), (1e7, 1e-6)])
def test_a_stop_is_in_the_calibration_as_a_polynomial_that_has_no_kink(stiffness, gap):
    """The stop acts in the static runs, too: of its mean under vibration the calibration has nearly all."""
    stop = DeclaredEffect(name="free-play", where=("z1",), parameters={"stiffness": stiffness, "gap": gap})
    with_stop = apply_effects(true_rig(RIG), (stop,))
    calibration = calibrate(simulate_campaign(with_stop, CampaignPlan(runs=static_plans()), seed=1).runs, RIG)
    zero, loaded = records(stop, {"Fz": (300.0,), "Mx": (40.0,)})
    error, sigma, reduced = mean_errors(loaded, zero, calibration, source_with(stop))
    assert any("force at z1" in note for note in reduced.notes)
    # 4 to 7 sigma, 2.4 and 3.7 N of Fz, where the force at the mean elongation is taken for that of the calibration.
    assert np.abs(error / sigma).max() < 1.0
    assert np.abs(error[2]) < 0.15


@pytest.mark.parametrize("span_share", [0.0, 0.3, 0.9, 1.2])
def test_no_contact_holds_more_than_it_says_after_a_motion(span_share):
    """Jenkins' element stepped through a motion from every state that it may have had."""
    model = balance_model(RIG.model_copy(update={"effects": (FRICTION,)}))
    (force,) = (term for term in model.system(model.parameters.value).equations.forces)
    slip = FORCE / STICK
    span = 2.0 * slip * span_share
    d = 0.5 * span * np.sin(np.linspace(0.0, 6.0 * np.pi, 601))
    w = np.linspace(-slip, slip, 41)
    for each in d:
        w = np.clip(w, each - slip, each + slip)
    at_rest = STICK * (d[-1] - w)
    largest = force.held(force.values.value, span)
    assert np.abs(at_rest).max() <= max(largest, 0.0) + STICK * 0.5 * span * (largest == 0.0) + 1e-9
    assert largest == pytest.approx(FORCE * max(1.0 - span_share, 0.0))


def test_a_force_that_is_zero_adds_nothing(calibration):
    null = SQUARED.model_copy(update={"parameters": {"k2": 0.0, "side": "beside"}})
    zero, loaded = records(null, {"Fz": (50.0,)})
    with_null, without = (mean_errors(loaded, zero, calibration, source_with(*each))[1] for each in ((null,), ()))
    assert np.array_equal(with_null, without)
