"""Masses that the exciters of each set-up move are found together, with truth from point masses at the hub."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.search.refit import fit_until_stable
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


def with_point_mass(mass):
    x, y, z = RIG.hub
    effect = DeclaredEffect(name="added-mass", where=(), parameters={"mass": mass, "x": x, "y": y, "z": z})
    return RIG.model_copy(update={"effects": (effect,)}) if mass else RIG


def sweeps(masses, delay=0.0):
    rng, frequency = np.random.default_rng(3), np.linspace(4.0, 120.0, 100)
    models = {name: balance_model(with_point_mass(mass)) for name, mass in masses.items()}
    runs = [model_lines(models[name], name, COMPONENTS.index(name), frequency, NOISE, rng, delay) for name in masses]
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
    assert labels == ["exciter-mass@Fx", "exciter-mass@My", "exciter-mass@Fx,Fy", "exciter-mass@Fx,Fz"]
    assert not set_up_candidates([both], RIG, replace(SETTINGS, excluded=("exciter-mass",)))
