"""The reading of the unloaded rig, from records of any length, and the channels that it lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.wind_off import ZERO_SEGMENTS, zero_record
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduction_inputs import compared_zero
from tests.support.nonlinear_rig import NAMES, record
from tests.support.static_runs import AMPLITUDE, C0, RIG, loading, static_run


def zero_of(values: np.ndarray) -> Run:
    names = tuple(f"c{k}" for k in range(values.shape[1]))
    return Run(
        name="zero", rig="R", kind="zero", channel_names=names, samples=len(values), source=MemorySource(values, None)
    )


@pytest.mark.parametrize("samples", [3, 5, 10, 16, 400])
def test_the_error_of_a_zero_of_any_length_covers(samples: int) -> None:
    values = np.random.default_rng(samples).normal(size=(samples, 4000))
    zero = zero_record(zero_of(values), [f"c{k}" for k in range(4000)])
    np.testing.assert_allclose(zero.mean, values.mean(axis=0))
    assert zero.segments == min(samples, ZERO_SEGMENTS)
    # A drift that chance feigns widens a few of them.
    assert 0.92 < np.mean(np.abs(zero.mean) < 1.96 * np.sqrt(zero.variance)) < 0.985


def test_a_zero_without_scatter_is_refused() -> None:
    with pytest.raises(UserError, match="a zero of 2 samples"):
        zero_record(zero_of(np.ones((2, 3))), ["c0", "c1", "c2"])


def test_a_channel_that_the_zero_alone_lacks_is_named() -> None:
    calibration = calibrate([static_run(RIG, C0, loading(), np.random.default_rng(1))], RIG)
    wind, whole = record("w", 0.5 * AMPLITUDE), record("z", np.zeros(6), kind="zero")
    assert compared_zero([whole], calibration, wind)[1] == ""
    channels = whole.read().channels.copy()
    channels[:, 2] = 0.3
    dead = replace(whole, source=MemorySource(channels, None))
    zero, warning = compared_zero([dead], calibration, wind)
    assert zero is not None and NAMES[2] not in zero.channel_names
    assert warning.startswith(f"mean loads do without {NAMES[2]} (")


def test_a_record_without_means_measures_no_mean_loads(campaign, calibration, identified):
    """All mean loads had been those of a rig without load, with an empty flag."""
    run, source = campaign.runs_of_kind("wind")[0], model_source(identified)
    volts = np.asarray(run.read().channels)
    without = replace(run, source=MemorySource(volts - volts.mean(axis=0), None))
    loads = reduce_run(without, campaign.geometry, calibration, source)
    assert np.isnan(loads.amplitude[0]).all() and all("not measured" in flag for flag in loads.flags[0])
    assert any("were the means taken out of the record?" in note for note in loads.notes)
    sound = reduce_run(run, campaign.geometry, calibration, source)
    np.testing.assert_allclose(loads.amplitude[1:], sound.amplitude[1:], rtol=1e-4, atol=1e-4)
    assert np.isfinite(sound.amplitude[0]).all()
