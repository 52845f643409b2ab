"""Loads as functions of the readings, without iteration."""

import json
from dataclasses import replace

import numpy as np
from click.testing import CliRunner

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.load_method import choose_load_method
from balance_cli.calibration.noniterative import fit_noniterative_model
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance
from balance_cli.cli.calibration_summary import _with_former_keys
from balance_cli.reduction.response_sources import static_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.reduce import reduce_run
from tests.support.calibration_stand import FULL_RANGE, NOISE, stand_points
from tests.support.nonlinear_rig import NAMES, RIG, calibration, record, static_runs
from tests.support.rigs import CONFIGS

LOADS = np.array([300.0, -200.0, 2000.0, 100.0, -80.0, 150.0])


def fitted(points):
    math_model = fit_calibration_model(points).model
    return math_model, fit_noniterative_model(points, math_model, points.weight > 0)


def check_errors(noise):
    """Rms errors of random loads, over full range, by the iteration and by the non-iterative model."""
    math_model, non_iterative = fitted(stand_points(noise=noise))
    rng = np.random.default_rng(3)
    applied = rng.uniform(-0.6, 0.6, (300, 6)) * FULL_RANGE
    read = fit_calibration_model(stand_points(noise=1e-9)).model.readings(applied) + noise * rng.normal(size=(300, 8))
    pair = math_model.loads(read)[0], non_iterative.loads(read)
    return [np.sqrt(np.mean(((found - applied) / FULL_RANGE) ** 2)) for found in pair]


def test_it_is_about_as_good_as_the_iteration_and_far_better_than_a_straight_matrix():
    iterated, non_iterative = check_errors(NOISE)
    math_model = fit_calibration_model(stand_points(), choice=LINEAR_TERMS).model
    rng = np.random.default_rng(3)
    applied = rng.uniform(-0.6, 0.6, (300, 6)) * FULL_RANGE
    read = fit_calibration_model(stand_points(noise=1e-9)).model.readings(applied)
    straight = np.sqrt(np.mean(((math_model.loads(read)[0] - applied) / FULL_RANGE) ** 2))
    assert non_iterative < 1.5 * iterated
    assert non_iterative < 0.3 * straight


def test_its_truncation_is_the_difference_from_the_iteration_beyond_the_errors_of_its_coefficients():
    math_model, direct = fitted(stand_points())
    rng = np.random.default_rng(4)
    read = math_model.readings(rng.uniform(-0.6, 0.6, (200, 6)) * FULL_RANGE)
    difference = direct.loads(read) - math_model.loads(read)[0]
    truncation = direct.truncation(read, math_model)
    y = read @ direct.inverse.T
    own = np.diagonal(direct.model.model_covariance(y), axis1=1, axis2=2) * FULL_RANGE**2
    chance = difference**2 <= own
    assert np.all(truncation[chance] == 0.0) and 0.1 < chance.mean() < 0.9
    np.testing.assert_allclose((truncation**2 + own)[~chance], difference[~chance] ** 2)
    assert np.all(np.sign(truncation[~chance]) == np.sign(difference[~chance]))


def test_errors_of_the_coefficients_are_no_misfit():
    """Of pure noise, rows that the others predict err by more than the residuals, by leverage alone."""
    ratios = []
    for seed in range(20):
        rng, x = np.random.default_rng(seed), np.linspace(-1.0, 1.0, 12)[:, None] * np.ones((1, 1))
        points = CalibrationPoints(
            ("a",),
            ("Fx",),
            ("r",),
            x + 0.01 * rng.standard_normal((12, 1)),
            x,
            np.zeros(12, int),
            np.ones(12),
            np.ones(1),
        )
        ratios.append(fit_calibration_model(points, LINEAR_TERMS).model.press_ratio[0])
    assert np.median(ratios) < 1.03  # 1.1 with the errors of the coefficients


def test_of_a_straight_balance_it_is_the_straight_inverse():
    points = stand_points()
    straight = fit_calibration_model(points, choice=LINEAR_TERMS).model
    points = replace(points, channels=straight.readings(points.loads))
    math_model, non_iterative = fitted(points)
    assert not math_model.is_nonlinear and not non_iterative.model.is_nonlinear
    np.testing.assert_allclose(non_iterative.loads(points.channels), points.loads, atol=1e-6 * FULL_RANGE.max())


def test_rows_that_took_no_part_have_none_here_either():
    points = stand_points()
    out = np.zeros(len(points.loads), bool)
    out[100:110] = True
    spoiled = replace(points, channels=points.channels + 0.5 * out[:, None]).exclude_rows(out)
    (_, sound), (_, non_iterative) = fitted(points), fitted(spoiled)
    np.testing.assert_allclose(non_iterative.residual_percent_fs, sound.residual_percent_fs, rtol=0.2)


def test_reduce_takes_mean_loads_from_it_where_all_channels_are_there():
    zero = zero_record(record("zero", np.zeros(6), 0.0, kind="zero", seed=5), NAMES)
    cal = calibrate(static_runs(np.random.default_rng(1)), RIG, non_iterative=True)
    assert cal.all_trims.non_iterative.model.is_nonlinear
    found = reduce_run(record("w", LOADS), RIG, cal, static_source(cal), zero).amplitude[0].real
    iterated = reduce_run(record("w", LOADS), RIG, calibration(), static_source(calibration()), zero).amplitude[0].real
    error = np.abs(found - LOADS) / np.abs(FULL_RANGE)
    assert np.all(error < 1e-3) and np.max(np.abs(found - iterated)) > 1e-9
    again = choose_load_method(cal, "iterative", "--mean-loads")
    by_choice = reduce_run(record("w", LOADS), RIG, again, static_source(again), zero)
    np.testing.assert_array_equal(by_choice.amplitude[0].real, iterated)
    assert by_choice.mean_loads_by == "iteration with the calibration model"


def test_reduce_says_which_model_gave_the_mean_loads(tmp_path):
    for run in (*static_runs(np.random.default_rng(1)), record("w", LOADS)):
        write_run(tmp_path / f"{run.name}.h5", run)
    static = [str(tmp_path / f"{run.name}.h5") for run in static_runs(np.random.default_rng(1))]
    cal, direct = str(tmp_path / "c.h5"), str(tmp_path / "d.h5")
    words = ["calibrate", "-q", "-g", str(CONFIGS / "rts-6.yaml"), *static]
    assert CliRunner().invoke(balance, [*words, "-o", cal]).exit_code == 0
    assert CliRunner().invoke(balance, [*words, "--non-iterative", "-o", direct]).exit_code == 0
    means = {}
    calls = {"default": (direct, ()), "iterative": (direct, ("--mean-loads", "iterative")), "only": (cal, ())}
    for name, (path, extra) in calls.items():
        call = ["reduce", "--static", "--calibration", path, str(tmp_path / "w.h5"), *extra]
        result = CliRunner().invoke(balance, [*call, "--json", str(tmp_path / "s.json"), "-o", str(tmp_path / "l.csv")])
        assert result.exit_code == 0
        means[name] = json.loads((tmp_path / "s.json").read_text())["runs"]["w"]["mean_load_method"]
        assert f"mean loads: {means[name]}" in result.stdout
    assert means == {
        "default": "non-iterative method",
        "iterative": "iteration with the calibration model",
        "only": "iteration with the calibration model",
    }
    call = ["reduce", "--static", "--calibration", cal, str(tmp_path / "w.h5"), "--mean-loads", "non-iterative"]
    refused = CliRunner().invoke(balance, [*call, "-o", str(tmp_path / "n.csv")])
    assert refused.exit_code == 2 and "--mean-loads" in refused.stderr and "no non-iterative model" in refused.stderr


def test_without_a_channel_the_iteration_gives_the_loads_and_a_note_says_so():
    cal = calibrate(static_runs(np.random.default_rng(1)), RIG, non_iterative=True)
    run, redundant = record("w", LOADS), next(name for name in NAMES if name.startswith("z4"))
    lost = replace(run, channel_names=tuple("lost" if name == redundant else name for name in run.channel_names))
    loads = reduce_run(lost, RIG, cal, static_source(cal))
    assert loads.mean_loads_by == "iteration with the calibration model"
    assert any(f"the non-iterative method needs {redundant}" in note for note in loads.notes)


def test_command_states_it_and_refuses_it_for_a_matrix(tmp_path):
    paths = []
    for run in static_runs(np.random.default_rng(1)):
        paths.append(str(tmp_path / f"{run.name}.h5"))
        write_run(tmp_path / f"{run.name}.h5", run)
    words = ["calibrate", "-g", str(CONFIGS / "rts-6.yaml"), *paths, "-o", str(tmp_path / "c.h5")]
    result = CliRunner().invoke(balance, [*words, "--non-iterative", "--json", str(tmp_path / "c.json")])
    assert result.exit_code == 0 and "non-iterative method" in result.stdout
    stated = json.loads((tmp_path / "c.json").read_text())["all_trims"]["non_iterative"]
    assert set(stated["residual_percent_fs"]) == set(COMPONENTS)
    refused = CliRunner().invoke(
        balance, [*words[:3], "--from-matrix", "m.csv", "--non-iterative", "-o", str(tmp_path / "d.h5")]
    )
    assert refused.exit_code == 2 and "--non-iterative" in refused.stderr


def test_former_option_and_keys_work_for_one_release(tmp_path):
    paths = [str(tmp_path / f"{run.name}.h5") for run in static_runs(np.random.default_rng(1))]
    for run, path in zip(static_runs(np.random.default_rng(1)), paths, strict=True):
        write_run(path, run)
    words = ["calibrate", "-g", str(CONFIGS / "rts-6.yaml"), *paths, "-o", str(tmp_path / "c.h5")]
    result = CliRunner().invoke(balance, [*words, "--direct", "--json", str(tmp_path / "c.json")])
    assert result.exit_code == 0 and "--direct is deprecated; use --non-iterative" in result.stderr
    summary = json.loads((tmp_path / "c.json").read_text())
    present, former = summary["all_trims"], summary["gage"]
    assert present["non_iterative"] == former["direct"] is not None
    assert present["zeros"]["load_series"] == former["zeros"]["sequences"]
    for key, name in {"calibrated_range": "full_range", "unsupported_terms": "terms_refused"}.items():
        assert present[key] == former[name]
    trim = next(iter(summary["trims"].values()))
    assert trim["calibrated_range"] == trim["full_range"]


def test_former_keys_of_suspect_series_tares_and_checks():
    suspect = {"load_series": "s", "channel": "c", "gain": 1, "resembled_channel": "", "alternatives": ()}
    summary = {
        "zeros": {"load_series": ["s"], "drift_per_series": {}},
        "tares": {"center_of_gravity": {}, "series_count": 3},
        "checks": {"r": {"rows": 2, "valid_rows": 1}},
        "suspect_series": [suspect],
    }
    former = _with_former_keys(summary)
    assert former["bad_sequences"] == [{"sequence": "s", "channel": "c", "gain": 1, "like": "", "or_else": ()}]
    assert former["tares"] == {"centre": {}, "sequences": 3} and former["checks"] == {"r": {"rows": 2, "solved": 1}}
    assert former["zeros"] == {"sequences": ["s"], "drift_per_sequence": {}}


def test_check_loads_are_checked_by_both_methods_and_say_which():
    """New loads on the balance of the stand: both intervals cover them, and the labels name the method."""
    points = stand_points()
    truth = fit_calibration_model(stand_points(noise=1e-9)).model
    rng = np.random.default_rng(8)
    applied = np.vstack([np.zeros(6), rng.uniform(-0.6, 0.6, (300, 6)) * FULL_RANGE])
    read = truth.readings(applied) + NOISE * rng.normal(size=(301, 8))
    by_model, direct = calibrate_all_trims(points, [HeldOutRun("again", read, applied)], non_iterative=True).checks
    assert (by_model.label, direct.label) == ("again", "again, non-iterative method")
    assert not np.array_equal(by_model.computed, direct.computed)
    for check in (by_model, direct):
        assert check.is_valid[1:].mean() > 0.95
        assert 0.9 < np.mean(check.interval_coverage) < 0.995
    assert np.all(direct.error < 1.5 * by_model.error)
