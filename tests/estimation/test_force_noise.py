"""Noise of nonlinear forces that are computed from measured motion, against records of an integrated motion."""

import numpy as np

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.force_noise import add_force_noise
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.signals.anti_alias import anti_alias_response
from tests.estimation.test_force_histories import (
    FINE,
    GAIN,
    PERIOD,
    RATE,
    RIG,
    STIFFNESS,
    motion,
    multisine_amplitudes,
    strong_square,
)

REPEATS, SAMPLES = 8, round(RATE * PERIOD)
DAMPER = DeclaredEffect(name="quadratic-damping", where=("z",), parameters={"c2": 2e4})


def noisy_record(rng, noise):
    """A record of some periods of the motion with a strong damper, with white noise on the channel."""
    filtered = anti_alias_response(RIG.acquisition, np.arange(SAMPLES // 2) / PERIOD)
    volts = GAIN * STIFFNESS * filtered * np.fft.rfft(motion(strong_square))[: SAMPLES // 2] * 2 / (SAMPLES * FINE)
    load = filtered * multisine_amplitudes(SAMPLES // 2)
    period = [np.fft.irfft(np.append(part, 0.0) * SAMPLES / 2, SAMPLES) for part in (volts, load)]
    channel, applied = (np.tile(part, REPEATS) for part in period)
    loads = np.zeros((len(channel), 6))
    loads[:, 2] = applied + 1e-9 * rng.normal(size=len(applied))
    channel = channel + noise * channel.std() * rng.normal(size=len(channel))
    return Run("sweep", "ONE", "sweep", ("z.strain",), len(channel), MemorySource(channel[:, None], loads),
               sample_rate=RATE, excited=("Fz",), excitation="multisine", level=(30.0,), period=PERIOD)  # fmt: skip


def chi2_per_value(batches, system):
    return data_chi2(batches, system) / sum(np.sum(batch.lines.count) for batch in batches)


def test_chi2_of_the_true_rig_is_that_of_noise_where_a_force_contains_it():
    system = balance_model(RIG.model_copy(update={"effects": (DAMPER,)})).system(derivatives=False)
    rng, found = np.random.default_rng(3), []
    for _ in range(6):
        spectra = measured_spectra((noisy_record(rng, 1e-2),), RIG, means=True)
        batches = stack_runs(spectra.lines, (), RIG.channel_names)
        found.append([chi2_per_value(lines, system) for lines in (batches, add_force_noise(batches, system))])
    without, weighted = np.mean(found, axis=0)
    assert without > 5.0
    assert 0.9 < weighted < 1.08


def test_lines_of_a_linear_rig_stay_as_they_are():
    spectra = measured_spectra((noisy_record(np.random.default_rng(1), 3e-3),), RIG, means=True)
    batches = stack_runs(spectra.lines, (), RIG.channel_names)
    assert add_force_noise(batches, balance_model(RIG).system())[0] is batches[0]
