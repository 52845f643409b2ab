"""Worth of an effect: its place in the hub loads, by a refit without it, and what it does to the verdict."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.conclusions import describe_offsets
from balance_cli.diagnosis.selection.effect_selection import refit_without_effect
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.diagnosis.worth import effect_worth, theta_without
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
OFFSET = DeclaredEffect(name="channel-offset", where=("x.strain",), parameters={"offset": 0.01})


@pytest.fixture(scope="module")
def fitted():
    """A campaign with a channel that is late and one with an offset, and the fit of both effects."""
    sweeps = (
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=6)
        for name, level in HIGH_SWEEP_LEVELS.items()
    )
    rig = apply_effects(true_rig(RIG), (LATE, OFFSET))
    runs = simulate_campaign(rig, CampaignPlan(runs=(*static_plans(), *sweeps)), seed=3).runs
    spectra = measured_spectra(runs, RIG, means=True)
    batches = stack_runs(spectra.lines, spectra.statics, RIG.channel_names)
    model = balance_model(RIG.model_copy(update={"effects": (LATE, OFFSET)}))
    fit = fit_all_lines(model.at(), batches, SETTINGS.fit)
    return fit, batches, {effect.effect.name: effect for effect in declared_effects(model.geometry)}


def test_the_model_without_an_effect_is_that_of_a_refit(fitted):
    fit, batches, effects = fitted
    frequency = np.array([17.5, 35.0, 70.0])
    refit = refit_without_effect(fit, effects["time-delay"], batches, SETTINGS.fit)
    shifted = fit.model.system(theta_without(fit, effects["time-delay"]))
    with_effect, one, other = (
        response(system, solve(system, frequency))
        for system in (fit.model.system(fit.theta), shifted, refit.model.system(refit.theta))
    )
    assert np.linalg.norm(one - other) < 0.1 * np.linalg.norm(with_effect - other)


def test_what_is_late_moves_the_loads_that_its_cell_carries(fitted):
    fit, batches, effects = fitted
    late = effect_worth(fit, effects["time-delay"], batches)
    assert max(late, key=late.get) in ("Fx", "My")
    assert late["Fx"] > 1.0 > late["Mz"]


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
