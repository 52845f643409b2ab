"""Trends of loads with known slopes, outliers and drifts; chance finds none."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.reduction.result import RunConditions, RunLoads
from balance_cli.steps.repeat_drift import find_repeat_drifts
from balance_cli.steps.trend import (
    find_outliers,
    load_trends,
    mean_redundancy,
    redundancy_drift,
    require_runs,
)
from balance_cli.steps.trend_points import TrendPoint, attribute_values, repeats, sequence

SIGMA = 0.5


def a_point(index, rng, speed=17.5, mean=0.0, recorded=None, redundancy=1.0, **attributes):
    amplitude = np.zeros((5, 6), complex)
    amplitude[0] = mean + SIGMA * rng.standard_normal(6)
    amplitude[4] = 20.0 + SIGMA * rng.standard_normal(6)
    loads = RunLoads(
        run=f"r{index}",
        kind="wind",
        response="model",
        trim="bare",
        components=COMPONENTS,
        frequency_hz=speed * np.arange(5),
        amplitude=amplitude,
        sigma_cosine=np.full((5, 6), SIGMA),
        sigma_sine=np.where(np.arange(5)[:, None] > 0, SIGMA, 0.0) * np.ones(6),
        flags=(("",) * 6,) * 5,
        redundancy=np.concatenate([[np.nan], np.full(4, redundancy)]),
        redundancy_limit=np.full(5, 3.0),
        condition=np.ones(5),
        left_out={},
        interval=(0.0, 10.0),
        conditions=RunConditions(17.5, recorded, None, attributes),
    )
    return TrendPoint("loads.h5", loads, 4)


@pytest.mark.parametrize(("departure", "varies"), [(1e-14, False), (1e-7, False), (1e-4, True)])
def test_a_speed_that_differs_by_rounding_alone_has_no_slope(departure, varies):
    """Slopes of 20 runs at 28.69 Hz were -6e10 N/Hz."""
    rng = np.random.default_rng(2)
    points = [a_point(i, rng, speed=28.69 * (1.0 + departure * rng.standard_normal())) for i in range(20)]
    trends = load_trends(points, attribute_values(points, "speed"))
    assert all(np.isfinite(item.slope) == varies for item in trends)
    assert all(np.isfinite(item.intercept) and 0.5 < item.scatter < 2.0 for item in trends)


def test_a_slope_lies_within_its_sigma_and_others_are_none():
    rng = np.random.default_rng(1)
    z, p_values = [], []
    for _ in range(100):
        x = rng.uniform(0.0, 10.0, 12)
        points = [a_point(i, rng, mean=3.0 * value, collective=value) for i, value in enumerate(x)]
        trends = load_trends(points, attribute_values(points, "collective"))
        z += [(item.slope - 3.0) / item.sigma_slope for item in trends if item.quantity == "mean"]
        p_values += [item.p_value for item in trends if item.quantity == "4/rev"]
    assert 0.9 < np.sqrt(np.mean(np.square(z))) < 1.1
    assert 0.02 < np.mean(np.array(p_values) < 0.05) < 0.08


def test_repeats_at_one_value_of_the_attribute_have_a_scatter_and_no_slope():
    rng = np.random.default_rng(5)
    trends = load_trends([a_point(i, rng) for i in range(40)], np.full(40, 17.5))
    assert all(np.isnan(trend.slope) for trend in trends)
    assert np.mean([trend.scatter for trend in trends]) == pytest.approx(1.0, abs=0.1)


def test_scatter_beyond_the_stated_sigma_widens_that_of_the_slope():
    rng = np.random.default_rng(2)
    x = np.linspace(0.0, 10.0, 40)
    points = [a_point(i, rng, mean=value + 5.0 * rng.standard_normal(), a=value) for i, value in enumerate(x)]
    trend = load_trends(points, x)[0]
    assert trend.scatter == pytest.approx(10.0, rel=0.3)
    assert trend.sigma_slope == pytest.approx(5.0 / np.sqrt(np.sum((x - x.mean()) ** 2)), rel=0.3)


def test_an_outlier_among_repeats_is_named_and_chance_names_none():
    rng = np.random.default_rng(3)
    false = 0
    for _ in range(100):
        points = [a_point(i, rng, mean=10.0) for i in range(8)]
        false += bool(find_outliers(points, repeats(points)))
    assert false <= 4  # 1 in 100 expected
    points[5] = a_point(5, rng, mean=10.0 + 30 * SIGMA)
    found = find_outliers(points, repeats(points))
    assert {item.run for item in found} == {"r5"}
    assert {item.component for item in found} == set(COMPONENTS)
    assert found[0].others == 7 and found[0].mean_of_others == pytest.approx(10.0, abs=1.0)


def a_common_error(points, sigma):
    """The same points with a stated sigma that is not their own: an error of the response, the same in all runs."""
    return [
        replace(item, loads=replace(item.loads, sigma_cosine=np.full((5, 6), sigma), sigma_sine=np.full((5, 6), sigma)))
        for item in points
    ]


def test_an_error_that_repeats_have_in_common_hides_no_outlier():
    rng = np.random.default_rng(6)
    points = [a_point(i, rng, mean=10.0) for i in range(8)]
    assert not find_outliers(a_common_error(points, 100.0), repeats(points))
    points[5] = a_point(5, rng, mean=10.0 + 30 * SIGMA)
    assert {item.run for item in find_outliers(a_common_error(points, 100.0), repeats(points))} == {"r5"}


def test_a_load_that_changes_amid_a_campaign_drifts_among_repeats():
    """Repeats of three speeds in turn: half of them are no outliers, and no residual test shows a rig that changed."""
    rng = np.random.default_rng(7)

    def campaign(change):
        shift = [change * (i >= 12) for i in range(24)]
        return [a_point(i, rng, speed=16.0 + i % 3, mean=5.0 * (i % 3) + shift[i]) for i in range(24)]

    def drifts_of(points):
        return find_repeat_drifts(points, repeats(points), np.arange(24.0))

    assert sum(bool(drifts_of(campaign(0.0))) for _ in range(50)) <= 3  # 0.5 expected
    found = drifts_of(campaign(-4.0))
    assert {(item.component, item.quantity) for item in found} == {(name, "mean") for name in COMPONENTS}
    assert found[0].last - found[0].first == pytest.approx(-4.0, abs=1.5)


def test_runs_of_other_conditions_are_no_repeats():
    rng = np.random.default_rng(4)
    points = [a_point(i, rng, collective=float(i % 2), speed=17.5 * (1.0 + 0.05 * (i % 3))) for i in range(12)]
    assert sorted(map(len, repeats(points))) == [2] * 6
    assert len(repeats([a_point(i, rng) for i in range(4)])) == 1


def drifts(rng, growth, given=None, count=30):
    x = np.arange(count, dtype=float)
    given = np.zeros(count) if given is None else given
    level = np.exp(growth * x + given) * rng.gamma(10.0, 0.1, count)
    return redundancy_drift(level, x, given)


def test_a_drift_of_the_residual_test_is_found_and_chance_finds_none():
    rng = np.random.default_rng(5)
    assert sum(drifts(rng, 0.0).is_significant for _ in range(300)) <= 9  # 3 expected
    found = [drifts(rng, 0.05) for _ in range(50)]
    assert all(item.is_significant for item in found)
    assert np.median([item.factor for item in found]) == pytest.approx(np.exp(0.05 * 29), rel=0.1)
    assert found[0].last > 2 * found[0].first


def test_what_the_attribute_explains_is_no_drift():
    rng = np.random.default_rng(6)
    found = []
    for _ in range(50):
        speed = np.linspace(0.0, 4.0, 30) + 0.4 * rng.standard_normal(30)  # it rose in the course of the campaign
        found.append(drifts(rng, 0.0, given=speed))
    assert all(drift.p_value < 1e-4 for drift in found)
    assert sum(drift.is_significant for drift in found) <= 3


def test_without_redundant_channels_or_with_few_runs_nothing_is_said_of_drift():
    rng = np.random.default_rng(7)
    point = a_point(0, rng, redundancy=np.nan)
    assert np.isnan(mean_redundancy(point.loads))
    assert redundancy_drift(np.full(20, np.nan), np.arange(20.0), np.zeros(20)) is None
    assert drifts(rng, 0.0, count=7) is None


def test_runs_are_placed_by_their_time_or_in_the_order_given():
    rng = np.random.default_rng(8)
    times = ["2026-03-02T10:00", "2026-03-01T10:00:00+00:00", "2026-03-01T22:00Z"]
    place, unit = sequence([a_point(i, rng, recorded=text) for i, text in enumerate(times)])
    assert unit == "days" and place == pytest.approx([1.0, 0.0, 0.5])
    place, unit = sequence([a_point(i, rng, recorded=text) for i, text in enumerate([*times, "in the morning"])])
    assert unit == "runs" and list(place) == [0, 1, 2, 3]


def test_an_unknown_attribute_names_those_that_there_are():
    rng = np.random.default_rng(9)
    points = [a_point(i, rng, collective=1.0, operator="me") for i in range(3)]
    for name in ("pitch", "operator"):
        with pytest.raises(UserError, match="collective, rotor_speed, speed"):
            attribute_values(points, name)


def test_one_run_and_a_run_twice_are_refused():
    point = a_point(0, np.random.default_rng(10))
    with pytest.raises(UserError, match="one run has no trend"):
        require_runs([point])
    with pytest.raises(UserError, match="has the run `r0`, which loads"):
        require_runs([point, replace(point, file="b.h5")])
