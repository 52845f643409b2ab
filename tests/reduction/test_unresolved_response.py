"""Harmonics between lines of a measured response that are far apart: flagged, and right where a line is."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.reduction.measured_response import transfer_source
from balance_cli.signals.response.interpolation_error import interpolate_and_judge
from balance_cli.signals.response.transfer import Transfer
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.sweep_tf import estimate_responses

LINE_FIELDS = ("frequency", "response", "channel_covariance", "load_covariance", "coherence", "multiple_coherence")


@pytest.fixture(scope="module")
def responses(campaign):
    return estimate_responses(campaign.runs, campaign.geometry)


def thinned(responses: Transfer, step: int) -> Transfer:
    """The responses of every `step`th line."""
    few = [replace(item, **{name: getattr(item, name)[::step] for name in LINE_FIELDS}) for item in responses.responses]
    return replace(responses, responses=tuple(few))


def test_lines_that_are_too_far_apart_are_flagged_and_close_ones_are_not(campaign, responses):
    check = campaign.runs_of_kind("check")[0]
    close, far = (
        reduce_run(check, campaign.geometry, None, transfer_source(thinned(responses, step), "local"))
        for step in (1, 24)
    )
    assert not any("not resolved" in flag for row in close.flags for flag in row)
    assert not any("too far apart" in note for note in close.notes)
    unresolved = np.array([["not resolved" in flag for flag in row] for row in far.flags])
    assert not unresolved[0].any() and np.mean(unresolved[1:]) > 0.3
    assert any("too far apart to tell the response" in note for note in far.notes)
    cosine, sine = campaign.truths[check.name].harmonics(*far.interval)
    truth = (cosine - 1j * sine)[1 : len(far.amplitude)]
    wrong = np.abs(far.amplitude[1:] - truth) > 0.3 * np.abs(truth)
    assert not (wrong & (truth != 0.0) & ~unresolved[1:]).any()


def test_a_response_is_interpolated_once_at_the_harmonics_of_a_run(responses, monkeypatch):
    """A thousand runs by measured responses: each test of a run asks for the covariance at the same harmonics."""
    source, frequency = transfer_source(responses, "local"), np.array([12.0, 24.0])
    asked = []

    def counted(*arguments):
        asked.append(arguments)
        return interpolate_and_judge(*arguments)

    monkeypatch.setattr("balance_cli.signals.response.interpolation_error.interpolate_and_judge", counted)
    loads = np.ones((2, 6), complex)
    first, again, form = (
        of(frequency, *rest)
        for of, rest in (
            (source.covariance, (0.0, loads)),
            (source.covariance, (0.0, 2.0 * loads)),
            (source.form_covariance, (loads,)),
        )
    )
    assert len(asked) == len(source.responses)
    np.testing.assert_allclose(again, 4.0 * first)
    assert form.shape == first.shape
    source.covariance(frequency + 1.0, 0.0, loads)
    assert len(asked) == 2 * len(source.responses)
