"""Loads whose calibration rests on a load series that others excluded are flagged, and sigma contains both answers."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.calibration.doubted_loads import doubted_change
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.mean_loads import unmeasured_mean_loads
from balance_cli.reduction.series_doubt import add_series_doubt
from balance_cli.simulation import CampaignPlan, draw_rig, simulate_campaign
from balance_cli.simulation.plans import StaticPlan
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.point_loads import point_loads
from balance_cli.steps.point_readings import point_readings, table_of_run
from tests.support.other_rigs import other_rig

LADDER = np.r_[np.arange(1, 6), np.arange(4, -1, -1), -np.arange(1, 6), np.arange(-4, 1)] / 5.0
LARGEST = {"Fx": 400.0, "Fy": 400.0, "Fz": 800.0, "Mx": 150.0, "My": 150.0, "Mz": 120.0}


def plans():
    """Six single series, and two of 40 random points each."""
    single = [{name: largest * step} for name, largest in LARGEST.items() for step in LADDER]
    shares = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 40, 6))
    both = [
        [{name: LARGEST[name] * part for name, part in zip(LARGEST, row, strict=True)} for row in series]
        for series in shares
    ]
    lists = {"single": single, "combined-1": both[0], "combined-2": both[1]}
    return tuple(StaticPlan(run=name, points=tuple(rows)) for name, rows in lists.items())


@cache
def calibration_with_wrong_series(factor):
    """My of the two combined series is stated `factor` times what it is."""
    geometry = other_rig("D")
    rig = draw_rig(geometry, np.random.default_rng(3))
    single, *combined = simulate_campaign(rig, CampaignPlan(runs=plans()), seed=3).runs
    stated = np.where(np.array(COMPONENTS) == "My", factor, 1.0)
    wrong = [replace(run, source=MemorySource(run.read().channels, run.read().loads * stated)) for run in combined]
    return calibrate([single, *wrong], geometry), single


def test_a_sound_series_that_two_wrong_ones_outvote_leaves_its_loads_in_doubt():
    calibration, run = calibration_with_wrong_series(1.1)
    assert {each.load_series.split("(")[1] for each in calibration.all_trims.suspect_series} == {"My)"}
    loads = np.diag(list(LARGEST.values()))
    change = doubted_change(calibration.all_trims, loads)
    assert change[4, 4] == pytest.approx(0.1 * LARGEST["My"], rel=0.15)
    assert np.all(np.delete(change, 4, axis=0) == 0.0)
    mean = replace(unmeasured_mean_loads(COMPONENTS), loads=loads[4], sigma=np.ones(6), flags=("",) * 6)
    doubted = add_series_doubt(mean, calibration)
    assert doubted.flags == ("", "", "", "", "model contradicted", "")
    assert "contradict each other" in doubted.note
    result, truth = applied_again(calibration, run)
    error = np.abs(result.loads - truth)[:, 4]
    assert error.max() > 0.09 * LARGEST["My"]
    assert np.all(error <= result.interval[:, 4] + 1e-3 * LARGEST["My"])
    heavy = np.abs(truth[:, 4]) > 0.5 * LARGEST["My"]
    assert all("model contradicted My" in result.flags[row] for row in np.flatnonzero(heavy))
    assert not any("contradicted" in result.flags[row] for row in np.flatnonzero(truth[:, 4] == 0.0))


def test_without_contradiction_nothing_is_in_doubt():
    calibration, run = calibration_with_wrong_series(1.0)
    assert calibration.all_trims.suspect_series == ()
    assert not any("contradicted" in flag for flag in applied_again(calibration, run)[0].flags)


@cache
def calibration_of_one_run(wrong):
    """Six single series, My with Fx and My with Fz in one run without labels; in some My is stated 1.1 times."""
    geometry = other_rig("D")
    single = [{name: largest * step} for name, largest in LARGEST.items() for step in LADDER]
    combined = [{name: LARGEST[name] * step for name in ("My", other)} for other in ("Fx", "Fz") for step in LADDER]
    plan = CampaignPlan(runs=(StaticPlan(run="all", points=tuple(single + combined)),))
    (run,) = simulate_campaign(draw_rig(geometry, np.random.default_rng(3)), plan, seed=3).runs
    stated = run.read().loads.copy()
    part = {"with Fx": slice(140, 160), "with both": slice(140, None), "alone": slice(None, 120), "none": slice(0)}[
        wrong
    ]
    stated[part, 4] *= 1.1
    calibration = calibrate([replace(run, source=MemorySource(run.read().channels, stated))], geometry)
    return calibration, run


@pytest.mark.parametrize("wrong", ["with Fx", "with both", "alone"])
def test_a_wrong_load_of_a_combined_series_is_no_term_of_two_loads(wrong):
    """Terms such as Fx |My| had followed it: no series was named, and no load in doubt."""
    calibration, run = calibration_of_one_run(wrong)
    assert not calibration.all_trims.model.is_nonlinear
    assert all("My" in each.load_series for each in calibration.all_trims.suspect_series)
    result, truth = applied_again(calibration, run)
    assert np.all(np.abs(result.loads - truth)[:, 4] <= result.interval[:, 4] + 2e-3 * LARGEST["My"])
    heavy = np.abs(truth[:, 4]) > 0.5 * LARGEST["My"]
    assert all("model contradicted" in result.flags[row] for row in np.flatnonzero(heavy))


def test_a_sound_run_of_single_and_combined_series_is_not_in_doubt():
    calibration, run = calibration_of_one_run("none")
    assert calibration.all_trims.suspect_series == ()
    assert not any("contradicted" in flag for flag in applied_again(calibration, run)[0].flags)


def applied_again(calibration, run):
    """Loads of the single series by the calibration, and those that were applied."""
    readings = point_readings(table_of_run(run, calibration.geometry), calibration, first_is_zero=True)
    return point_loads(readings, calibration), run.read().loads
