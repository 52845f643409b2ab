"""Errors of the azimuth turn the known loads of a check run and the reduced ones alike: neither noise nor an error."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.additions import RunAdditions
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.reduction.check_contradiction import flag_by_check_runs
from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_speed_modulation import RIG, harmonics, source  # noqa: F401
from tests.support.wind_record import wind_record

RATE, SPEED = 500.0, RIG.rotor.speed
TACHOMETERS = {"jitter": (0.15, 0.0), "much jitter": (0.6, 0.0), "all late alike": (0.0, 0.15)}
"""Scatter of the pulses, and by how much all are late [deg]; an import states twice that."""


def reduced(source, tachometer, response_error=0.0, noise=1e-4, seed=1):  # noqa: F811
    """The check run of a rig whose response at 8/rev is larger than the model's by `response_error`."""
    known, felt = harmonics(), harmonics()
    felt[8] *= 1.0 + response_error
    run = wind_record(RIG, felt, rate=RATE, seconds=14.0, noise=noise, seed=seed).run
    pulses, order = run.pulse_times, np.arange(9)
    psi = 2 * np.pi * SPEED * (np.arange(run.samples) / RATE - pulses[0])
    H = anti_alias_response(RIG.acquisition, order * SPEED)
    loads = (np.exp(1j * psi[:, None] * order) @ (H[:, None] * known)).real
    rng, (scatter, late) = np.random.default_rng(100 + seed), TACHOMETERS[tachometer]
    loads += noise * loads.std(axis=0) * rng.standard_normal(loads.shape)
    pulses = pulses + (scatter * rng.standard_normal(len(pulses)) + late) / 360.0 / SPEED
    samples = MemorySource(run.read(0, run.samples).channels, loads)
    stated = RunAdditions(azimuth_error_deg=2.0 * late) if late else None
    check = replace(run, kind="check", source=samples, has_loads=True, pulse_times=pulses, additions=stated)
    return reduce_run(check, RIG, None, source)


def contradicted(loads):
    """The number of components that are flagged, by harmonic."""
    flagged, _ = flag_by_check_runs({loads.run: loads})
    return [sum(MODEL_CONTRADICTED in words for words in row) for row in flagged[loads.run].flags]


@pytest.mark.parametrize("tachometer", TACHOMETERS)
def test_a_response_that_is_wrong_at_the_highest_harmonic_is_contradicted(source, tachometer):  # noqa: F811
    """The turn had hidden an error of 10 % of the load at 8/rev."""
    assert contradicted(reduced(source, tachometer, 0.03, noise=3e-5)) == [0] * 8 + [6]
    assert contradicted(reduced(source, tachometer)) == [0] * 9


@pytest.mark.parametrize("tachometer", TACHOMETERS)
def test_the_noise_floor_is_the_error_of_an_exact_response(source, tachometer):  # noqa: F811
    """The floor was up to 190 times the error."""
    checks = [reduced(source, tachometer, seed=seed).check for seed in range(8)]
    errors, floors = (
        np.array([[*each.values()] for each in part])
        for part in ([check.load_error for check in checks], [check.load_noise for check in checks])
    )
    assert np.sqrt(np.mean(floors**2) / np.mean(errors**2)) == pytest.approx(1.0, abs=0.2)
    by_component = np.sqrt(np.mean(floors**2, axis=0) / np.mean(errors**2, axis=0))
    assert by_component == pytest.approx(np.ones(6), abs=0.3)


def test_the_loads_themselves_keep_the_turn_in_their_sigma(source):  # noqa: F811
    """Loads of a wrong azimuth are turned: the difference that both have in common is an error of either."""
    loads = reduced(source, "all late alike")
    error = (loads.amplitude - harmonics())[1:]
    sigma = np.stack([loads.sigma_cosine, loads.sigma_sine])[:, 1:]
    deviations = np.abs(np.stack([error.real, error.imag])) / sigma
    assert 0.3 < np.sqrt(np.mean(deviations**2)) < 1.0
