"""Gusts beside light modes: the noise of a harmonic is that of the loads as the response transmits them there."""

import numpy as np
import pytest

from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.harmonic_loads import harmonic_loads
from balance_cli.reduction.load_fluctuation import NODES, add_load_fluctuation
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.simulation import Noise, RotorPlan, simulate_run, true_rig
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.other_rigs import other_rig

LIGHT = other_rig("A").model_copy(update={"damping_ratio": 0.006})
SIZE = {"Fx": 20.0, "Fy": 20.0, "Fz": 40.0, "Mx": 4.0, "My": 4.0, "Mz": 4.0}
HARMONIC = 2


@pytest.fixture(scope="module")
def source():
    return ModelSource(identify(Spectra((), (), {}, {}), LIGHT, IdentifyOptions(method="computed")))


def _record(source, revolutions, seed, turbulence):
    """A rotor whose 2/rev is half a bandwidth beside the second mode, from rest, with gusts up to 200 Hz."""
    speed = source.model.modes.frequency[1] * (1.0 + 0.5 * 2 * LIGHT.damping_ratio) / HARMONIC
    plan = RotorPlan(
        run="wind",
        kind="wind",
        harmonics={name: (value, value / 2, value / 3) for name, value in SIZE.items()},
        turbulence={name: turbulence * value for name, value in SIZE.items()} if turbulence else {},
        turbulence_band=(0.5, 200.0),
        sample_rate=1000.0,
        duration=(revolutions + 0.5) / speed,
        rotor_speed=speed,
    )
    run, truth = simulate_run(true_rig(LIGHT), plan, Noise(), seed)
    return rotor_record(run, LIGHT, source, 3), truth


def _solved(record, source):
    return harmonic_loads(record, LIGHT, source)


def _sigma(solved):
    """Standard deviations (h, 2, m) of cosines and sines by noise alone."""
    return np.sqrt(np.diagonal(solved.noise_covariance, axis1=1, axis2=2)).reshape(len(solved.loads), 2, -1)


def _errors(record, truth, source):
    """Errors (2, m) of the cosines and sines of the harmonic beside the mode over their standard deviations."""
    solved = _solved(record, source)
    cosine, sine = truth.harmonics(*record.spectra.interval)
    error = solved.loads[HARMONIC - 1] - (cosine - 1j * sine)[HARMONIC]
    return np.stack([error.real, error.imag]) / _sigma(solved)[HARMONIC - 1]


@pytest.mark.parametrize(("revolutions", "limit"), [(40, 4.0), (12, 4.5)])
def test_sigma_contains_gusts_where_a_harmonic_is_on_a_mode(source, revolutions, limit):
    before, after = [], []
    for seed in range(12):
        record, _ = _record(source, revolutions, seed, 0.1)
        _, truth = _record(source, revolutions, seed, 0.0)  # the same harmonics without gusts
        before.append(_errors(record, truth, source))
        after.append(_errors(add_load_fluctuation(record, LIGHT, source), truth, source))
    before, after = np.array(before), np.array(after)
    assert np.abs(before).max() > limit
    assert np.abs(after).max() < limit
    assert 0.4 < np.sqrt(np.mean(after**2)) < 1.2


def test_start_transients_are_no_gusts(source):
    """The lines beside a harmonic contain the free decay of the mode, whose peak is at the harmonic."""
    record, _ = _record(source, 12, 1, 0.0)
    with_gusts = add_load_fluctuation(record, LIGHT, source)
    ratio = _sigma(_solved(with_gusts, source)) / _sigma(_solved(record, source))
    assert np.all(ratio < 2.0)


def test_the_response_is_computed_between_bins_beside_modes_alone(source, monkeypatch):
    record, _ = _record(source, 40, 0, 0.1)
    asked, respond = [], ModelSource.at
    monkeypatch.setattr(ModelSource, "at", lambda self, f, spin: asked.append(len(f)) or respond(self, f, spin))
    changed = add_load_fluctuation(record, LIGHT, source).spectra.covariance != record.spectra.covariance
    beside = np.flatnonzero(changed.any(axis=(1, 2)))
    assert beside.tolist() == [HARMONIC, 3]
    in_bins, at_nodes = asked
    assert at_nodes == pytest.approx(NODES * in_bins * len(beside) / 3, rel=0.05)
