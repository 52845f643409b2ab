"""A light mode that still rings beside a harmonic: what is left of the start transient is no load."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction import free_decays, harmonic_loads, rotor_record
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.other_lines import OtherLines
from balance_cli.simulation import NO_NOISE, RotorPlan, simulate_run, true_rig
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.other_rigs import other_rig

LIGHT = other_rig("A").model_copy(update={"damping_ratio": 3e-4})
NOISE = 1e-5
"""Volts of each sample; the channels read volts."""


@pytest.fixture(scope="module")
def source():
    return ModelSource(identify(Spectra((), (), (), {}), LIGHT, IdentifyOptions(method="computed")))


@pytest.fixture(scope="module", params=[(0.93, 0.0), (1.08, 3e-3)], ids=["below", "above, speed varies"])
def record(request, source):
    """1/rev 7 % below the lowest mode, or 8 % above; 8 s after the start the mode still rings."""
    share, drift = request.param
    speed = share * source.model.modes.frequency[0]
    plan = RotorPlan(
        run="wind",
        kind="wind",
        harmonics={"Fx": (20.0, 10.0, 5.0), "Fz": (40.0, 20.0, 10.0)},
        sample_rate=1000.0,
        duration=8.0,
        rotor_speed=speed,
        drift=drift,
        drift_period=5.0,
    )
    run, truth = simulate_run(true_rig(LIGHT), plan, NO_NOISE, 2)
    return _with_noise(run), truth


def _with_noise(run):
    channels = run.read().channels
    noise = NOISE * np.random.default_rng(4).standard_normal(channels.shape)
    return replace(run, source=MemorySource(channels + noise, None))


def _errors(run, truth, source):
    """Errors (2, m) of the cosines and sines at 3/rev over the standard deviation by noise alone."""
    rotor = rotor_record.rotor_record(run, LIGHT, source, 3)
    solved = harmonic_loads.harmonic_loads(rotor, LIGHT, source)
    cosine, sine = truth.harmonics(*rotor.spectra.interval)
    error = solved.loads[0] - (cosine - 1j * sine)[1]
    sigma = np.sqrt(np.diag(solved.noise_covariance[0])).reshape(2, -1)
    return np.stack([error.real, error.imag]) / sigma


def test_what_rings_beside_a_harmonic_is_fitted(record, source, monkeypatch):
    run, truth = record
    assert np.abs(_errors(run, truth, source)).max() < 5.0
    monkeypatch.setattr(free_decays, "DECAY_TIME_CONSTANTS", 0.0)
    assert np.abs(_errors(run, truth, source)).max() > 20.0


def test_modes_that_have_decayed_are_not_fitted(record, source):
    run, _ = record
    azimuth = azimuth_from_pulses(run.pulse_times)
    late = azimuth_from_pulses(run.pulse_times + 1e4)
    found, none = (free_decays.with_free_decays(OtherLines((7.0,)), run, item, 20, source) for item in (azimuth, late))
    np.testing.assert_allclose(np.abs(found.exponents[0]) / (2 * np.pi), source.model.modes.frequency[0], rtol=1e-6)
    assert found.frequencies == none.frequencies == (7.0,)
    assert none.exponents == ()


@pytest.mark.parametrize(("drift", "is_constant"), [(0.0, True), (1e-6, True), (3e-3, False)])
def test_the_response_to_harmonics_changes_where_the_speed_drifts(source, drift, is_constant):
    """There the harmonics change as slowly as modes decay, and would be taken for them."""
    pulses = np.arange(400) / (0.93 * source.model.modes.frequency[0])
    azimuth = azimuth_from_pulses(pulses * (1.0 - drift * pulses / pulses[-1]))
    run = Run("wind", "A", "wind", (), 8000, MemorySource(np.zeros((0, 0)), None), rotor_speed=azimuth.mean_rate)
    assert free_decays.response_is_constant(run, azimuth, 20, 3, source) is is_constant


@pytest.mark.parametrize("jump", [0.0, 1e-4])
def test_decays_are_those_of_their_exponents_at_even_and_at_uneven_times(jump):
    lines = OtherLines(exponents=(-0.8 + 142.0j, -7.4 + 372.0j), start=1.25)
    time = 1.25 + np.arange(1000) / 800.0
    time[300:] += jump
    exact = np.exp(np.outer(time - 1.25, lines.exponents))
    basis = lines.basis(time).T
    assert basis == pytest.approx(np.hstack([exact.real, exact.imag]), rel=0.0, abs=1e-12)


def test_a_decay_leaves_the_regression_once_it_has_faded():
    lines = OtherLines((7.0,), (-0.8 + 142.0j, -7.4 + 372.0j), start=1.25)
    time = np.array([10.0, 11.0])
    remaining, columns = lines.remaining(10.0)
    assert remaining.exponents == (-0.8 + 142.0j,)
    assert remaining.basis(time) == pytest.approx(lines.basis(time)[columns], rel=1e-12)
    assert np.abs(np.delete(lines.basis(time), columns, axis=0)).max() < 1e-9


def test_high_passes_that_a_start_has_set_in_motion_are_fitted(source, monkeypatch):
    """Twelve revolutions from rest last half of a time constant: its decay leaks into 1/rev of the piezo channels."""
    speed = 0.3 * source.model.modes.frequency[0]
    plan = RotorPlan(
        run="wind",
        kind="wind",
        harmonics=dict.fromkeys(("Fx", "Fy", "Fz"), (20.0, 10.0)),
        sample_rate=1000.0,
        duration=12.2 / speed,
        rotor_speed=speed,
    )
    run = _with_noise(simulate_run(true_rig(LIGHT), plan, NO_NOISE, 2)[0])

    def misfit():
        solved = harmonic_loads.harmonic_loads(rotor_record.rotor_record(run, LIGHT, source, 2), LIGHT, source)
        return solved.redundancy_chi2[0] / solved.limit[0]

    assert misfit() < 1.0
    monkeypatch.setattr(free_decays, "HIGH_PASS_TIME_CONSTANTS", 0.0)
    assert misfit() > 3.0


def test_the_decay_of_a_high_pass_has_no_mean_and_does_not_fade():
    lines = OtherLines((7.0,), (-7.4 + 372.0j,), start=1.0, rates=(0.5, 2.0), duration=6.0)
    time = 1.0 + (np.arange(60_000) + 0.5) * 1e-4
    basis = lines.basis(time)
    assert basis.shape == (lines.columns, len(time))
    assert basis[-2:].mean(axis=1) == pytest.approx(0.0, abs=1e-8)
    assert basis[-2:, 10_000:] - basis[-2:, -1:] == pytest.approx(
        np.exp(-np.outer((0.5, 2.0), time[10_000:] - 1.0)) - np.exp(-np.outer((0.5, 2.0), time[-1:] - 1.0)), abs=1e-12
    )
    remaining, columns = lines.remaining(6.9)
    assert remaining.exponents == () and remaining.rates == lines.rates
    assert remaining.basis(time) == pytest.approx(basis[columns], rel=1e-12)
