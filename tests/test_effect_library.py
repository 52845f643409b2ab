"""Every effect of the library through the same checks: nothing at its null, exact slopes, kept by a model's file."""

import numpy as np
import pytest
from rigs import rotor_balance

from balance_cli.effects import EFFECTS
from balance_cli.errors import UserError
from balance_cli.estimation.likelihood import data_chi2, data_curvature, exciter_response
from balance_cli.estimation.measurements import stacked
from balance_cli.geometry import DeclaredEffect
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects, declared_effects
from balance_cli.model.system import output_slopes, response, solve
from balance_cli.simulation import short_plan, simulate_campaign, true_rig
from balance_cli.spectra import measured_spectra

RIG = rotor_balance()
FREQUENCY = np.linspace(3.0, 149.0, 37)
PLACED = [(effect, where) for effect in EFFECTS for where in dict.fromkeys(effect.places(RIG)[i] for i in (0, -1))]
IDS = [f"{effect.name}@{','.join(where)}" for effect, where in PLACED]
SPIN = 17.5


def model_with(effect, where, at_null):
    """The rig with the effect, its parameters at their nulls or a good way from them."""
    parameters = {}
    for one in effect.parameters(RIG, where):
        fitted = one.fitted_start if one.secondary else one.fitted_null + (0.0 if at_null else one.fitted_scale)
        if at_null and one.secondary:
            fitted = one.fitted_start
        value = one.natural(fitted)
        if np.isfinite(value):
            parameters[one.name] = float(value)
    declared = DeclaredEffect(name=effect.name, where=where, parameters=parameters)
    return balance_model(RIG.model_copy(update={"effects": (declared,)})).all_free()


def own_parameters(model, effect):
    own = [i for i, name in enumerate(model.parameters.names) if name.startswith(f"{effect.name}@")]
    own = own or [i for i, name in enumerate(model.parameters.names) if name.startswith(effect.name)]
    assert own
    return own


@pytest.fixture(scope="module")
def batches():
    """One sweep and a static run of the rig as declared, with noise, means and waveforms."""
    plan = short_plan()
    kept = tuple(one for one in plan.runs if one.run in ("sweep-Fx", "sweep-Fz", "static-trim"))
    runs, _ = simulate_campaign(true_rig(RIG), plan.model_copy(update={"runs": kept}), seed=2)
    spectra = measured_spectra(runs, RIG, means=True)
    return stacked(spectra.lines, spectra.statics, RIG.channel_names)


def measured(system):
    return exciter_response(system, solve(system, FREQUENCY, SPIN))


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_nothing_at_the_null(effect, where):
    rigid = measured(balance_model(RIG).system())
    np.testing.assert_allclose(measured(model_with(effect, where, True).system()), rigid, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_slopes_are_the_derivatives(effect, where):
    model = model_with(effect, where, False)
    theta, scale = model.parameters.value, model.parameters.scale
    system = model.system(theta)
    rng = np.random.default_rng(0)
    loads = rng.standard_normal((len(FREQUENCY), 6)) + 1j * rng.standard_normal((len(FREQUENCY), 6))
    solution = solve(system, FREQUENCY, SPIN)
    slopes = output_slopes(system, solution, np.arange(len(FREQUENCY)), loads @ system.spill.value.T)
    slopes = slopes + response(system, solution) @ np.einsum("pij,kj->kip", system.spill.slope, loads)
    own = own_parameters(model, effect)
    for i in [*own, model.parameters.index("stiffness.z1"), model.parameters.index("centre_of_gravity.z")]:
        step = 1e-5 * scale[i] * np.eye(len(theta))[i]
        above, below = (np.einsum("kcj,kj->kc", measured(model.system(theta + s)), loads) for s in (step, -step))
        numerical = (above - below) / (2e-5 * scale[i])
        size = max(np.abs(numerical).max(), 1e-9 * np.abs(above).max() / scale[i])
        np.testing.assert_allclose(slopes[:, :, i], numerical, atol=1e-4 * size, err_msg=model.parameters.names[i])


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_nothing_in_the_likelihood_at_the_null(effect, where, batches):
    rigid = data_chi2(batches, balance_model(RIG).system())
    assert data_chi2(batches, model_with(effect, where, True).system()) == pytest.approx(rigid, rel=1e-6)


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_slopes_of_the_likelihood_are_the_derivatives(effect, where, batches):
    model = model_with(effect, where, False)
    theta, scale = model.parameters.value, model.parameters.scale
    gradient = 2.0 * data_curvature(batches, model.system(theta)).gradient
    for i in [*own_parameters(model, effect), model.parameters.index("stiffness.z1")]:
        step = 1e-4 * scale[i] * np.eye(len(theta))[i]
        above, below = (data_chi2(batches, model.system(theta + s)) for s in (step, -step))
        numerical = (above - below) / 2e-4
        assert gradient[i] * scale[i] == pytest.approx(numerical, rel=1e-2, abs=1e-5 * above), model.parameters.names[i]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_it_does_something_away_from_its_null(effect, batches):
    where = effect.places(RIG)[0]
    rigid = data_chi2(batches, balance_model(RIG).system())
    changed = data_chi2(batches, model_with(effect, where, False).system())
    spinning = measured(model_with(effect, where, False).system()) - measured(balance_model(RIG).system())
    assert abs(changed - rigid) > 1e-3 or np.abs(spinning).max() > 1e-6


def test_unknown_effects_and_places_name_the_nearest():
    with pytest.raises(UserError, match="channel-gain"):
        declared_effects(add_effects(RIG, ["chanel-gain@x.strain"]))
    with pytest.raises(UserError, match=r"x\.strain"):
        declared_effects(add_effects(RIG, ["channel-gain@x.strian"]))


def test_the_order_of_declaration_does_not_matter():
    one = add_effects(RIG, ["time-delay@x.piezo", "transverse-stiffness@all"])
    other = add_effects(RIG, ["transverse-stiffness@all", "time-delay@x.piezo"])
    assert [item.label for item in declared_effects(one)] == [item.label for item in declared_effects(other)]
