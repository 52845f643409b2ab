"""Load series, what they support, and which terms a channel has."""

import numpy as np
import pytest

from balance_cli.calibration import selection
from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.channel_rows import ChannelRows
from balance_cli.calibration.fit import fit_calibration_model
from balance_cli.calibration.least_squares import solve_least_squares
from balance_cli.calibration.load_series import describe_load_series, find_load_series
from balance_cli.calibration.normal_equations import TermNormalEquations
from balance_cli.calibration.selection import select_terms
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.calibration.term_search import search_terms
from balance_cli.calibration.term_support import find_supported_terms
from balance_cli.calibration.terms import all_terms, term_from_name, term_values
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.simulation import CampaignPlan, draw_rig, simulate_campaign
from balance_cli.steps.calibrate import calibrate
from tests.support.calibration_stand import CHANNELS, NONLINEAR_TERMS, stand_loads, stand_points
from tests.support.other_rigs import other_rig, short_campaign

TERMS = all_terms(6)


def place(name):
    return TERMS.index(term_from_name(name, COMPONENTS))


# ---- sequences -------------------------------------------------------------------------------------------------------


def test_sequences_are_those_that_were_loaded():
    x, sequence = stand_loads()
    np.testing.assert_array_equal(find_load_series(x, np.zeros(len(x), int)), sequence)


def test_runs_are_never_one_sequence():
    x = np.outer(np.linspace(0.0, 1.0, 10), np.eye(6)[0])
    run = np.repeat([0, 1], 5)
    np.testing.assert_array_equal(find_load_series(x, run), run)


def test_a_load_that_hangs_on_the_other_side_begins_a_sequence():
    ramp = np.r_[np.arange(6), np.arange(4, -1, -1)] / 5.0
    x = np.zeros((33, 6))
    x[:22, 0], x[:, 1] = np.r_[ramp, -ramp], np.r_[np.full(11, 0.6), np.full(11, -0.6), ramp]
    np.testing.assert_array_equal(find_load_series(x, np.zeros(33, int)), np.repeat([0, 1, 2], 11))


def test_a_sequence_in_words():
    x, sequence = stand_loads()
    assert describe_load_series(np.flatnonzero(sequence == 1), "s1", COMPONENTS, x) == "s1 rows 21 to 40 (Fy)"


# ---- support ---------------------------------------------------------------------------------------------------------


def test_the_whole_schedule_supports_all_terms():
    x, sequence = stand_loads()
    found = find_supported_terms(TERMS, x, sequence, COMPONENTS)
    assert found.terms == TERMS and found.unsupported == {}


def test_reasons_why_terms_are_not_supported():
    x, sequence = stand_loads()
    alone = (x != 0).sum(axis=1) <= 1
    x, sequence = x[alone & (x[:, 5] == 0)], sequence[alone & (x[:, 5] == 0)]
    up = x[:, 1] >= 0
    found = find_supported_terms(TERMS, x[up], sequence[up], COMPONENTS)
    reasons = {term.name(COMPONENTS): reason for term, reason in found.unsupported.items()}
    assert reasons["Mz^2"] == "Mz was never loaded"
    assert reasons["Fx Fz"] == "Fx and Fz were never loaded together"
    assert reasons["|Fy|"] == "Fy was never loaded downwards"
    assert "Fx^2" not in reasons and "Fx|Fx|" not in reasons and "|Fx|" not in reasons
    # To one side only F|F| is F^2.
    assert ("Fy^2" in reasons) != ("Fy|Fy|" in reasons) or reasons["Fy|Fy|"] == "does what Fy^2 does in these loads"


def test_a_load_to_one_side_only_tells_no_odd_from_even_terms():
    x, sequence = stand_loads()
    up = np.all(x >= 0, axis=1)
    found = find_supported_terms(TERMS, x[up], sequence[up], COMPONENTS)
    kept = {term.name(COMPONENTS) for term in found.terms}
    assert "Fx^2" in kept and "Fx|Fx|" not in kept
    assert found.unsupported[term_from_name("Fx|Fx|", COMPONENTS)] == "does what Fx^2 does in these loads"


# ---- selection -------------------------------------------------------------------------------------------------------


def readings(terms, sigma=5e-4, seed=0):
    """Columns of all terms, one output with these terms beside the loads, and the sequences."""
    rng = np.random.default_rng(seed)
    x, sequence = stand_loads()
    X = term_values(TERMS, x)
    y = X[:, :6] @ rng.normal(size=6) + sum((value * X[:, place(name)] for name, value in terms.items()), 0.0)
    zeros = rng.normal(size=sequence[-1] + 1)[sequence]
    return X, (y + zeros + sigma * rng.normal(size=len(x)))[:, None], sequence


def chosen(terms, **more):
    X, Y, sequence = readings(terms, **more)
    (found,) = select_terms(X, Y, sequence, sequence, 6)
    assert found[:6] == tuple(range(6))
    return {TERMS[i].name(COMPONENTS) for i in found[6:]}


@pytest.mark.parametrize(
    "terms",
    [
        {},
        {"Fx^2": 0.01},
        {"|Fy|": 0.005, "Fy Fz": -0.008},
        {"Mx |My|": 0.01, "|Mx| My": 0.01, "|Mx My|": -0.01},
        {"Mz^3": 0.02, "|Fz^3|": 0.01, "Fx|Fx|": -0.02, "Fy |Mz|": 0.006},
    ],
)
def test_the_terms_that_are_there_are_found_and_no_others(terms):
    assert chosen(terms) == set(terms)


def test_two_terms_that_nearly_cancel_are_found_together():
    """Beside the load itself F|F| and F^3 are 97 % alike: with opposite signs neither shows without the other."""
    assert chosen({"My|My|": -0.0104, "My^3": 0.0073}, sigma=3e-4) == {"My|My|", "My^3"}


def test_terms_are_replaced_when_better_ones_have_come_in(monkeypatch):
    """|F| and |F^3| together look like F^2 at first; only replacement finds back."""
    terms = {"Fy^3": -0.0069, "|Fx|": -0.0105, "|Fx^3|": -0.0087}
    assert chosen(terms) == set(terms)
    monkeypatch.setattr(selection, "_replace_sequentially", lambda normal, found, straight: found)
    assert chosen(terms) != set(terms)


def test_a_term_that_is_no_longer_significant_goes():
    X, Y, sequence = readings({"Fx Fy": 0.01})
    w = np.ones(len(X))
    Xs = subtract_block_means(X, sequence, w)
    y = subtract_block_means(Y, sequence, w)[:, 0]
    normal = TermNormalEquations(Xs.T @ Xs, Xs.T @ y, float(y @ y), len(X) - sequence[-1] - 1)
    kept = [*range(6), place("Fx Fy")]
    assert selection._eliminate_backward(normal, [*kept, place("Mz^2"), place("|Fx Fy|")], 6, 1e-5) == kept
    # The loads stay, whether they are significant or not.
    assert selection._eliminate_backward(normal, kept, 6, 0.0) == list(range(6))


def test_spurious_terms_are_as_rare_as_the_level_says(monkeypatch):
    """With the level at one a half, half of all balances without curved terms may get one; at 0.01 next to none."""
    x, sequence = stand_loads()
    X = term_values(TERMS, x)
    rng = np.random.default_rng(5)
    Y = rng.normal(size=(len(x), 200))
    for rule in ("_cross_validate", "_drop_terms_of_few_rows", "_best_predictor"):
        monkeypatch.setattr(selection, rule, lambda found, *_: tuple(found))
    strict = sum(len(one) > 6 for one in select_terms(X, Y, sequence, sequence, 6))
    loose = sum(len(one) > 6 for one in select_terms(X, Y, sequence, sequence, 6, significance=40.0))
    # Expected 0.01 and, by the bound of Bonferroni for terms that are alike in part, 20 to 40.
    assert strict == 0 and 10 <= loose <= 45


def test_a_term_that_does_not_help_sequences_left_out_goes():
    """One sequence alone is curved, strongly: significant as the term is, all others are predicted better without."""
    X, Y, sequence = readings({"Mx^2": 0.01})
    own, true = place("Fz^2"), place("Mx^2")
    rows = sequence == 2
    Y[rows] += 0.01 * X[rows][:, [own]]
    whole, w = [*range(6), own, true], np.ones(len(X))
    assert solve_least_squares(X[:, whole], Y, sequence).t[6, 0] > 5.0
    kept = selection._cross_validate(whole, ChannelRows(X, Y[:, 0], sequence, sequence, 6, w))
    assert kept == (*range(6), true)


def test_fit_finds_the_terms_of_every_channel():
    model = fit_calibration_model(stand_points()).model
    for channel in CHANNELS:
        found = {name for name in model.channel_coefficients(channel) if name not in COMPONENTS}
        assert found == set(NONLINEAR_TERMS.get(channel, {})), channel
        for name, value in NONLINEAR_TERMS.get(channel, {}).items():
            row, c = model.terms.index(name), CHANNELS.index(channel)
            assert abs(model.coefficients[row, c] - value) < 5.0 * np.sqrt(model.covariance[c, row, row])
    assert fit_calibration_model(stand_points(), choice=LINEAR_TERMS).model.terms == COMPONENTS


def test_loads_that_change_at_once_are_one_load_series():
    """Zeros of segments in which one load only replaces another would be collinear with the loads."""
    x = np.repeat(np.vstack([np.eye(6), -np.eye(6)]), 2, axis=0)
    assert not find_load_series(x, np.zeros(24, int)).any()
    # With each load by itself between, it is not so.
    apart = np.vstack([np.outer(np.arange(4) / 3.0, one) for one in np.eye(6)])
    assert find_load_series(apart, np.zeros(24, int))[-1] == 5


def test_errors_of_applied_loads_are_no_terms():
    """Of a linear rig whose moments err by 0.25 %, four of these six calibrations had a term, at a level of 1 %."""
    plan = short_campaign("E")
    plan = CampaignPlan(runs=tuple(run for run in plan.runs if run.kind == "static"))
    nonlinear = 0
    for seed in range(6):
        rig = draw_rig(other_rig("E"), np.random.default_rng([seed, 5]))
        all_trims = calibrate(simulate_campaign(rig, plan, seed=seed).runs, other_rig("E")).all_trims
        nonlinear += all_trims.model.is_nonlinear
    assert nonlinear == 0


def test_a_term_is_found_beside_errors_of_its_load():
    ladder = np.r_[np.arange(1, 5), [3, 2, 1, 0], -np.arange(1, 5), [-3, -2, -1, 0]] / 4.0
    x, series, weight = np.kron(np.eye(6), ladder[:, None]), np.repeat(np.arange(6), len(ladder)), np.ones(96)
    supported = find_supported_terms(TERMS, x, series, COMPONENTS).terms
    squares = (*range(6), supported.index(term_from_name("Mz^2", COMPONENTS)))
    found = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        errors = np.where(x != 0.0, 5e-3 * rng.standard_normal(x.shape), 0.0)
        Y = x @ rng.standard_normal((6, 2)) + 0.05 * x[:, [5]] ** 2 + 1e-4 * rng.standard_normal((96, 2))
        selected = search_terms(term_values(supported, x + errors), Y, x + errors, series, weight)
        found += selected == [squares, squares]
    assert found >= 8
