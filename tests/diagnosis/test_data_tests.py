"""Tests without a model of the plate, on lines of a rig that no model describes and on simulated campaigns."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.data_tests.channel_pairs import channel_pairs, channel_tests
from balance_cli.diagnosis.data_tests.mains_detection import mains_tests
from balance_cli.diagnosis.data_tests.model_free import model_free_tests
from balance_cli.diagnosis.data_tests.run_pairs import level_tests, spin_tests
from balance_cli.diagnosis.data_tests.static_pairs import static_tests
from balance_cli.diagnosis.search.initial_candidates import initial_candidates
from balance_cli.diagnosis.search.spin_candidates import spin_candidates
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.diagnosis.significance import bonferroni_min_p_value, chi2_p_value, format_with_sigma
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.simulation import CampaignPlan, SweepPlan, draw_rig, short_plan, simulate_campaign, true_rig
from balance_cli.simulation.rig import apply_effects
from tests.support.simulated_lines import (
    FREQUENCY,
    LOAD_NOISE,
    MODES,
    NAMES,
    NOISE,
    RIG,
    circular_noise,
    response,
    static,
    swept_lines,
)

S = 2j * np.pi * FREQUENCY


def number(finding: str, word: str) -> tuple[float, float]:
    """The figure after a word, and its sigma."""
    value, sigma = finding.partition(word)[2].split("+/-")[:2]
    return float(value.split()[-1]), float(sigma.split()[0])


# ---- probabilities ---------------------------------------------------------------------------------------------------


def test_chances_with_noise_that_was_measured_are_even():
    """Chi-square over several runs, each with its own estimated variance."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(2000):
        total = 0.0
        for n, d in ((40, 60), (20, 120), (100, np.inf)):
            variance = rng.chisquare(d) / d if np.isfinite(d) else 1.0
            total += rng.chisquare(n) / variance * ((d - 2) / d if np.isfinite(d) else 1.0)
        found.append(chi2_p_value(total, (40, 20, 100), (60, 120, np.inf)))
    assert kstest(found, "uniform").pvalue > 1e-3


def test_several_looks_are_counted():
    assert bonferroni_min_p_value([0.5, 0.01, 0.3, 0.2]) == pytest.approx(0.04)
    assert bonferroni_min_p_value([]) == 1.0


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [(0.60033, 0.00012, "0.60033 +/- 0.00012 ms"), (84.23, 3.1, "84.2 +/- 3.1 ms"), (1234.0, 56.0, "1234 +/- 56 ms")],
)
def test_figures_have_two_digits_of_sigma(value, sigma, text):
    assert format_with_sigma(value, sigma, "ms") == text


# ---- channels of one cell --------------------------------------------------------------------------------------------

CHANGES = {
    "delay": (np.exp(-S * 6e-4), "z3.piezo is late by", 0.6),
    "large delay": (np.exp(-S * 8e-3), "z3.piezo is late by", 8.0),
    "gain": (np.full(len(S), 1.004), "z3.piezo reads", 1.004),
    "low-pass": (1 / (1 + S / (2 * np.pi * 400.0)), "z3.piezo has a further low-pass at", 400.0),
    "high-pass": (S / (S + 1 / 2.0), "z3.piezo has a further high-pass, time constant", 2.0),
}


@pytest.mark.parametrize("name", CHANGES)
def test_the_simplest_difference_of_two_channels_is_found(name):
    factor, words, truth = CHANGES[name]
    runs = [
        swept_lines("Fz", 10.0, 1, changed={"z3.piezo": factor}),
        swept_lines("Mx", 4.0, 2, changed={"z3.piezo": factor}),
    ]
    rows = {row.place: row for row in channel_tests(runs, RIG, SETTINGS)}
    assert len(rows) == len(channel_pairs(RIG)) == 7
    changed = rows.pop("z3.strain, z3.piezo")
    assert changed.p_value < 1e-12
    assert changed.finding.startswith(words) and ";" not in changed.finding
    value, sigma = number(changed.finding, words)
    assert abs(value - truth) < 4 * sigma
    for row in rows.values():
        assert row.finding == "equal" and row.p_value > 1e-3
        assert row.chi2 == pytest.approx(row.dof, abs=5 * np.sqrt(2 * row.dof))


def test_the_first_channel_can_be_the_late_one():
    (row,) = (
        r
        for r in channel_tests([swept_lines(changed={"x.strain": np.exp(-S * 1e-3)})], RIG, SETTINGS)
        if r.p_value < 1e-6
    )
    assert row.finding.startswith("x.strain is late by 1.00") and row.finding.endswith("against x.piezo")


def test_a_filter_in_the_first_channel_is_laid_to_it():
    factor = 1 / (1 + S / (2 * np.pi * 300.0))
    (row,) = (r for r in channel_tests([swept_lines(changed={"y1.strain": factor})], RIG, SETTINGS) if r.p_value < 1e-6)
    assert row.finding.startswith("y1.strain has a further low-pass at 30")


def test_two_differences_are_both_named():
    factor = 1.01 * np.exp(-S * 5e-4)
    (row,) = (r for r in channel_tests([swept_lines(changed={"y1.piezo": factor})], RIG, SETTINGS) if r.p_value < 1e-6)
    for word, truth in (("late by", 0.5), ("reads", 1.01)):
        value, sigma = number(row.finding, word)
        assert abs(value - truth) < 4 * sigma


def test_two_differences_are_two_seeds_and_the_plate_decides_whose_each_is():
    factor = np.exp(-S * 5e-4) * S / (S + 1 / 2.0)
    runs = [
        swept_lines("Fz", 10.0, 1, changed={"z3.piezo": factor}),
        swept_lines("Mx", 4.0, 2, changed={"z3.piezo": factor}),
    ]
    late, forgets = initial_candidates(runs, RIG, SETTINGS)
    assert {one.label for one in late.candidates} == {"time-delay@z3.piezo", "time-delay@z3.strain"}
    assert sorted(one.starts[0]["delay"] for one in late.candidates) == pytest.approx([-5e-4, 5e-4], rel=0.01)
    (one,) = forgets.candidates
    assert one.label == "high-pass@z3.piezo"
    assert one.starts[0]["cutoff"] == pytest.approx(1 / (4 * np.pi), rel=0.05)


def test_what_is_no_simple_difference_is_said_to_be_neither():
    factor = 1 + 0.05 / (1 - (FREQUENCY / 80.0) ** 2 + 0.04j * FREQUENCY / 80.0)
    runs = [swept_lines(changed={"z1.piezo": factor})]
    (row,) = (r for r in channel_tests(runs, RIG, SETTINGS) if r.p_value < 1e-6)
    assert "neither delay, gain nor filter" in row.finding
    assert not initial_candidates(runs, RIG, SETTINGS)


def test_gains_within_their_tolerance_are_no_finding():
    tolerant = RIG.model_copy(update={"tolerances": RIG.tolerances.model_copy(update={"sensitivity": 0.01})})
    run = swept_lines(changed={"z2.piezo": np.full(len(S), 1.008), "z4.piezo": 1.008 * np.exp(-S * 3e-4)})
    rows = {row.place: row for row in channel_tests([run], tolerant, SETTINGS)}
    assert rows["z2.strain, z2.piezo"].finding == "equal"
    assert rows["z4.strain, z4.piezo"].finding.startswith("z4.piezo is late by 0.30")
    assert channel_tests([run], RIG, SETTINGS)[4].p_value < 1e-12


def test_chances_of_equal_channels_are_even_with_noise_from_few_periods():
    """Nothing is there: about as many small probabilities as there should be, none too many."""
    found = [
        row.p_value
        for seed in range(30)
        for row in channel_tests(
            [swept_lines(seed=seed, dof=80.0), swept_lines("Mx", 5.0, seed + 100, dof=80.0)], RIG, SETTINGS
        )
    ]
    assert np.mean(np.array(found) < 0.05) < 0.08
    assert min(found) > 1e-5


def test_a_channel_that_is_not_live_is_left_out():
    run = swept_lines()
    kept = [i for i, name in enumerate(NAMES) if name != "x.piezo"]
    signals = np.array([*kept, len(NAMES)])
    less = replace(
        run,
        channel_names=tuple(NAMES[i] for i in kept),
        channels=run.channels[:, kept],
        covariance=run.covariance[:, signals[:, None], signals],
    )
    assert [row.place for row in channel_tests([less], RIG, SETTINGS)] == [
        row.place for row in channel_tests([run], RIG, SETTINGS) if not row.place.startswith("x.")
    ]


# ---- static against low frequency ------------------------------------------------------------------------------------


def test_statics_that_are_the_response_at_rest():
    runs = [
        swept_lines(name, level, seed) for seed, (name, level) in enumerate((("Fz", 10.0), ("Fz", 4.0), ("My", 5.0)))
    ]
    rows = static_tests(runs, [static()], RIG, float(MODES[0]), SETTINGS.data_tests)
    assert [row.place for row in rows] == ["static: Fz", "static: My"]
    for row in rows:
        assert row.dof == 8 and row.p_value > 1e-3 and row.finding == "equal"


def test_a_lowest_mode_that_is_not_quite_known_does_no_harm():
    for lowest in (0.8 * MODES[0], 1.15 * MODES[0]):
        assert all(
            row.p_value > 1e-3
            for row in static_tests([swept_lines(noise=0.1)], [static()], RIG, float(lowest), SETTINGS.data_tests)
        )


def test_a_static_stiffness_of_its_own_is_found():
    factor = np.ones(8)
    factor[5] = 1.02
    row = static_tests([swept_lines(level=40.0)], [static(factor)], RIG, float(MODES[0]), SETTINGS.data_tests)[0]
    assert row.p_value < 1e-6
    assert "most in z3.strain" in row.finding
    change, sigma = number(row.finding, "z3.strain:")
    true = 0.02 * response("Fz", np.array([0.0]))[0, NAMES.index("z3.strain")].real / 0.002
    assert abs(change - true) < 4 * sigma


def test_chances_of_statics_are_even():
    found = [
        row.p_value
        for seed in range(60)
        for row in static_tests(
            [swept_lines(seed=seed, dof=150.0)], [static(seed=seed)], RIG, float(MODES[0]), SETTINGS.data_tests
        )
    ]
    assert np.mean(np.array(found) < 0.05) <= 0.12
    assert min(found) > 1e-4


def test_one_force_beside_the_hub_tells_no_responses_at_rest():
    """Its loads have one proportion in all lines: a singular matrix had ended the diagnosis with an internal error."""
    both = excited_together(np.ones((len(FREQUENCY), 2), bool))
    one_force = replace(both, loads=both.loads[:, :1] * np.array([1.0, 0.25]))
    assert static_tests([one_force], [static()], RIG, float(MODES[0]), SETTINGS.data_tests) == []
    swept = static_tests([one_force, swept_lines()], [static()], RIG, float(MODES[0]), SETTINGS.data_tests)
    assert [row.place for row in swept] == ["static: Fz"] and swept[0].finding == "equal"


def test_two_components_at_once_are_told_apart():
    """All lines carry both loads: the smoothness of the responses separates them."""
    both = excited_together(np.ones((len(FREQUENCY), 2), bool))
    rows = static_tests([both], [static()], RIG, float(MODES[0]), SETTINGS.data_tests)
    assert [row.place for row in rows] == ["static: Fz", "static: My"]
    assert all(row.p_value > 1e-3 for row in rows)


def excited_together(driven: np.ndarray, seed: int = 5, level: float = 10.0, modes: np.ndarray = MODES):
    """A sweep of Fz and My, each at the lines where it is `driven` (k, 2)."""
    rng = np.random.default_rng(seed)
    run = swept_lines("Fz", level, seed)
    U = np.where(driven, level * np.exp(2j * np.pi * rng.random(driven.shape)), 0.0)
    Y = response("Fz", FREQUENCY, modes) * U[:, :1] + response("My", FREQUENCY, modes) * U[:, 1:]
    covariance = np.zeros((len(NAMES) + 2,) * 2)
    covariance[:-2, :-2] = NOISE**2 * np.eye(len(NAMES))
    covariance[-2:, -2:] = LOAD_NOISE**2 * np.eye(2)
    z = np.concatenate([Y, U], axis=1) + circular_noise(rng, covariance, len(FREQUENCY))
    return replace(
        run,
        run=f"both-{level:g}",
        components=("Fz", "My"),
        channels=z[:, :-2],
        loads=z[:, -2:],
        covariance=np.broadcast_to(covariance.astype(complex), (len(FREQUENCY), *covariance.shape)),
        level=(level, level),
    )


# ---- levels and rotor speeds -----------------------------------------------------------------------------------------


def test_levels_that_agree():
    runs = [swept_lines("Fz", level, seed, dof=200.0) for seed, level in enumerate((10.0, 4.0, 2.0))]
    rows = level_tests([*runs, swept_lines("Mx", 3.0, 9)], RIG, SETTINGS.data_tests)
    assert [row.place for row in rows] == [f"{run.run}, {runs[0].run}" for run in runs[1:]]
    assert all(row.finding == "equal" and row.p_value > 1e-3 for row in rows)
    assert spin_tests(runs, RIG, SETTINGS.data_tests) == []


def test_a_mode_that_stiffens_with_level_is_found():
    stiffer = np.where(np.isclose(MODES, 54.2), MODES * 1.002, MODES)
    (row,) = level_tests(
        [swept_lines("Fz", 4.0, 1), swept_lines("Fz", 10.0, 2, modes=stiffer)], RIG, SETTINGS.data_tests
    )
    assert row.p_value < 1e-12
    assert "higher at the high level" in row.finding
    low, high = (float(word) for word in row.finding.partition("from ")[2].split(" Hz")[0].split(" to "))
    assert low < 54.2 < high
    change = float(row.finding.partition("frequencies about ")[2].split()[0])
    assert change == pytest.approx(0.2, abs=0.03) and "damping" not in row.finding


@pytest.mark.parametrize(
    ("names", "words"),
    [(NAMES[1:3], ", ".join(NAMES[1:3]) + " read"), (NAMES, "all channels read"), ((), "equal")],
    ids=["a box", "the force cell", "nothing"],
)
def test_a_gain_that_changes_between_runs_is_told_from_modes(names, words):
    changed = dict.fromkeys(names, np.full(len(FREQUENCY), 1.02))
    runs = [swept_lines("Fz", 4.0, 1), swept_lines("Fz", 10.0, 2, changed=changed)]
    (row,) = level_tests(runs, RIG, SETTINGS.data_tests)
    assert words in row.finding
    if names:
        factor, sigma = number(row.finding, "read ")
        assert abs(factor - 1.02) < 4 * sigma < 4e-3 and "frequencies" not in row.finding


def test_lines_of_two_components_are_compared_where_one_alone_is_driven():
    """Interleaved lines serve; where both act at once nothing can be said without a model."""
    turns = np.stack([np.arange(len(FREQUENCY)) % 2 == 0, np.arange(len(FREQUENCY)) % 2 == 1], axis=1)
    stiffer = np.where(np.isclose(MODES, 54.2), MODES * 1.002, MODES)
    (equal,) = level_tests(
        [excited_together(turns, 1, 4.0), excited_together(turns, 2, 10.0)], RIG, SETTINGS.data_tests
    )
    assert equal.finding == "equal" and equal.dof == 2 * len(NAMES) * len(FREQUENCY)
    (row,) = level_tests(
        [excited_together(turns, 1, 4.0), excited_together(turns, 2, 10.0, stiffer)], RIG, SETTINGS.data_tests
    )
    assert row.p_value < 1e-12
    every = np.ones_like(turns)
    assert (
        level_tests([excited_together(every, 1, 4.0), excited_together(every, 2, 10.0)], RIG, SETTINGS.data_tests) == []
    )


def test_a_turning_rotor_is_compared_with_rest():
    rest, near = swept_lines("Fz", 10.0, 1), swept_lines("Fz", 4.0, 2)
    turning = swept_lines("Fz", 9.0, 3, rotor_speed=17.5)
    (equal,) = spin_tests([rest, near, turning], RIG, SETTINGS.data_tests)
    assert equal.place == f"{rest.run}, {turning.run}" and equal.finding == "equal"
    split = np.where(np.isclose(MODES, 27.4), MODES * 0.995, MODES)
    (row,) = spin_tests([rest, swept_lines("Fz", 10.0, 3, modes=split, rotor_speed=17.5)], RIG, SETTINGS.data_tests)
    assert row.p_value < 1e-12 and "lower with the rotor turning" in row.finding
    assert level_tests([near, turning], RIG, SETTINGS.data_tests) == []


def test_a_change_with_the_turning_rotor_alone_begins_a_search():
    """Where two levels at rest differ, too, the turning rotor is not what changes the response."""
    split = np.where(np.isclose(MODES, 27.4), MODES * 0.995, MODES)
    rest, turning = swept_lines("Fz", 10.0, 1), swept_lines("Fz", 10.0, 3, modes=split, rotor_speed=17.5)
    same, other = swept_lines("Mx", 10.0, 4), swept_lines("Mx", 4.0, 5, modes=split)
    (found,) = spin_candidates([rest, turning, same, swept_lines("Mx", 4.0, 5)], RIG, SETTINGS)
    assert [item.effect.needs_spin for item in found.candidates] == [True] and not found.is_certain
    assert spin_candidates([rest, turning, same, other], RIG, SETTINGS) == ()
    assert spin_candidates([rest, swept_lines("Fz", 9.0, 3, rotor_speed=17.5)], RIG, SETTINGS) == ()
    excluded = replace(SETTINGS, excluded=tuple(item.label for item in found.candidates))
    assert spin_candidates([rest, turning], RIG, excluded) == ()


# ---- mains -----------------------------------------------------------------------------------------------------------


def with_tone(run, channel: str, frequency: float, amplitude: float, seed: int):
    """A tone of any phase at the line of this frequency."""
    channels = run.channels.copy()
    line = int(np.argmin(np.abs(run.frequency - frequency)))
    phase = np.random.default_rng(seed).random()
    channels[line, NAMES.index(channel)] += amplitude * np.exp(2j * np.pi * phase)
    return replace(run, channels=channels)


RUNS = [swept_lines(name, 1.0, seed, dof=200.0) for seed, name in enumerate(("Fx", "Fy", "Fz", "Mx", "My", "Mz"))]


def test_no_mains():
    rows = mains_tests(RUNS, SETTINGS.data_tests)
    assert [row.place for row in rows] == ["50 Hz and multiples", "60 Hz and multiples"]
    assert all(row.finding == "nothing" and row.p_value > 1e-3 for row in rows)


@pytest.mark.parametrize(("frequency", "family"), [(50.0, 0), (100.0, 0), (60.0, 1), (49.75, 0)])
def test_a_tone_of_the_mains_is_found_in_its_channel(frequency, family):
    picked = [with_tone(run, "z2.piezo", frequency, 8 * NOISE, seed) for seed, run in enumerate(RUNS)]
    rows = mains_tests(picked, SETTINGS.data_tests)
    assert rows[family].p_value < 1e-4
    assert rows[family].finding.startswith(f"stands out: z2.piezo at {np.rint(frequency / 10) * 10:g} Hz")
    assert rows[1 - family].finding == "nothing"


def test_a_sharp_mode_at_the_mains_is_no_mains():
    modes = np.where(np.isclose(MODES, 54.2), 50.0, MODES)
    runs = [swept_lines(name, 1.0, seed, modes=modes, dof=200.0) for seed, name in enumerate(("Fx", "Fz", "My"))]
    assert all(row.finding == "nothing" for row in mains_tests(runs, SETTINGS.data_tests))


def test_a_harmonic_of_the_rotor_is_no_mains():
    turning = [replace(with_tone(run, "z2.piezo", 50.0, 1.0, 1), rotor_speed=25.0) for run in RUNS]
    row = mains_tests(turning, SETTINGS.data_tests)[0]
    assert row.finding == "nothing"


def test_lines_that_do_not_reach_the_mains_give_no_row():
    low = [run.select(run.frequency < 45.0) for run in RUNS]
    assert mains_tests(low, SETTINGS.data_tests) == []


# ---- simulated campaigns ---------------------------------------------------------------------------------------------


def campaign(*effects: DeclaredEffect, plan: CampaignPlan | None = None, seed: int = 0):
    """Spectra of a simulated campaign of a drawn rig with these effects."""
    used = (run for run in short_plan().runs if run.kind in ("static", "sweep"))
    steps = (run.model_copy(update={"steps": 5}) if run.kind == "static" else run for run in used)
    plan = plan or CampaignPlan(runs=tuple(steps))
    rig = apply_effects(draw_rig(RIG, np.random.default_rng(seed)) if seed else true_rig(RIG), effects)
    return measured_spectra(simulate_campaign(rig, plan, seed=seed)[0], RIG)


def two_levels(component: str = "Fz", high: float = 400.0) -> CampaignPlan:
    plan = {"excited": (component,), "periods": 5, "period": 2.0}
    return CampaignPlan(
        runs=(
            SweepPlan(run="low", level=(0.2 * high,), **plan),
            SweepPlan(run="high", level=(high,), **plan),
        )
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_nothing_is_found_where_nothing_is_hidden(seed):
    """Short records, in which the piezo amplifiers' own high-pass still rings."""
    rows = model_free_tests(campaign(seed=seed), RIG, 20.0, SETTINGS)
    names = {"channels of a cell", "run against run", "static against low frequency", "mains"}
    assert {row.name for row in rows} == names
    assert min(row.p_value for row in rows) * len(rows) > 1e-3
    assert {row.finding for row in rows} == {"equal", "nothing"}


def test_a_simulated_delay_is_found():
    delay = DeclaredEffect(name="time-delay", where=("y2.piezo",), parameters={"delay": 4e-4})
    rows = model_free_tests(campaign(delay, seed=3), RIG, 20.0, SETTINGS)
    (row,) = (row for row in rows if row.p_value * len(rows) < 1e-3)
    assert row.place == "y2.strain, y2.piezo"
    value, sigma = number(row.finding, "late by")
    assert abs(value - 0.4) < 4 * sigma


def test_a_simulated_contact_depends_on_level():
    cubic = DeclaredEffect(name="cubic-stiffness", where=("z1",), parameters={"k3": 1e12, "side": "beside"})
    (row,) = (r for r in model_free_tests(campaign(cubic, plan=two_levels()), RIG, 20.0, SETTINGS) if "level" in r.name)
    assert row.p_value < 1e-6 and row.finding.startswith("differ most from")
    (row,) = (r for r in model_free_tests(campaign(plan=two_levels()), RIG, 20.0, SETTINGS) if "level" in r.name)
    assert row.finding == "equal"


def test_simulated_mains_are_found():
    interference = DeclaredEffect(name="mains-pickup", where=("z4.strain",), parameters={"amplitude": 2e-3})
    rows = mains_tests(campaign(interference).lines, SETTINGS.data_tests)
    assert rows[0].p_value < 1e-3 and "z4.strain at 50 Hz" in rows[0].finding
    assert rows[1].finding == "nothing"
