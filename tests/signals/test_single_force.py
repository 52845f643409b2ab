"""One force at one point drives several hub loads: their spectrum is that of the force, its noise in the channels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.additions import FORCE, LoadPoints, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.signals.single_force import single_force
from balance_cli.simulation import true_rig
from balance_cli.simulation.replay import replay_loads
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.other_rigs import other_rig

RATE, SAMPLES, PERIOD = 2000.0, 20000, 2000
HUB_LOADS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
DIRECTION, POSITION = np.array([0.0, 0.6, 0.8]), np.array([0.2, 0.1, 0.0])


def swept_at_a_point(force_noise: float, periodic: bool, seed: int = 1) -> Run:
    """Rig A, driven by a stinger beside the hub: six hub loads of one signal."""
    geometry, rng = other_rig("A"), np.random.default_rng(seed)
    spectrum = np.zeros((PERIOD if periodic else SAMPLES) // 2 + 1, complex)
    length = 2 * (len(spectrum) - 1)
    inside = (np.arange(len(spectrum)) * RATE / length > 10.0) & (np.arange(len(spectrum)) * RATE / length < 260.0)
    spectrum[inside] = np.exp(2j * np.pi * rng.random(np.count_nonzero(inside)))
    force = np.tile(np.fft.irfft(spectrum), SAMPLES // length)
    force *= 20.0 / np.std(force)
    arm = POSITION - np.array(geometry.hub)
    loads = force[:, None] * np.hstack([DIRECTION, np.cross(arm, DIRECTION)])
    volts = replay_loads(true_rig(geometry), loads, "sweep", RATE)
    volts = volts + 1e-3 * rng.standard_normal(volts.shape)
    measured = (force + force_noise * rng.standard_normal(SAMPLES))[:, None]
    points = LoadPoints(("stinger",), DIRECTION[None], POSITION[None])
    additions = RunAdditions(points, source=MemoryAdditions({FORCE: measured}))
    declared = {"excited": ("Fz",), "level": (20.0,), "excitation": "multisine" if periodic else "random"}
    names = geometry.channel_names
    run = Run("stinger", geometry.rig, "sweep", names, SAMPLES, MemorySource(volts, None), False, RATE, **declared)
    run = replace(run, additions=additions, period=PERIOD / RATE if periodic else None)
    return with_hub_loads(run, geometry)


def test_multiples_are_those_of_statics():
    force = single_force(swept_at_a_point(0.1, True))
    assert force.component == "Fz" and force.components == tuple(n for n in HUB_LOADS if n != "Fx")
    arm = POSITION - np.array(other_rig("A").hub)
    expected = np.hstack([DIRECTION, np.cross(arm, DIRECTION)]) / DIRECTION[2]
    np.testing.assert_allclose(force.multiples, expected, atol=1e-9)
    assert (
        single_force(force.run) is None and single_force(replace(swept_at_a_point(0.1, True), additions=None)) is None
    )


def _chi2_per_value(run: Run) -> float:
    geometry = other_rig("A")
    spectra = measured_spectra([run], geometry)
    (batch,) = stack_runs(spectra.lines, (), geometry.channel_names)
    assert isinstance(batch, Batch) and set(spectra.lines[0].components) == set(HUB_LOADS) - {"Fx"}
    return float(data_chi2([batch], balance_model(geometry).system())) / float(batch.lines.count.sum())


def test_chi_square_of_the_true_rig_is_one():
    """With 0.3 N of noise on the force, which moves channels by more than their own noise does."""
    for periodic in (True, False):
        assert 0.8 < _chi2_per_value(swept_at_a_point(0.3, periodic)) < 1.25


def test_measured_responses_leave_such_a_run_out():
    run = swept_at_a_point(0.3, True)
    with pytest.raises(UserError, match="one force at one point"):
        estimate_responses([run], other_rig("A"))
