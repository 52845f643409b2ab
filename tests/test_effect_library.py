"""Every effect of the library through the same checks: nothing at its null, exact slopes, kept by a model's file."""

import numpy as np
import pytest
from rigs import rotor_balance

from balance_cli.effects import EFFECTS
from balance_cli.errors import UserError
from balance_cli.estimation.likelihood import exciter_response
from balance_cli.geometry import DeclaredEffect
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects, declared_effects
from balance_cli.model.system import output_slopes, response, solve

RIG = rotor_balance()
FREQUENCY = np.linspace(3.0, 149.0, 37)
PLACED = [(effect, where) for effect in EFFECTS for where in dict.fromkeys(effect.places(RIG)[i] for i in (0, -1))]
IDS = [f"{effect.name}@{','.join(where)}" for effect, where in PLACED]
SPIN = 17.5


def model_with(effect, where, at_null):
    """The rig with the effect, its parameters at their nulls or a good way from them."""
    parameters = {}
    for one in effect.parameters(RIG, where):
        fitted = one.fitted_start if one.secondary else one.fitted_null + (0.0 if at_null else one.scale)
        if at_null and one.secondary:
            fitted = one.fitted_start
        value = one.fitted(fitted)
        if np.isfinite(value):
            parameters[one.name] = float(value)
    declared = DeclaredEffect(name=effect.name, where=where, parameters=parameters)
    return balance_model(RIG.model_copy(update={"effects": (declared,)})).all_free()


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
    own = [i for i, name in enumerate(model.parameters.names) if name.startswith(effect.name)]
    assert own
    for i in [*own, model.parameters.index("stiffness.z1"), model.parameters.index("centre_of_gravity.z")]:
        step = 1e-5 * scale[i] * np.eye(len(theta))[i]
        above, below = (np.einsum("kcj,kj->kc", measured(model.system(theta + s)), loads) for s in (step, -step))
        numerical = (above - below) / (2e-5 * scale[i])
        size = max(np.abs(numerical).max(), 1e-9 * np.abs(above).max() / scale[i])
        np.testing.assert_allclose(slopes[:, :, i], numerical, atol=1e-4 * size, err_msg=model.parameters.names[i])


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_it_does_something_away_from_its_null(effect):
    where = effect.places(RIG)[0]
    rigid = measured(balance_model(RIG).system())
    changed = measured(model_with(effect, where, False).system())
    assert np.abs(changed - rigid).max() > 1e-6 * np.abs(rigid).max()


def test_unknown_effects_and_places_name_the_nearest():
    with pytest.raises(UserError, match="channel-gain"):
        declared_effects(add_effects(RIG, ["chanel-gain@x.strain"]))
    with pytest.raises(UserError, match=r"x\.strain"):
        declared_effects(add_effects(RIG, ["channel-gain@x.strian"]))


def test_the_order_of_declaration_does_not_matter():
    one = add_effects(RIG, ["time-delay@x.piezo", "transverse-stiffness@all"])
    other = add_effects(RIG, ["transverse-stiffness@all", "time-delay@x.piezo"])
    assert [item.label for item in declared_effects(one)] == [item.label for item in declared_effects(other)]
