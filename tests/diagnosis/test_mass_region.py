"""Which masses at which places the data allow: against refits with mass and place held, and against brute force."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.search import mass_score
from balance_cli.diagnosis.search.mass_region import CHI2_95, mass_intervals, mass_region, search_mass_region
from balance_cli.diagnosis.search.point_mass import refine_point_mass, score_without_point_mass
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from tests.support.mass_campaign import DECLARED, WEIGHED, Campaign, mass_and_place

CLOSE = replace(SETTINGS.fit, comparison_tolerance=0.01)


@pytest.fixture(scope="module")
def declared():
    """A mass of 0.6 kg beside tolerances: a gain of 500, and a long valley."""
    campaign = Campaign(DECLARED, 0.6)
    start = refine_point_mass(campaign.begun_at(0), campaign.batches, SETTINGS)
    return campaign, fit_all_lines(start, campaign.batches, SETTINGS.fit)


def test_at_the_ends_refits_lose_what_they_should(declared):
    """With mass and place held there and all else fitted anew, by the likelihood of all lines."""
    campaign, fit = declared
    region = mass_region(fit, campaign.batches, SETTINGS)
    at = mass_and_place(fit.model)
    held = fit.model.with_sigma(np.where(np.isin(np.arange(len(fit.theta)), at), 0.0, fit.model.parameters.sigma))
    for mass_and_place_there in (region.ends[0, 0], region.ends[0, 1], region.ends[1, 0], region.ends[3, 1]):
        theta = fit.theta.copy()
        theta[at] = mass_and_place_there
        rise = fit_all_lines(held.at(theta), campaign.batches, CLOSE).chi2 - fit.chi2
        assert rise == pytest.approx(CHI2_95, abs=0.4)


def test_a_mass_is_outside_where_refits_with_it_say_so(declared):
    """By the likelihood with nothing but the mass held: the truth is one in twenty that lie outside."""
    campaign, fit = declared
    intervals = mass_intervals(fit, campaign.batches, SETTINGS)
    assert list(intervals) == [f"added-mass.{name}" for name in ("mass", "x", "y", "z")]
    lower, upper = intervals["added-mass.mass"]
    at = mass_and_place(fit.model)
    for mass in (0.5 * lower, 0.9 * upper, campaign.mass):
        assert (lower < mass < upper) == (rise_with_mass_held(campaign, fit, at[0], mass) < CHI2_95)


def test_a_fit_that_is_not_at_its_minimum_has_no_region(declared):
    campaign, fit = declared
    theta = fit.theta.copy()
    theta[mass_and_place(fit.model)[0]] *= -1.0
    assert mass_intervals(fit.model.at(theta), campaign.batches, SETTINGS) == {}


def rise_with_mass_held(campaign, fit, at, mass):
    sigma = np.where(np.arange(len(fit.theta)) == at, 0.0, fit.model.parameters.sigma)
    theta = fit.theta.copy()
    theta[at] = mass
    return fit_all_lines(fit.model.with_sigma(sigma).at(theta), campaign.batches, CLOSE).chi2 - fit.chi2


def test_where_nothing_else_does_the_same_it_is_that_of_sigma():
    campaign = Campaign(WEIGHED, -0.3)
    fit = campaign.fit_from_the_truth()
    at = mass_and_place(fit.model)
    free = np.flatnonzero(fit.model.parameters.free)
    covariance = np.linalg.inv(fit.minimum.total.information)
    sigma = np.sqrt(np.diag(covariance))[np.searchsorted(free, at)]
    intervals = mass_region(fit, campaign.batches, SETTINGS).intervals
    half = np.sqrt(CHI2_95) * sigma
    np.testing.assert_allclose(intervals, fit.theta[at][:, None] + half[:, None] * [-1.0, 1.0], atol=0.05 * half.max())
    np.testing.assert_allclose((intervals[:, 1] - intervals[:, 0]) / (2.0 * half), 1.0, atol=0.05)


def test_no_place_found_by_chance_lies_outside(declared):
    """A million places, half of them about the best one: none within 3.84 is beyond the ends by a hundredth."""
    campaign, fit = declared
    at = np.array(mass_and_place(fit.model))
    masses = score_without_point_mass(fit, campaign.batches, at, SETTINGS.point_mass)
    region = search_mass_region(masses, fit.theta[at[1:]], 1.5, SETTINGS.mass_region)
    rng = np.random.default_rng(3)
    places = np.vstack([rng.uniform(-1.5, 1.5, (500_000, 3)), fit.theta[at[1:]] + 0.3 * rng.normal(size=(500_000, 3))])
    places = places[np.abs(places).max(axis=1) < 1.5]
    c = mass_score.mass_weights(places)
    slope, information = c @ masses.s, np.sum((c @ masses.V) * c, axis=1)
    gain = slope**2 / information
    best = max(gain.max(), float(np.max(_gain_at(masses, region.ends.reshape(-1, 4)))))
    inside = gain > best - CHI2_95
    assert inside.sum() > 20
    lower, upper = region.intervals.T
    found = np.column_stack([slope / information, places])[inside]
    slack = 0.01 * (upper - lower)
    assert np.all(found > lower - slack) and np.all(found < upper + slack)


def _gain_at(masses, mass_and_place_there):
    c = mass_score.mass_weights(mass_and_place_there[:, 1:])
    return (c @ masses.s) ** 2 / np.sum((c @ masses.V) * c, axis=1)


def test_a_model_without_a_mass_has_none(declared):
    campaign, _ = declared
    assert mass_region(campaign.fit, campaign.batches, SETTINGS) is None
    assert mass_intervals(campaign.fit, campaign.batches, SETTINGS) == {}
