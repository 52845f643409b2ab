"""One force at one point drives several hub loads: their spectrum is that of the force, its noise in the channels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import FORCE, LoadPoints, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.signals.local.models import fit_local_models
from balance_cli.signals.local.scaled_spectrum import record_spectrum
from balance_cli.signals.response.point_forces import PointForce, combine_point_forces
from balance_cli.signals.response.transfer import Transfer, response_to_component
from balance_cli.signals.run_spectrum import FrequencyResponse
from balance_cli.signals.single_force import single_force
from balance_cli.simulation import true_rig
from balance_cli.simulation.replay import replay_loads
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.other_rigs import other_rig
from tests.support.truth import true_response

Array = NDArray[np.float64]

RATE, SAMPLES, PERIOD = 2000.0, 20000, 2000
HUB_LOADS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
DIRECTION, POSITION = np.array([0.0, 0.6, 0.8]), np.array([0.2, 0.1, 0.0])


def swept_at_a_point(
    force_noise: float,
    periodic: bool,
    seed: int = 1,
    position: Array = POSITION,
    direction: Array = DIRECTION,
    samples: int = SAMPLES,
) -> Run:
    """Rig A, driven by a stinger beside the hub: six hub loads of one signal."""
    geometry, rng = other_rig("A"), np.random.default_rng(seed)
    spectrum = np.zeros((PERIOD if periodic else samples) // 2 + 1, complex)
    length = 2 * (len(spectrum) - 1)
    inside = (np.arange(len(spectrum)) * RATE / length > 10.0) & (np.arange(len(spectrum)) * RATE / length < 260.0)
    spectrum[inside] = np.exp(2j * np.pi * rng.random(np.count_nonzero(inside)))
    force = np.tile(np.fft.irfft(spectrum), samples // length)
    force *= 20.0 / np.std(force)
    arm = position - np.array(geometry.hub)
    loads = force[:, None] * np.hstack([direction, np.cross(arm, direction)])
    volts = replay_loads(true_rig(geometry), loads, "sweep", RATE)
    volts = volts + 1e-3 * rng.standard_normal(volts.shape)
    measured = (force + force_noise * rng.standard_normal(samples))[:, None]
    points = LoadPoints(("stinger",), direction[None], position[None])
    additions = RunAdditions(points, source=MemoryAdditions({FORCE: measured}))
    declared = {"excited": ("Fz",), "level": (20.0,), "excitation": "multisine" if periodic else "random"}
    names = geometry.channel_names
    source = MemorySource(volts, None)
    run = Run(f"stinger-{seed}", geometry.rig, "sweep", names, samples, source, False, RATE, **declared)
    run = replace(run, additions=additions, period=PERIOD / RATE if periodic else None)
    return with_hub_loads(run, geometry)


def test_multiples_are_those_of_statics():
    force = single_force(swept_at_a_point(0.1, True))
    assert force.component == "Fz" and force.components == tuple(n for n in HUB_LOADS if n != "Fx")
    arm = POSITION - np.array(other_rig("A").hub)
    expected = np.hstack([DIRECTION, np.cross(arm, DIRECTION)]) / DIRECTION[2]
    np.testing.assert_allclose(force.multiples, expected, atol=1e-9)
    assert single_force(force.run) is None


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_hub_loads_of_one_force_cell_are_a_single_force(kind):
    """A shaker at an angle, whose signal was written times its direction and lever arms, as hub loads."""
    run = swept_at_a_point(0.1, True)
    block = run.read()
    written = replace(run, additions=None, source=MemorySource(block.channels, block.loads.astype(kind).astype(float)))
    force = single_force(written)
    np.testing.assert_allclose(force.multiples, single_force(run).multiples, rtol=1e-6)
    independent = block.loads + 1e-3 * np.random.default_rng(1).standard_normal(block.loads.shape)
    assert single_force(replace(written, source=MemorySource(block.channels, independent))) is None


def _chi2_per_value(run: Run) -> float:
    geometry = other_rig("A")
    spectra = measured_spectra([run], geometry)
    (batch,) = stack_runs(spectra.lines, (), geometry.channel_names)
    assert isinstance(batch, Batch) and set(spectra.lines[0].components) == set(HUB_LOADS) - {"Fx"}
    return float(data_chi2([batch], balance_model(geometry).system())) / float(batch.lines.count.sum())


@pytest.mark.parametrize("force_noise", [0.3, 1.0])
def test_chi_square_of_the_true_rig_is_one(force_noise):
    """The noise of the force [N] moves channels by more than their own noise does, beside modes by much more."""
    records = [(True, 1), (False, 1), (False, 2), (False, 3)]
    for periodic, seed in records if force_noise == 1.0 else records[:2]:
        run = swept_at_a_point(force_noise, periodic, seed, samples=SAMPLES if periodic else SAMPLES // 2)
        assert 0.8 < _chi2_per_value(run) < 1.25


def test_zeros_of_bridges_are_no_error_of_their_means():
    """The mean over that of the force had passed for the response: the mean had an error as large as its zero."""
    run = swept_at_a_point(0.3, True)
    block = run.read()
    shifted = replace(run, source=MemorySource(block.channels + 0.05, block.loads))
    spectra = [measured_spectra([item], other_rig("A"), means=True).lines[0] for item in (run, shifted)]
    c = len(run.channel_names)
    errors = [np.diagonal(lines.covariance[lines.frequency == 0][0]).real[:c] ** 0.5 for lines in spectra]
    known = np.isfinite(errors[0])
    np.testing.assert_allclose(errors[1][known], errors[0][known], rtol=0.05)
    assert np.max(errors[1][known]) < 5e-4


def test_noise_of_a_force_is_found_where_lines_have_none():
    """Beyond 260 Hz there is no force, and the response to its noise is noise: nothing there tells of the force."""
    force = single_force(swept_at_a_point(1.0, False, samples=SAMPLES // 2))
    assert force is not None
    models = fit_local_models(record_spectrum(force.run, force.run.channel_names, (0.0, np.inf)))
    sigma = np.sqrt(models.noise.loads[0, 0].real) * models.spectrum.load_scale[0]
    assert sigma == pytest.approx(DIRECTION[2] * 2.0 / np.sqrt(SAMPLES // 2), rel=0.05)


def test_forces_that_span_the_hub_loads_give_their_responses():
    """Seven of them for six loads, with errors of the size that the covariance says."""
    rng, x, y, z = np.random.default_rng(5), *np.eye(3)
    directions = [z, z, z, x, x, y, DIRECTION]
    runs = [
        swept_at_a_point(0.1, True, seed, 0.3 * rng.standard_normal(3), direction, 5 * PERIOD)
        for seed, direction in enumerate(directions)
    ]
    assert campaign_findings(other_rig("A"), runs) == ()
    (found,) = estimate_responses(runs, other_rig("A")).responses
    truth = true_response(true_rig(other_rig("A")), found.frequency)
    rows = [other_rig("A").channel_names.index(name) for name in found.channel_names]
    variance = (
        np.einsum("kcc->kc", found.channel_covariance)[:, :, None]
        * np.einsum("kuu->ku", found.load_covariance)[:, None]
    )
    assert found.components == HUB_LOADS and len(found.frequency) > 200
    undeclared = Transfer(other_rig("A"), (replace(found, level=()),))
    assert response_to_component(undeclared, "Mz").components == ("Mz",) and min(found.level) > 0.0
    assert 0.8 < np.mean(np.abs(found.response - truth[:, rows]) ** 2 / variance.real) < 1.25
    with pytest.raises(UserError, match="4 forces at points drove 5 hub loads in 4 combinations: nothing drove"):
        estimate_responses(runs[:4], other_rig("A"))


def test_sweeps_of_single_hub_loads_complete_the_forces_at_points():
    """Two forces along z at points drive Fz, Mx and My; the third combination is Fz alone, from a sweep at the hub."""
    geometry, z = other_rig("A"), np.array([0.0, 0.0, 1.0])
    beside = [
        swept_at_a_point(0.1, True, seed, np.array(at), z) for seed, at in enumerate([[0.2, 0.1, 0], [-0.1, 0.2, 0]])
    ]
    at_hub = swept_at_a_point(0.1, True, 7, np.array(geometry.hub), z)
    assert single_force(at_hub) is None
    with pytest.raises(UserError, match="2 forces at points drove 3 hub loads"):
        estimate_responses(beside, geometry)
    transfer = estimate_responses([*beside, at_hub], geometry)
    (found,) = transfer.responses
    assert found.components == ("Fz", "Mx", "My") and not transfer.unused_runs
    truth = true_response(true_rig(geometry), found.frequency)
    rows = [geometry.channel_names.index(name) for name in found.channel_names]
    columns = [HUB_LOADS.index(name) for name in found.components]
    variance = np.einsum("kcc,kuu->kcu", found.channel_covariance, found.load_covariance).real
    error = found.response - truth[:, rows][:, :, columns]
    assert 0.6 < np.mean(np.abs(error) ** 2 / variance) < 1.6
    with pytest.raises(UserError, match="no response to Fx, Fy, Mz was measured"):
        transfer_source(transfer, "local")


def test_forces_of_records_of_several_lengths_are_interpolated():
    """A response of one mode, lines of 0.5, 0.6 and 0.7 Hz."""
    multiples = np.array([[0, 0, 1.0, 0.2, 0, 0], [0, 0, 1.0, -0.3, 0.1, 0], [0, 0, 1.0, 0.0, 0.4, 0]])

    def mode(frequency: Array) -> Array:
        weights = np.array([[1.0, 0.5, -0.2], [0.3, -1.0, 0.6]])
        return weights / (1.0 - (frequency / 60.0) ** 2 + 0.06j * frequency / 60.0)[:, None, None]

    def response(step: float, row: Array) -> FrequencyResponse:
        lines = np.arange(10.0, 120.0, step)
        value, ones = mode(lines) @ row[2:5, None], np.ones((len(lines), 1, 1))
        noise = 1e-10 * ones * np.eye(2)
        names = ("a", "b"), ("Fz",)
        coherence = np.ones(value.shape)
        return FrequencyResponse(
            "run", *names, "lrm", lines, value, noise, ones, coherence, coherence[:, :, 0], level=(1.0,)
        )

    forces = [PointForce(response(step, row), row) for step, row in zip((0.5, 0.6, 0.7), multiples, strict=True)]
    found = combine_point_forces(forces)
    assert found.components == ("Fz", "Mx", "My") and len(found.frequency) > 150
    np.testing.assert_allclose(found.response, mode(found.frequency), atol=2e-3 * np.abs(mode(found.frequency)).max())
