"""Natural zeros and the weight of the metric part: recovered with honest errors, untold where attitudes do not tell."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.outliers import screen_outliers
from balance_cli.calibration.tare_result import weight_loads
from balance_cli.calibration.tares import screen_outliers_with_tares
from balance_cli.calibration.term_choice import LINEAR_TERMS, SEARCHED
from balance_cli.calibration.terms import term_values
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import open_run, read_run, write_run
from balance_cli.campaign.rig.attitude import attitude_segments, gravity_directions
from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.report.calibration import section
from balance_cli.report.sources import group_sources
from balance_cli.steps.calibrate import calibrate
from tests.support.calibration_stand import CHANNELS, COMPONENTS, FULL_RANGE, NOISE, stand_loads, true_model
from tests.support.page_content import tables, texts
from tests.support.report_content import artefact
from tests.support.rigs import CONFIGS, rotor_balance
from tests.support.run_content import a_run
from tests.support.static_runs import C0, RIG, loading, rigid_matrix

SIX = np.array([[0.0, 0.0], [0.0, 30.0], [0.0, -30.0], [20.0, 0.0], [-20.0, 0.0], [15.0, 90.0]])
W, R = 200.0, np.array([0.02, -0.05, 0.12])
TRUE_W = np.r_[W, W * R]
NATURAL = 0.01 * np.random.default_rng(5).normal(size=8)


def short_schedule():
    """Loads (m, 6) and load series (m,) of the stand: single ramps, and the pairs that act together in the model."""
    x, sequence = stand_loads()
    first, applied = np.searchsorted(sequence, sequence), x != 0
    pairs = [[COMPONENTS.index(name) for name in pair] for pair in (("Fx", "My"), ("Mx", "My"), ("Fx", "Fz"))]
    by_series = np.stack([np.logical_or.reduceat(applied[:, j], np.unique(first)) for j in range(6)], axis=1)[sequence]
    wanted = by_series.sum(axis=1) == 1
    for pair in pairs:
        wanted |= by_series[:, pair].all(axis=1)
    return x[wanted], np.unique(sequence[wanted], return_inverse=True)[1]


def tilted_stand(seed, curved, attitudes=SIX, jumps=0.0, schedule=None):
    """The stand with a metric part that weighs, each sequence in the next attitude."""
    rng = np.random.default_rng(seed)
    x, sequence = stand_loads() if schedule is None else schedule
    terms, b = true_model()
    b = b if curved else np.vstack([b[:6], 0.0 * b[6:]])
    gravity = gravity_directions(attitudes[sequence % len(attitudes)])
    total = x + weight_loads(gravity) @ TRUE_W / FULL_RANGE
    zeros = NATURAL + jumps * rng.normal(size=(sequence[-1] + 1, 8))[sequence]
    read = term_values(terms, total) @ b + zeros + NOISE * rng.normal(size=(len(x), 8))
    run = np.zeros(len(x), int)
    return CalibrationPoints(
        CHANNELS, COMPONENTS, ("s",), read, x * FULL_RANGE, run, np.ones(len(x)), FULL_RANGE, gravity
    )


def quiet_first(points):
    """The first row (8,) without its noise."""
    terms, b = true_model()
    total = points.loads[:1] + weight_loads(points.gravity[:1]) @ TRUE_W
    return (term_values(terms, total / FULL_RANGE) @ b)[0] + NATURAL


def off(tares):
    """All estimates less the truth, over sigma."""
    w = (tares.w - TRUE_W) / np.sqrt(np.diag(tares.w_covariance))
    center_of_gravity = (tares.center_of_gravity - R) / tares.center_of_gravity_sigma
    return np.r_[w, center_of_gravity, (tares.natural_zeros - NATURAL) / tares.natural_zeros_sigma]


# ---- gravity ---------------------------------------------------------------------------------------------------------


def test_gravity_in_rig_axes():
    h = np.sqrt(0.5)
    found = gravity_directions([[0, 0], [90, 0], [0, 90], [45, 180], [45, 90]])
    expected = [[0, 0, -1], [1, 0, 0], [0, -1, 0], [h, 0, h], [h, -h, 0]]
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_loads_of_a_weight():
    g = gravity_directions([[10.0, -35.0]])
    np.testing.assert_allclose((weight_loads(g) @ TRUE_W)[0], np.r_[W * g[0], np.cross(W * R, g[0])])
    np.testing.assert_allclose(weight_loads(g, ("Fz", "My")), weight_loads(g)[:, [2, 4]])


def test_an_attitude_begins_a_segment_and_a_load_series():
    run = np.array([0, 0, 0, 0, 1, 1])
    gravity = gravity_directions([[0, 0], [0, 0.01], [0, 5], [0, 5], [0, 5], [9, 0]])
    assert attitude_segments(run, None).tolist() == [0, 0, 0, 0, 1, 1]
    assert attitude_segments(run, gravity).tolist() == [0, 0, 1, 1, 2, 3]
    points = tilted_stand(0, False)
    same = replace(points, gravity=None)
    assert np.array_equal(points.load_series, same.load_series)
    turned = np.arange(len(points.loads)) >= 5
    split = replace(points, gravity=np.where(turned[:, None], points.gravity, -points.gravity))
    assert np.array_equal(split.load_series[5:], points.load_series[5:] + 1)


# ---- estimates -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("curved", "seeds"), [(False, 20), (True, 12)])
def test_weight_centre_and_natural_zeros_come_out_with_honest_errors(curved, seeds):
    each = np.array(
        [
            off(screen_outliers_with_tares(points, SEARCHED if curved else LINEAR_TERMS)[2])
            for points in (tilted_stand(seed, curved, schedule=short_schedule()) for seed in range(seeds))
        ]
    )
    assert np.mean(np.abs(each) < 3) > 0.98 and np.max(np.abs(each)) < 4.5
    assert 0.8 < np.sqrt(np.mean(each[:, :4] ** 2)) < 1.25
    assert 0.8 < np.sqrt(np.mean(each[:, 7:] ** 2)) < 1.25
    assert np.all(np.abs(each.mean(axis=0)) < 4 / np.sqrt(seeds))


def test_the_model_is_that_of_all_loads():
    points = tilted_stand(3, True)
    all_trims = calibrate_all_trims(points)
    terms, b = true_model()
    added = weight_loads(points.gravity) @ TRUE_W
    np.testing.assert_allclose(all_trims.loads - points.loads, added, atol=0.2)
    assert set(all_trims.model.terms) == {term.name(COMPONENTS) for term in terms}
    place = [all_trims.model.terms.index(term.name(COMPONENTS)) for term in terms]
    sigma = np.sqrt(np.diagonal(all_trims.model.covariance, axis1=1, axis2=2)).T[place]
    assert np.all(np.abs(all_trims.model.coefficients[place] - b)[sigma > 0] < 5 * sigma[sigma > 0])
    np.testing.assert_allclose(all_trims.model.zeros, np.tile(NATURAL, (len(all_trims.model.zeros), 1)), atol=2e-3)
    np.testing.assert_allclose(all_trims.level_weight_loads, [0, 0, -W, *np.cross(W * R, [0, 0, -1])], atol=0.3)
    assert 0.7 < all_trims.tares.chi2_per_dof < 1.3 and not all_trims.screening_notes
    # The applied loads alone leave the curvature of the weight.
    apart = screen_outliers(points).fit.model.coefficients[:6] - b[:6]
    assert np.max(np.abs(apart)) > 3 * np.max(np.abs(all_trims.model.coefficients[:6] - b[:6]))


def test_zeros_that_jump_widen_the_errors():
    stands = [tilted_stand(seed, False, jumps=1e-3, schedule=short_schedule()) for seed in range(20)]
    found = [screen_outliers_with_tares(points, LINEAR_TERMS)[2] for points in stands]
    assert min(tares.chi2_per_dof for tares in found) > 5
    assert 0.7 < np.sqrt(np.mean([off(tares)[:4] ** 2 for tares in found])) < 1.4


def test_a_check_in_another_attitude_is_found_less_its_weight():
    points, check = tilted_stand(1, True), tilted_stand(2, True, np.array([[10.0, 60.0]]))
    # Many rows at the first load, so that the zero of the check is no matter.
    many = np.r_[np.zeros(200, int), np.arange(len(check.loads))]
    made = HeldOutRun("check", check.channels[many], check.loads[many])
    made[1][:200] += NOISE * np.random.default_rng(1).normal(size=(200, 8)) - (made[1][0] - quiet_first(check))
    with_weight = calibrate_all_trims(points, [made._replace(gravity=check.gravity[many])]).checks[0]
    without_weight = calibrate_all_trims(points, [made]).checks[0]
    assert np.all(with_weight.interval_coverage > 0.91)
    assert np.all(with_weight.error < 1.01 * without_weight.error) and np.any(
        with_weight.error < 0.9 * without_weight.error
    )


@pytest.mark.parametrize(
    "attitudes", [SIX[:1], SIX[:2], np.array([[0, 0], [0, 30], [0, 30.2], [0, 0.2]])], ids=["one", "two", "in line"]
)
def test_too_few_attitudes_tell_nothing(attitudes):
    points = tilted_stand(0, False, attitudes)
    total, found, tares = screen_outliers_with_tares(points, LINEAR_TERMS)
    assert tares is None and total is points
    plain = screen_outliers(replace(points, gravity=None), LINEAR_TERMS)
    assert np.array_equal(found.fit.model.coefficients, plain.fit.model.coefficients)


def test_an_attitude_that_creeps_within_a_sequence_tells_no_zero():
    points = tilted_stand(0, False)
    sequence = points.load_series
    creep = np.where(sequence == 7, np.linspace(0, 1, len(sequence)) * 40, 0.0)
    tilt = np.column_stack([SIX[sequence % 6, 0], SIX[sequence % 6, 1] + creep])
    rows = np.flatnonzero(sequence == 7)
    tilt[rows, 1] = SIX[1, 1] + np.linspace(0, 1.0, len(rows))
    crept = replace(points, gravity=gravity_directions(tilt))
    assert np.array_equal(crept.load_series, sequence)
    tares = screen_outliers_with_tares(crept, LINEAR_TERMS)[2]
    assert tares.series_count == sequence[-1] and abs(tares.weight - W) < 4 * tares.weight_sigma


def test_what_took_no_part_in_the_fit_tells_no_zero():
    points = tilted_stand(0, False)
    sequence = points.load_series
    channels = points.channels.copy()
    channels[sequence == 5, 2] *= 1.5
    channels[np.flatnonzero(sequence == 9)[4], 1] += 0.008
    all_trims = calibrate_all_trims(replace(points, channels=channels), choice=LINEAR_TERMS)
    assert len(all_trims.suspect_series) == 1 and len(all_trims.outliers) == 1
    assert all_trims.tares.series_count == sequence[-1] and np.all(np.abs(off(all_trims.tares)) < 4)


def test_single_unloaded_rows_tell_the_weight():
    level, tilted = tilted_stand(1, True, SIX[:1]), tilted_stand(2, True)
    rng, (terms, b) = np.random.default_rng(8), true_model()
    gravity = gravity_directions(SIX[1:])
    total = weight_loads(gravity) @ TRUE_W / FULL_RANGE
    read = term_values(terms, total) @ b + NATURAL + NOISE * rng.normal(size=(5, 8))
    points = replace(
        tilted,
        channels=np.vstack([level.channels, read]),
        loads=np.vstack([level.loads, np.zeros((5, 6))]),
        run=np.zeros(len(level.run) + 5, int),
        weight=np.ones(len(level.run) + 5),
        gravity=np.vstack([level.gravity, gravity]),
    )
    all_trims = calibrate_all_trims(points)
    assert (
        np.all(np.abs(off(all_trims.tares)) < 4)
        and all_trims.tares.series_count == len(np.unique(level.load_series)) + 5
    )


def test_a_run_without_attitude_is_named():
    points = tilted_stand(0, False)
    run = (points.load_series > 30).astype(int)
    gravity = np.where(run[:, None] == 1, np.nan, points.gravity)
    all_trims = calibrate_all_trims(
        replace(points, run=run, run_names=("a", "b"), gravity=gravity), choice=LINEAR_TERMS
    )
    assert (
        all_trims.tares is None
        and len(all_trims.screening_notes) == 1
        and "run b does not state its attitude" in all_trims.screening_notes[0]
    )


# ---- run files -------------------------------------------------------------------------------------------------------


def tilted_run(**changes):
    return replace(a_run("static"), attitude=np.random.default_rng(3).normal(size=(100, 2)), **changes)


def test_attitude_survives_the_file(tmp_path):
    run = tilted_run()
    write_run(tmp_path / "run.h5", run)
    read = open_run(tmp_path / "run.h5")
    assert np.array_equal(read.attitude, run.attitude)
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        file["attitude"][:] = run.attitude[:, ::-1]
        file["attitude"].attrs["names"] = ["roll", "pitch"]
    other = open_run(tmp_path / "run.h5")
    assert np.array_equal(other.attitude, run.attitude) and other.digest == read.digest
    write_run(tmp_path / "plain.h5", replace(run, attitude=None))
    plain = open_run(tmp_path / "plain.h5")
    assert plain.attitude is None and plain.digest != read.digest


@pytest.mark.parametrize(
    ("data", "names", "unit", "words"),
    [
        (np.zeros((99, 2)), ["pitch", "roll"], "deg", "99 rows, but 100 rows of channels"),
        (np.zeros((100, 3)), ["pitch", "roll", "yaw"], "deg", "should be pitch and roll"),
        (np.zeros(100), ["pitch", "roll"], "deg", "has the shape (100,)"),
        (np.full((100, 2), np.nan), ["pitch", "roll"], "deg", "row 1 first"),
        (np.zeros((100, 2)), ["pitch", "yaw"], "deg", "named pitch, yaw"),
        (np.zeros((100, 2)), ["pitch", "pitch"], "deg", "used twice"),
        (np.zeros((100, 2)), ["pitch", "roll"], "rad", "its unit is rad"),
        (np.zeros((100, 2)), ["pitch", "roll"], None, "its unit is missing"),
        (np.array([[b"a", b"b"]] * 100), ["pitch", "roll"], "deg", "does not hold real numbers"),
    ],
)
def test_a_bad_attitude_is_refused(tmp_path, data, names, unit, words):
    path = tmp_path / "run.h5"
    write_run(path, a_run("static"))
    with h5py.File(path, "r+") as file:
        file["attitude"] = data
        file["attitude"].attrs["names"] = names
        if unit:
            file["attitude"].attrs["unit"] = unit
    run, faults = read_run(path)
    assert run is None and words in "; ".join(map(str, faults))
    assert all(str(path) in str(fault) and "attitude" in str(fault) for fault in faults)


def test_only_static_runs_have_an_attitude(tmp_path):
    path = tmp_path / "run.h5"
    write_run(path, replace(a_run("check"), attitude=np.zeros((100, 2))))
    with pytest.raises(UserError, match="a `check` run has no attitude"):
        open_run(path)


# ---- the command -----------------------------------------------------------------------------------------------------


def tilted_runs():
    """A static run of the rotor balance with four attitudes, one trim, and the metric part's weight in its readings."""
    rng = np.random.default_rng(4)
    attitude = np.repeat(SIX[[0, 1, 3, 5]], len(loading()), axis=0)
    loads = np.tile(loading(), (4, 1))
    weight = weight_loads(gravity_directions(attitude)) @ TRUE_W
    read = (
        0.3 + loads @ C0.T + weight @ rigid_matrix(RIG, on_plate=True).T + 2e-4 * rng.normal(size=(len(loads), len(C0)))
    )
    names = tuple(c.name for c in RIG.channels if c.measures_dc)
    return Run("s1", RIG.rig, "static", names, len(loads), MemorySource(read, loads), trim="bare", attitude=attitude)


def test_calibrate_tells_the_weight(tmp_path):
    write_run(tmp_path / "s1.h5", tilted_runs())
    words = ["-g", str(CONFIGS / "rts-6.yaml"), str(tmp_path / "s1.h5"), "-o", str(tmp_path / "cal.h5")]
    result = CliRunner().invoke(balance, ["calibrate", *words, "--json", str(tmp_path / "out.json")])
    assert result.exit_code == 0, result.output
    assert "metric part: weight" in result.output and "center of gravity from the hub [mm]" in result.output
    summary = json.loads((tmp_path / "out.json").read_text())
    tares = summary["all_trims"]["tares"]
    assert abs(tares["weight"]["value"] - W) < 4 * tares["weight"]["sigma"] < 4
    for axis, at in zip("xyz", R, strict=True):
        assert abs(tares["center_of_gravity"][axis]["value"] - at) < 4 * tares["center_of_gravity"][axis]["sigma"]
    assert all(abs(one["value"] - 0.3) < 4 * one["sigma"] for one in tares["natural_zeros"].values())
    assert tares["series_count"] == len(summary["all_trims"]["zeros"]["load_series"])
    # Each attitude has an offset of its own in the matrices, too.
    assert max(summary["trims"]["bare"]["residual_percent_fs"].values()) < 0.5


def test_the_page_tells_the_weight():
    calibration = calibrate([tilted_runs()], rotor_balance(), LINEAR_TERMS)
    made = section(group_sources([(Path("c.h5"), artefact("balance-calibration/1", calibration, "1" * 64))]))
    assert "Metric part, from the zeros of" in texts(made, "text")
    table = next(one for one in tables(made) if "Natural zeros" in one.caption)
    assert len(table.rows) == len(calibration.all_trims.model.channel_names)


def test_a_balance_without_moments_tells_the_weight_and_not_where_it_acts():
    rng = np.random.default_rng(6)
    up = np.r_[0.0, np.arange(1, 6), np.arange(4, 0, -1)] / 5.0
    x = np.vstack([np.outer(up, np.eye(3)[i % 3]) for i in range(6)])
    series = np.repeat(np.arange(6), len(up))
    gravity = gravity_directions(SIX[series])
    C = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    total = x + W * gravity / FULL_RANGE[:3]
    readings = total @ C.T + NATURAL[:3] + 1e-4 * rng.normal(size=x.shape)
    m, names = len(x), COMPONENTS[:3]
    points = CalibrationPoints(
        CHANNELS[:3], names, ("s",), readings, x * FULL_RANGE[:3], np.zeros(m, int), np.ones(m), FULL_RANGE[:3], gravity
    )
    tares = calibrate_all_trims(points).tares
    assert tares.weight == pytest.approx(W, abs=5 * tares.weight_sigma) and 0 < tares.weight_sigma < 0.05 * W
    assert np.isnan(tares.center_of_gravity).all() and np.isnan(tares.center_of_gravity_sigma).all()
