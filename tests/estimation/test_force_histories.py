"""Nonlinear forces from measured motion, against integration of one mass in time with steps far below a sample."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.cell_forces import record_cell_forces
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import solve
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.waveforms import record_waveform
from tests.support.rigs import one_degree_of_freedom

MASS, STIFFNESS, GAIN = 10.0, 4e5, 0.002
DAMPING = 2 * 0.02 * np.sqrt(STIFFNESS * MASS)
RATE, PERIOD, PERIODS = 256.0, 2.0, 12
FINE = 200
RIG = one_degree_of_freedom(acquisition={"filter": {"type": "butterworth", "order": 6, "cutoff": 44.0}})


def cubic(x, slider):
    return 6e9 * x**3, slider


def contact(x, slider):
    slider = min(max(slider, x - 4.0 / 2e5), x + 4.0 / 2e5)
    return 2e5 * (x - slider), slider


def motion(force):
    """The last period of the motion [m] under a multisine of 5 to 38 Hz, and of the load [N], on the fine grid."""
    count = round(RATE * PERIOD) * FINE
    spectrum = np.zeros(count + 1, complex)  # two samples a step: the load at half steps
    lines = np.arange(10, 77)
    spectrum[lines] = 6.0 * np.exp(2j * np.pi * np.random.default_rng(2).random(len(lines))) * count
    load = np.fft.irfft(spectrum, 2 * count)
    h, x, v, slider = PERIOD / count, 0.0, 0.0, 0.0
    path = np.empty(count)
    for _ in range(PERIODS):
        for i in range(count):
            path[i] = x
            f, slider = force(x, slider)
            # Velocity Verlet, the damping at the half step.
            half = (v + 0.5 * h / MASS * (load[2 * i] - STIFFNESS * x - f)) / (1.0 + 0.5 * h * DAMPING / MASS)
            x = x + h * half
            f, _ = force(x, slider)
            push = load[(2 * i + 2) % (2 * count)] - STIFFNESS * x - f
            v = half * (1.0 - 0.5 * h * DAMPING / MASS) + 0.5 * h / MASS * push
    return path, load[::2]


@pytest.mark.parametrize(
    ("force", "effect", "error"),
    [
        (cubic, {"name": "cubic-stiffness", "parameters": {"k3": 6e9, "side": "beside"}}, 2.5e-4),
        (contact, {"name": "dry-friction", "parameters": {"force": 4.0, "stick_stiffness": 2e5}}, 3e-3),
    ],
    ids=["cubic", "contact"],
)
def test_motion_beyond_the_filter_and_between_the_samples_counts(force, effect, error):
    path, load = motion(force)
    n = round(RATE * PERIOD)
    frequency = np.arange(n // 2) / PERIOD
    filtered = anti_alias_response(RIG.acquisition, frequency)
    x, u = (np.fft.rfft(signal)[: n // 2] * 2 / len(signal) for signal in (path, load))
    # One record of one period: its amplitudes are those of the steady motion.
    volts = GAIN * STIFFNESS * x * filtered
    samples = np.fft.irfft(np.append(volts, 0.0) * n / 2, n)[:, None]
    system = balance_model(RIG.model_copy(update={"effects": (DeclaredEffect(where=("z",), **effect),)})).system()
    solution = solve(system, frequency)
    waveform = replace(record_waveform(samples, RATE, ["z.strain"], RIG), is_periodic=True)
    found = record_cell_forces(waveform, system, solution).volts(system)[:, 0]
    w = 2 * np.pi * frequency
    linear = GAIN * STIFFNESS * u / (STIFFNESS - MASS * w**2 + 1j * w * DAMPING) * filtered
    band = (frequency >= 5.0) & (frequency <= 38.0)
    true = (volts - linear)[band]
    assert np.linalg.norm(found[band] - true) < error * np.linalg.norm(true)
