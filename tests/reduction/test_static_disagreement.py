"""Mean loads where the calibration and the model differ at rest: the difference is in sigma, and named."""

from __future__ import annotations

import numpy as np
import pytest

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.wind_off import zero_record
from balance_cli.simulation import CampaignPlan, simulate_campaign, true_rig
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.channels import with_channel
from tests.support.other_rigs import other_rig, short_campaign

RIG = other_rig("A")
"""Six cells: the response at rest is that of equilibrium, whatever the stiffness of the cells."""
CREEP = 0.003
WORDS = "calibration and model differ at rest"


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    plan = short_campaign("A", revolutions=60)
    some = tuple(run for run in plan.runs if run.kind in ("static", "zero", "wind"))
    return {run.name: run for run in simulate_campaign(true_rig(RIG), CampaignPlan(runs=some), seed=4).runs}


def calibration(runs: dict[str, Run], creep: float) -> Calibration:
    """A calibration in which each gauge reads more than in a record in time, as one that creeps does."""
    statics = [run for run in runs.values() if run.kind == "static"]
    for name in RIG.channel_names:
        if name.endswith("strain"):
            statics = [with_channel(run, name, lambda volts: (1.0 + creep) * volts) for run in statics]
    return calibrate(statics, RIG)


def reduced(runs: dict[str, Run], creep: float) -> RunLoads:
    source = model_source(identify(measured_spectra([], RIG), RIG, IdentifyOptions(method="computed")))
    return reduce_run(
        runs["wind-1"], RIG, calibration(runs, creep), source, zero_record(runs["zero"], RIG.channel_names)
    )


def test_the_difference_is_in_sigma_and_named(runs: dict[str, Run]) -> None:
    sound, crept = reduced(runs, 0.0), reduced(runs, CREEP)
    assert not any(WORDS in note for note in sound.notes)
    (note,) = (note for note in crept.notes if WORDS in note)
    assert "the mean Fz by 2 N (720" in note
    difference = crept.amplitude[0].real - sound.amplitude[0].real
    np.testing.assert_allclose(difference[2], -CREEP * sound.amplitude[0, 2].real, rtol=0.02)
    assert abs(difference[2]) > 10.0 * sound.sigma_cosine[0, 2]
    assert np.all(np.abs(difference) < 1.2 * crept.sigma_cosine[0])


def test_no_other_harmonic_depends_on_it(runs: dict[str, Run]) -> None:
    sound, crept = reduced(runs, 0.0), reduced(runs, CREEP)
    np.testing.assert_array_equal(crept.amplitude[1:], sound.amplitude[1:])
    np.testing.assert_array_equal(crept.sigma_cosine[1:], sound.sigma_cosine[1:])
