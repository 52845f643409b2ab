"""The verdict on a run has words for every flag."""

from dataclasses import replace

import pytest

from balance_cli.reduction.flags import FLAGS
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.run_verdict import MEANINGS, run_verdict
from balance_cli.steps.reduce import reduce_run


@pytest.fixture(scope="module")
def loads(campaign, calibration, identified):
    return reduce_run(campaign.runs_of_kind("wind")[0], campaign.geometry, calibration, model_source(identified))


@pytest.mark.parametrize("flag", FLAGS)
def test_every_flag_has_a_meaning(loads, flag):
    """`no weight` and `no temperature` had none: an internal error that ended a batch."""
    flagged = replace(loads, flags=((flag,) * len(loads.components), *loads.flags[1:]))
    reasons = run_verdict(flagged).reasons
    assert any(flag in reason for reason in reasons)
    assert flag in MEANINGS
