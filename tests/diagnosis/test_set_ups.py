"""Masses, stiffnesses and lags of the exciters of each set-up are found together, beside point masses at the hub."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.search.refit import fit_until_stable
from balance_cli.diagnosis.search.search import search
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.set_ups import add_set_ups_by_whole_fit, set_up_candidates
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from tests.support.model_lines import model_lines
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
NOISE = 3e-4
MASSES = {"Fx": 3.0, "Fz": 0.0, "My": 6.0}
"""Of a point at the hub [kg], while this component is excited: it moves along x, y and z."""


def with_point_mass(_, mass):
    x, y, z = RIG.hub
    effect = DeclaredEffect(name="added-mass", where=(), parameters={"mass": mass, "x": x, "y": y, "z": z})
    return RIG.model_copy(update={"effects": (effect,)}) if mass else RIG


def with_stinger(excited, stiffness):
    places = (tuple(dict.fromkeys((excited, along))) for along in ("Fx", "Fy", "Fz"))
    values = {"name": "exciter-stiffness", "parameters": {"stiffness": stiffness}}
    return RIG.model_copy(update={"effects": tuple(DeclaredEffect(where=where, **values) for where in places)})


def sweeps(values, delay=0.0, rig_with=with_point_mass):
    rng, frequency = np.random.default_rng(3), np.linspace(4.0, 120.0, 100)
    models = {name: balance_model(rig_with(name, value)) for name, value in values.items()}
    runs = [model_lines(models[name], name, COMPONENTS.index(name), frequency, NOISE, rng, delay) for name in values]
    return [replace(run, covariance=run.covariance + unloaded_noise(run)) for run in runs]


def unloaded_noise(run):
    """The torque meter has no signal in these sweeps, and would have no noise."""
    variance = run.covariance[0].diagonal().real
    return np.diag(np.where(variance == 0.0, variance[variance > 0.0].min(), 0.0))


def started(runs):
    batches = stack_runs(runs, (), RIG.channel_names)
    lines, model = SearchLines(batches, batches), balance_model(RIG)
    return lines, fit_until_stable(model.at(), lines, SETTINGS.fit)


def label(excited, along):
    return f"exciter-mass@{','.join(dict.fromkeys((excited, along)))}"


def test_masses_of_all_set_ups_are_found_together():
    runs = sweeps(MASSES)
    lines, state = started(runs)
    pool = set_up_candidates(runs, RIG, SETTINGS)
    found, trials, _ = add_set_ups_by_whole_fit(state, state, pool, lines, 1, SETTINGS)
    masses = {label(a, b): mass for a, mass in MASSES.items() if mass for b in ("Fx", "Fy", "Fz")}
    assert {trial.label for trial in trials if trial.decision == "accepted"} == set(masses)
    values = dict(zip(found.model.parameters.names, found.theta.tolist(), strict=True))
    for name, mass in masses.items():
        assert values[f"{name}.mass"] == pytest.approx(mass, rel=0.05)
    assert found.error < 3 * NOISE
    assert state.error > 10 * found.error


def test_stingers_are_found_by_a_search_after_its_first_round():
    """They hold the hub along all axes while a component is excited: one stiffness alone describes little."""
    stiffnesses = {"Fx": 3e4, "My": 5e4}
    runs = sweeps(stiffnesses, rig_with=with_stinger)
    lines, state = started(runs)
    pool = set_up_candidates(runs, RIG, SETTINGS)
    result = search(state, lines, lambda _: False, (), lambda: (), pool, SETTINGS)
    kept = {trial.label for trial in result.trials if trial.decision == "accepted"}
    expected = {label(a, b).replace("mass", "stiffness"): k for a, k in stiffnesses.items() for b in ("Fx", "Fy", "Fz")}
    assert kept == set(expected)
    values = dict(zip(result.state.model.parameters.names, result.state.theta.tolist(), strict=True))
    for name, stiffness in expected.items():
        # Along z they are 0.2 % of that of the cells.
        assert values[f"{name}.stiffness"] == pytest.approx(stiffness, rel=0.15 if name.endswith("Fz") else 0.02)
    assert {trial.round for trial in result.trials} == {1}


def with_lag(excited, corner):
    lag = {"cutoff": corner, "natural_period": 0.8 / corner}
    return RIG.model_copy(
        update={"effects": (DeclaredEffect(name="exciter-low-pass", where=(excited,), parameters=lag),)}
    )


def test_commands_that_each_exciter_follows_in_its_own_way_are_found_together():
    corners = {"Fx": 30.0, "Fz": 90.0, "My": 300.0}
    runs = sweeps(corners, rig_with=with_lag)
    lines, state = started(runs)
    found, trials, _ = add_set_ups_by_whole_fit(
        state, state, set_up_candidates(runs, RIG, SETTINGS), lines, 1, SETTINGS
    )
    assert {f"exciter-low-pass@{name}" for name in corners} <= {t.label for t in trials if t.decision == "accepted"}
    for name, corner in corners.items():
        lag = found.system().equations.load_lag.value[COMPONENTS.index(name)]
        assert lag == pytest.approx([0.5 / (np.pi * corner), (0.4 / (np.pi * corner)) ** 2], rel=0.02)


def test_what_they_leave_large_is_not_theirs():
    """A delay of all channels beside them is no mass: so many values describe a part of any cause."""
    lines, state = started(sweeps(MASSES, delay=2e-3))
    pool = set_up_candidates(sweeps(MASSES), RIG, SETTINGS)
    assert add_set_ups_by_whole_fit(state, state, pool, lines, 1, SETTINGS)[0] is None


def test_nothing_is_tried_where_little_is_missing():
    runs = sweeps(dict.fromkeys(MASSES, 0.0))
    lines, state = started(runs)
    pool = set_up_candidates(runs, RIG, SETTINGS)
    assert add_set_ups_by_whole_fit(state, state, pool, lines, 1, SETTINGS) == (None, (), {})


def test_places_that_act_in_the_same_runs_are_tried_once():
    """Two components that are always excited together have exciters that move as one."""
    (run,) = sweeps({"Fx": 0.0})
    both = replace(run, components=("Fx", "My"))
    labels = [item.label for item in set_up_candidates([both], RIG, SETTINGS)]
    kinds, places = ("exciter-mass", "exciter-stiffness"), ("Fx", "My", "Fx,Fy", "Fx,Fz")
    lags = {"exciter-low-pass@Fx", "exciter-low-pass@My"}
    assert {*labels} == {f"{kind}@{place}" for kind in kinds for place in places} | lags
    assert not set_up_candidates([both], RIG, replace(SETTINGS, excluded=(*kinds, "exciter-low-pass")))
