"""A motion of a large support that a fit has lost is found again."""

import numpy as np

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.rig_scales import inertia_by_motion, stiffness_by_motion
from balance_cli.diagnosis.search import restarts, search
from balance_cli.diagnosis.search.refit import SearchState, fit_until_stable
from balance_cli.diagnosis.search.restarts import restart_one_by_one, restarted_values
from balance_cli.diagnosis.search.rounds import RoundResult
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from tests.support.model_lines import model_lines
from tests.support.rigs import two_degrees_of_freedom

NOISE = 1e-4


def supported_model():
    """A plate that heaves and pitches on a support softer than its cells."""
    rig = two_degrees_of_freedom()
    stiffness, inertia = stiffness_by_motion(rig), inertia_by_motion(rig)
    values = {
        "mass": 0.8 * inertia["z"],
        "inertia_theta": 0.9 * inertia["theta"],
        "compliance_z": 1.4 / stiffness["z"],
        "compliance_theta": 0.9 / stiffness["theta"],
        "damping_ratio": 0.02,
    }
    support = DeclaredEffect(name="support-flexibility", where=("z", "theta"), parameters=values)
    return balance_model(rig.model_copy(update={"effects": (support,)}))


def search_lines_of(model):
    rng, frequency = np.random.default_rng(3), np.linspace(2.0, 80.0, 80)
    runs = [model_lines(model, name, i, frequency, NOISE, rng) for name, i in (("Fz", 2), ("My", 4))]
    batches = stack_runs(runs, (), model.geometry.channel_names)
    return SearchLines(batches, batches)


def test_a_motion_that_a_fit_has_lost_is_found_again():
    true = supported_model()
    lines, name = search_lines_of(true), "support-flexibility@z,theta.compliance_z"
    place = true.parameters.index(name)
    begun_rigid = true.parameters.value.copy()
    begun_rigid[place] *= 1e-9
    stuck = fit_until_stable(true.at(begun_rigid), lines, DEFAULT_SETTINGS.fit)
    assert stuck.error > 0.5
    assert stuck.theta[place] < 1e-6 * true.parameters.value[place]
    found = restart_one_by_one(stuck, lines, DEFAULT_SETTINGS)
    assert found.error < NOISE
    np.testing.assert_allclose(found.theta[place], true.parameters.value[place], rtol=1e-3)


def test_a_model_without_such_effects_stays():
    rigid = balance_model(two_degrees_of_freedom())
    lines = search_lines_of(supported_model())
    state = fit_until_stable(rigid.at(), lines, DEFAULT_SETTINGS.fit)
    assert restart_one_by_one(state, lines, DEFAULT_SETTINGS) is state


def test_a_small_error_restarts_masses_only():
    """Six motions of a support take long; where a little is left they are right, and a mass may still be far off."""
    supported = supported_model()
    mass = DeclaredEffect(name="added-mass", where=(), parameters={"mass": 0.1, "x": 2.0, "y": 0.0, "z": 0.0})
    effects = (*supported.geometry.effects, mass)
    model = balance_model(supported.geometry.model_copy(update={"effects": effects}))
    theta, place = np.array(model.parameters.value), model.parameters.index("added-mass.mass")

    def restarted(error):
        state = SearchState(model, theta, {"sweep": error}, 0.0, 0.0)
        return [np.flatnonzero(values != theta) for values in restarted_values(state, DEFAULT_SETTINGS)]

    assert len(restarted(0.1)) == 6 and [place in changed for changed in restarted(0.01)] == [True, True]


def test_a_state_that_no_restart_has_improved_is_not_restarted_again(monkeypatch):
    model, restarted = supported_model(), []
    stuck = SearchState(model, model.parameters.value, {"sweep-Fz": 0.1}, 0.0, 0.0)
    monkeypatch.setattr(search, "fit_until_stable", lambda *_: stuck)
    monkeypatch.setattr(search, "search_round", lambda *_: RoundResult(None))
    monkeypatch.setattr(search, "add_resonance_by_whole_fit", lambda *_: (None, ()))
    monkeypatch.setattr(search, "restart_if_better", lambda state, *_: restarted.append(state))
    result = search.search(stuck, SearchLines((), ()), lambda what: False, (), tuple, (), DEFAULT_SETTINGS)
    assert result.state is stuck
    assert len(restarted) == 1


def test_restarts_that_describe_little_more_are_not_repeated(monkeypatch):
    """Of a support that hardens, twelve fits were made four times over, each for a thousandth of the error."""
    model, fits = supported_model(), []

    def fit_slightly_better(start, **_):
        fits.append(start)
        return SearchState(start.model, start.theta, {"sweep-Fz": 0.35 - 1e-4 * len(fits)}, -100.0 * len(fits), 0.0)

    monkeypatch.setattr(restarts, "fit_until_stable", fit_slightly_better)
    state = SearchState(model, model.parameters.value, {"sweep-Fz": 0.35}, 0.0, 0.0)
    best = restart_one_by_one(state, SearchLines((), ()), DEFAULT_SETTINGS)
    assert len(fits) == len(restarted_values(state, DEFAULT_SETTINGS)) and best.fit_criterion < state.fit_criterion
