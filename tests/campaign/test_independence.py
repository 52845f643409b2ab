"""What a response does not determine is told from what it determines poorly."""

import numpy as np
import pytest

from balance_cli.campaign.rig.independence import has_independent_columns, negligible_columns


@pytest.fixture
def response():
    rng = np.random.default_rng(4)
    return rng.standard_normal((3, 8, 6)) + 1j * rng.standard_normal((3, 8, 6))


def test_a_column_of_rounding_errors_is_no_response(response):
    assert has_independent_columns(response, np.ones(6))
    response[1, :, 5] *= 1e-13
    assert not has_independent_columns(response[1].real)
    assert list(np.flatnonzero(negligible_columns(response, np.ones(6)))) == [5]
    assert not has_independent_columns(response, np.ones(6))


def test_the_unit_of_moments_decides_nothing(response):
    scale = np.array([1.0, 1.0, 1.0, 1e9, 1e9, 1e9])
    assert has_independent_columns(response * scale, scale)


def test_two_loads_that_the_channels_do_not_tell_apart_are_not_determined(response):
    response[:, :, 1] = 3.0 * response[:, :, 0]
    assert not negligible_columns(response, np.ones(6)).any()
    assert not has_independent_columns(response, np.ones(6))


def test_fewer_channels_than_loads_determine_none(response):
    assert not has_independent_columns(response[:, :5], np.ones(6))
