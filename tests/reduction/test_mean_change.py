"""A zero of one channel that steps within a record: what it changes of the mean loads is in their sigma."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.flags import NO_ZERO, NOT_STEADY
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.simulation import draw_rig, simulate_campaign, simulate_run, true_rig
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.channels import with_channel
from tests.support.other_rigs import other_rig, short_campaign


@pytest.fixture(scope="module")
def small():
    """The small rig of twelve cells: calibration, computed response, a wind run and its mean loads."""
    geometry, plan = other_rig("E"), short_campaign("E", revolutions=200)
    runs = tuple(run for run in plan.runs if run.run in ("static-bare", "static-trim", "wind-1"))
    simulated = simulate_campaign(
        draw_rig(geometry, np.random.default_rng(3)), plan.model_copy(update={"runs": runs}), seed=3
    )
    calibration = calibrate(simulated.runs[:2], geometry)
    return calibration, simulated.runs[2], simulated.truths[2].cosine[0]


@pytest.mark.parametrize("channel", ["v1.strain", "t6.strain"])
@pytest.mark.parametrize("place", [0.3, 0.5])
def test_a_zero_that_steps_is_in_sigma_of_all_mean_loads(small, channel, place):
    calibration, wind, means = small
    geometry = calibration.geometry
    source = model_source(identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed")))
    step = 0.003 * 0.04 * 2000.0

    def stepped(volts):
        return volts + step * (np.arange(len(volts)) > place * len(volts))

    loads = reduce_run(with_channel(wind, channel, stepped), geometry, calibration, source)
    said = np.array([flag not in ("", NO_ZERO) for flag in loads.flags[0]])
    error = np.abs(loads.amplitude[0].real - means) / loads.sigma_cosine[0]
    assert np.all(said | (error < 3.0))


def test_a_drift_of_a_mean_is_seen_beside_a_mode_that_rings_longer_than_a_window():
    """The lowest mode rings 2.3 s and makes four periods in a window: it does not shake the means of windows."""
    geometry, plan = other_rig("D"), short_campaign("D", revolutions=150)
    runs = tuple(run for run in plan.runs if run.run in ("static-bare", "static-trim", "wind-1"))
    rig = replace(true_rig(geometry), damping_ratios=np.full(6, 0.003))
    simulated = simulate_campaign(rig, plan.model_copy(update={"runs": runs}), seed=3)
    calibration = calibrate(simulated.runs[:2], geometry)
    light = geometry.model_copy(update={"damping_ratio": 0.003})
    source = model_source(identify(Spectra((), (), {}, {}), light, IdentifyOptions(method="computed")))
    wind, means = simulated.runs[2], simulated.truths[2].cosine[0]

    def drifting(volts):
        return volts + np.std(volts) * np.linspace(0.0, 1.0, len(volts))

    steady = reduce_run(wind, geometry, calibration, source)
    assert not any(NOT_STEADY in flag for flag in steady.flags[0])
    loads = reduce_run(with_channel(wind, "x.strain", drifting), geometry, calibration, source)
    assert NOT_STEADY in loads.flags[0][0]
    assert np.all(np.abs(loads.amplitude[0].real - means) < 5.0 * loads.sigma_cosine[0])


@pytest.mark.parametrize("drift", [0.02, 0.3])
def test_a_zero_that_drifts_is_in_sigma_of_all_mean_loads(small, drift):
    """The drift is a share of the largest reading of a channel of the wind run."""
    calibration, wind, means = small
    geometry = calibration.geometry
    source = model_source(identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed")))
    plan = short_campaign("E", revolutions=200).runs
    record = simulate_run(true_rig(geometry), next(run for run in plan if run.run == "zero"), seed=4)[0]
    volts = record.read().channels
    size = drift * np.abs(wind.read().channels).max(axis=0) * np.linspace(0.0, 1.0, len(volts))[:, None]
    names = [channel.name for channel in geometry.channels if channel.measures_dc]

    def error(values):
        zero = zero_record(replace(record, source=MemorySource(values, None)), names)
        loads = reduce_run(wind, geometry, calibration, source, zero)
        return np.abs(loads.amplitude[0].real - means) / loads.sigma_cosine[0]

    assert np.all(error(volts) < 4.0)
    assert np.all(error(volts + size) < 4.0)
