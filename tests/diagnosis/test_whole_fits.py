"""A delay that a fit has taken for damping is found, and a support as soft as the balance; else nothing is tried."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.channel_groups import channel_groups
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.rig_scales import inertia_by_motion, stiffness_by_motion
from balance_cli.diagnosis.search import search as search_module
from balance_cli.diagnosis.search.refit import fit_until_stable, take_steps
from balance_cli.diagnosis.search.rounds import RoundResult, search_round
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.trials import refit_trial
from balance_cli.diagnosis.search.whole_fits import add_by_whole_fit
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from tests.support.model_lines import model_lines
from tests.support.rigs import two_degrees_of_freedom

RIG = two_degrees_of_freedom()
(GROUP,) = [name for name, members in channel_groups(RIG).items() if set(members) == set(RIG.channel_names)]
NOISE = 1e-3


def natural_frequencies():
    model = balance_model(RIG)
    return modes(model.system(model.parameters.value)).frequency


def runs_of(rig, delay=0.0):
    """Two sweeps of a rig, all channels late by `delay` [s]."""
    model, rng = balance_model(rig), np.random.default_rng(5)
    frequency = np.linspace(0.1, 2.0, 120) * natural_frequencies().min()
    return [model_lines(model, name, i, frequency, NOISE, rng, delay) for name, i in (("Fz", 2), ("My", 4))]


def lines_of(rig, delay=0.0):
    """Lines of these sweeps."""
    batches = stack_runs(runs_of(rig, delay), (), RIG.channel_names)
    return SearchLines(batches, batches)


def fitted_state(lines, *effects):
    model = balance_model(RIG.model_copy(update={"effects": effects}))
    return fit_until_stable(model.at(), lines, SETTINGS.fit)


@pytest.fixture(scope="module")
def late():
    """A delay of a fifth of the period of the lowest mode, 72 degrees there."""
    delay = 0.2 / natural_frequencies().min()
    lines = lines_of(RIG, delay)
    return delay, lines, fitted_state(lines)


def test_a_delay_that_damping_has_imitated_is_found(late):
    delay, lines, state = late
    assert state.error > SETTINGS.rounds.gross_error
    found, trials, alternatives = add_by_whole_fit(state, lines, SETTINGS)
    label = f"time-delay@{GROUP}"
    assert [trial.label for trial in trials if trial.decision == "accepted"] == [label]
    assert label in alternatives
    assert found.theta[found.model.parameters.index(f"{label}.delay")] == pytest.approx(delay, rel=2e-3)
    assert found.error < 3 * NOISE


@pytest.mark.parametrize(("cutoff", "period"), [(0.5, 0.0), (0.7, 1.2), (1.0, 2.0)])
def test_commands_in_place_of_loads_are_found(cutoff, period):
    """All exciters follow them as a low-pass of first or second order, here in units of the lowest mode.

    Of first order it was a low-pass of all channels, explained: wind-on loads were 150 and 320 sigma off, unflagged.
    """
    lowest = natural_frequencies().min()
    cutoff, period = cutoff * lowest, period / lowest
    runs = [replace(run, loads=run.loads * follows(run.frequency, cutoff, period)[:, None]) for run in runs_of(RIG)]
    batches = stack_runs(runs, (), RIG.channel_names)
    lines = SearchLines(batches, batches)
    found, trials, _ = add_by_whole_fit(fitted_state(lines), lines, SETTINGS)
    label = "exciter-low-pass@all"
    assert [trial.label for trial in trials if trial.decision == "accepted"] == [label]
    value = found.theta[[found.model.parameters.index(f"{label}.{name}") for name in ("1/cutoff", "natural_period^2")]]
    assert value == pytest.approx([1.0 / cutoff, period**2], rel=4e-3, abs=4e-3 / lowest**2)


def follows(frequency, cutoff, period):
    """What is recorded over the load that follows it."""
    return 1.0 + 1j * frequency / cutoff - (frequency * period) ** 2


def test_the_effect_is_not_tried_where_it_is_excluded(late):
    _, lines, state = late
    _, trials, _ = add_by_whole_fit(state, lines, replace(SETTINGS, excluded=("time-delay",)))
    assert trials and not [trial for trial in trials if trial.label.startswith("time-delay")]


def test_an_effect_of_the_model_is_not_added_again(late):
    delay, lines, _ = late
    present = DeclaredEffect(name="time-delay", where=(GROUP,), parameters={"delay": delay})
    state = fitted_state(lines, present)
    assert add_by_whole_fit(state, lines, SETTINGS) == (state, (), {})


def test_once_the_time_is_over_nothing_more_is_tried_and_fits_hurry(late):
    """After a limit of 5 s, whole fits and restarts of the sample rig went on for 40 s of computing."""
    _, lines, state = late
    hasty = replace(SETTINGS, time_limit=0.0).begin()
    assert add_by_whole_fit(state, lines, hasty) == (state, (), {})
    assert search_module.restart_if_better(state, lines, hasty) is None
    model = balance_model(RIG)
    steps = take_steps(model.at(), lines.fitted, 12, SETTINGS.fit).iterations
    assert take_steps(model.at(), lines.fitted, 12, hasty.fit).iterations <= 3 < steps


def test_nothing_is_tried_where_little_is_missing():
    lines = lines_of(RIG, 1e-3 / natural_frequencies().min())
    state = fitted_state(lines)
    assert add_by_whole_fit(state, lines, SETTINGS) == (state, (), {})


@pytest.mark.parametrize(("heavier", "softer"), [(1.0, 1.0), (2.0, 10.0)])
def test_a_support_as_heavy_and_as_soft_as_the_balance_is_found(heavier, softer):
    """With its own eigenfrequency that of the balance the modes are at 0.62 and 1.62 of it (golden ratio).

    A heavier support on softer springs had ended at the wrong end, stiffer than the cells.
    """
    stiffness = sum(cell.stiffness for cell in RIG.cells)
    truth = {"mass": heavier * RIG.bodies[0].mass, "compliance_z": softer / stiffness, "damping_ratio": 0.01}
    support = DeclaredEffect(name="support-flexibility", where=("z",), parameters=truth)
    lines = lines_of(RIG.model_copy(update={"effects": (support,)}))
    state = fitted_state(lines)
    assert state.error > SETTINGS.rounds.gross_error
    found, trials, _ = add_by_whole_fit(state, lines, SETTINGS)
    (label,) = [trial.label for trial in trials if trial.decision == "accepted"]
    assert label.startswith("support-flexibility@z") and found.error < 3 * NOISE
    fitted = dict(zip(found.model.parameters.names, found.theta.tolist(), strict=True))
    assert fitted[f"{label}.compliance_z"] == pytest.approx(softer / stiffness, rel=0.02)


@pytest.mark.parametrize(
    ("heavier", "softer"),
    [((8.0, 8.0), (0.2, 0.2)), ((8.0, 8.0), (0.5, 0.5)), ((4.0, 8.0), (0.1, 0.3))],
    ids=["heavy", "heavy and soft", "unlike motions"],
)
def test_a_support_whose_modes_are_below_those_of_the_balance_is_found(heavier, softer):
    """Two motions, so that no start has both right: fits from them had ended at 34 to 50 % of the response."""
    inertia, stiffness = inertia_by_motion(RIG), stiffness_by_motion(RIG)
    truth = {
        "mass": heavier[0] * inertia["z"],
        "inertia_theta": heavier[1] * inertia["theta"],
        "compliance_z": softer[0] / stiffness["z"],
        "compliance_theta": softer[1] / stiffness["theta"],
    }
    others = {"damping_ratio": 0.005, "x": 0.02, "z": -0.3}
    support = DeclaredEffect(name="support-flexibility", where=("z", "theta"), parameters={**truth, **others})
    lines = lines_of(RIG.model_copy(update={"effects": (support,)}))
    state = fitted_state(lines)
    found, trials, _ = add_by_whole_fit(state, lines, SETTINGS)
    (label,) = [trial.label for trial in trials if trial.decision == "accepted"]
    fitted = dict(zip(found.model.parameters.names, found.theta.tolist(), strict=True))
    assert found.error < 3 * NOISE
    for name, value in truth.items():
        assert fitted[f"{label}.{name}"] == pytest.approx(value, rel=0.03), name


@pytest.mark.parametrize(("at_once", "next_round"), [(True, 2), (False, 3)])
def test_a_body_is_tried_where_rounds_end_with_a_large_error_or_make_no_progress(monkeypatch, at_once, next_round):
    """Of blind seed 53 they took a dashpot in place of a support; here they find nothing before it, then a mass."""
    if not at_once:
        monkeypatch.setattr(search_module, "_describe_anew", lambda *arguments: None)
    mass = RIG.bodies[0].mass
    truth = {"mass": 5.0 * mass, "compliance_z": 0.05 / sum(cell.stiffness for cell in RIG.cells)}
    support = DeclaredEffect(name="support-flexibility", where=("z",), parameters={**truth, "damping_ratio": 0.01})
    point = {"mass": 0.3 * mass, "x": 0.1, "y": 0.0, "z": 0.3}
    effects = (support, DeclaredEffect(name="added-mass", where=(), parameters=point))
    lines = lines_of(RIG.model_copy(update={"effects": effects}))
    state = fitted_state(lines)
    assert SETTINGS.rounds.stuck_error < state.error < SETTINGS.rounds.gross_error
    rounds, taken = [], refit_trial(1, "parallel-dashpot@z1", 10.0, "accepted", "gain")

    def in_vain_at_first(*arguments):
        rounds.append(arguments[2])
        return RoundResult(None, (taken,)) if len(rounds) == 1 else search_round(*arguments)

    monkeypatch.setattr(search_module, "search_round", in_vain_at_first)
    result = search_module.search(state, lines, lambda text: False, (), tuple, (), SETTINGS)
    accepted = [trial.label.split("@")[0] for trial in result.trials if trial.decision == "accepted"]
    assert accepted == ["support-flexibility", "added-mass"]
    assert result.state.error < 3 * NOISE
    assert rounds[:2] == [1, next_round] and [trial.round for trial in result.trials[:2]] == [1, next_round - 1]
    assert result.trials[0].decision == "removed" and "describes more" in result.trials[0].reason
