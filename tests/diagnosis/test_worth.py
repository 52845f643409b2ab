"""Worth of an effect: its place in the hub loads, by a refit without it, and what it does to the verdict."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.conclusions import describe_offsets
from balance_cli.diagnosis.selection.effect_selection import refit_without_effect
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.diagnosis.worth import compared_systems, effect_worth, theta_without
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import declared_effects
from balance_cli.model.system_response import response, solve
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.simulation.rig import apply_effects
from tests.support.diagnosis_content import delay_effect
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
LATE = DeclaredEffect(name="time-delay", where=("x.piezo",), parameters={"delay": 2e-6})
HOSE = DeclaredEffect(
    name="parallel-stiffness",
    parameters={"x": 0.2, "y": 0.1, "z": 0.3, "stiffness_x": 1.5e5, "stiffness_y": 1e5, "stiffness_z": 2e5},
)
OFFSET = DeclaredEffect(name="channel-offset", where=("x.strain",), parameters={"offset": 0.01})


@pytest.fixture(scope="module")
def fitted():
    """A campaign with a channel that is late and one with an offset, and the fit of both effects."""
    return fit_of_campaign(LATE, OFFSET)


def fit_of_campaign(*hidden, spin=0.0):
    """The fit of a campaign with effects, its batches, and the effects by their names."""
    sweeps = (
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=6, rotor_speed=spin)
        for name, level in HIGH_SWEEP_LEVELS.items()
    )
    rig = apply_effects(true_rig(RIG), hidden)
    runs = simulate_campaign(rig, CampaignPlan(runs=(*static_plans(), *sweeps)), seed=3).runs
    spectra = measured_spectra(runs, RIG, means=True)
    batches = stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    model = balance_model(RIG.model_copy(update={"effects": hidden}))
    fit = fit_all_lines(model.at(), batches, SETTINGS.fit)
    return fit, batches, {effect.effect.name: effect for effect in declared_effects(model.geometry)}


def changes(hidden, estimates):
    """How far the responses of models without the first effect are from that of a refit, over what the effect does."""
    fit, batches, effects = fit_of_campaign(*hidden)
    effect = effects[hidden[0].name]
    refit = refit_without_effect(fit, effect, batches, SETTINGS.fit).system()
    systems = [fit.system(), refit, *(estimate(fit, effect, batches) for estimate in estimates)]
    whole, right, *others = [response(system, solve(system, np.array([17.5, 35.0, 70.0]))) for system in systems]
    return [np.linalg.norm(other - right) / np.linalg.norm(whole - right) for other in others]


def without_effect(fit, effect, batches):
    return compared_systems(fit, effect, batches, SETTINGS)[1]


def to_first_order(fit, effect, batches):
    return fit.model.system(theta_without(fit, effect))


def test_the_model_without_a_small_effect_is_that_of_a_refit():
    assert changes((LATE, OFFSET), [without_effect])[0] < 0.1


def test_the_model_without_a_large_effect_is_near_that_of_a_refit():
    """It has other weights. To first order the model would be four times as far off as what the effect does."""
    near, far = changes((HOSE,), [without_effect, to_first_order])
    assert near < 0.5 < 2.0 < far


def test_what_is_late_moves_the_loads_that_its_cell_carries(fitted):
    fit, batches, effects = fitted
    late = effect_worth(fit, effects["time-delay"], batches)
    assert max(late, key=late.get) in ("Fx", "My")
    assert late["Fx"] > 1.0 > late["Mz"]


def test_what_spins_moves_loads_at_the_rotor_speed():
    """It does nothing at rest, where the responses of sweeps are otherwise compared."""
    gyroscope = DeclaredEffect(name="gyroscopic-coupling", parameters={"polar_inertia": 0.05})
    fit, batches, effects = fit_of_campaign(gyroscope, spin=17.5)
    effect = effects["gyroscopic-coupling"]
    worth = effect_worth(fit, effect, batches)
    frequency = np.array([17.5, 35.0, 70.0])
    whole, lacking = (
        response(system, solve(system, frequency, 17.5)) for system in compared_systems(fit, effect, batches, SETTINGS)
    )
    error = np.abs(np.linalg.pinv(lacking) @ whole - np.eye(6)).max(axis=0)
    assert error[3, 4] > 1e-3 and error[4, 3] > 1e-3
    assert min(worth["Mx"], worth["My"]) > 2.0


def test_it_cannot_be_told_without_a_rotor_speed_or_of_what_is_no_response(fitted):
    fit, batches, effects = fitted
    still = replace(fit, model=replace(fit.model, geometry=fit.model.geometry.model_copy(update={"rotor": None})))
    assert effect_worth(still, effects["time-delay"], batches) is None
    assert set(effect_worth(fit, effects["channel-offset"], batches).values()) == {0.0}
    assert describe_offsets(fit)[0].startswith("channel-offset of x.strain: no harmonic load depends on such zeros")


@pytest.mark.parametrize(
    ("worth", "negligible"), [(None, False), ({"Fx": 0.05}, True), ({"Fx": 0.05, "Mz": 0.2}, False)]
)
def test_an_effect_that_moves_no_load_by_a_tenth_of_its_sigma_is_of_no_consequence(worth, negligible):
    assert replace(delay_effect(), worth=worth).is_of_no_consequence == negligible
