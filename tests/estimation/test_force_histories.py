"""Nonlinear forces from measured motion, against integration of one mass in time with steps far below a sample."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.cell_forces import record_cell_forces
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import solve
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.waveforms import record_waveform
from tests.support.rigs import one_degree_of_freedom, two_degrees_of_freedom

MASS, STIFFNESS, GAIN = 10.0, 4e5, 0.002
DAMPING = 2 * 0.02 * np.sqrt(STIFFNESS * MASS)
RATE, PERIOD, PERIODS = 256.0, 2.0, 6  # the start from rest has decayed by exp(-40) where the last period begins
FINE = 200
RIG = one_degree_of_freedom(acquisition={"filter": {"type": "butterworth", "order": 6, "cutoff": 44.0}})


def nothing(x, v, slider):
    return 0.0, slider


def cubic(x, v, slider):
    return 6e9 * x**3, slider


def square(x, v, slider):
    return 2e3 * abs(v) * v, slider


def strong_square(x, v, slider):
    return 2e4 * abs(v) * v, slider


def uneven(x, v, slider):
    return 0.5 * 100.0 * abs(v), slider


def slip(x, slider, up=4.0 / 2e5, down=4.0 / 2e5):
    return min(max(slider, x - up), x + down)


def contact(x, v, slider):
    slider = slip(x, slider)
    return 2e5 * (x - slider), slider


def lubricated(x, v, slider):
    slider = slip(x, slider)
    return (0.4 + 0.6 * math.exp(-((v / 0.01) ** 2))) * 2e5 * (x - slider), slider


def uneven_contact(x, v, slider):
    slider = slip(x, slider, 5.2 / 2e5, 2.8 / 2e5)
    return 2e5 * (x - slider), slider


def multisine_amplitudes(count):
    """Amplitudes (count,) [N] of the load at multiples of 1/T: 6 N each from 5 to 38 Hz."""
    spectrum, lines = np.zeros(count, complex), np.arange(10, 77)
    spectrum[lines] = 6.0 * np.exp(2j * np.pi * np.random.default_rng(2).random(len(lines)))
    return spectrum


@cache
def motion(force):
    """The last period of the motion [m] under a multisine of 5 to 38 Hz, on the fine grid."""
    count = round(RATE * PERIOD) * FINE
    # Two samples a step: the load at half steps.
    load = np.fft.irfft(multisine_amplitudes(count + 1) * count, 2 * count)
    h, x, v, slider = PERIOD / count, 0.0, 0.0, 0.0
    path = np.empty(count)
    for _ in range(PERIODS):
        for i in range(count):
            path[i] = x
            f, slider = force(x, v, slider)
            # Velocity Verlet, the damping at the half step.
            half = (v + 0.5 * h / MASS * (load[2 * i] - STIFFNESS * x - f)) / (1.0 + 0.5 * h * DAMPING / MASS)
            x = x + h * half
            f, _ = force(x, 2.0 * half - v, slider)
            push = load[(2 * i + 2) % (2 * count)] - STIFFNESS * x - f
            v = half * (1.0 - 0.5 * h * DAMPING / MASS) + 0.5 * h / MASS * push
    return path


@pytest.mark.parametrize(
    ("force", "effect", "error"),
    [
        (cubic, {"name": "cubic-stiffness", "parameters": {"k3": 6e9, "side": "beside"}}, 2.5e-4),
        (contact, {"name": "dry-friction", "parameters": {"force": 4.0, "stick_stiffness": 2e5}}, 1.2e-3),
        (
            uneven_contact,
            {"name": "asymmetric-friction", "parameters": {"force": 4.0, "asymmetry": 0.3, "stick_stiffness": 2e5}},
            3e-3,
        ),
        (
            lubricated,
            {
                "name": "stribeck-friction",
                "parameters": {"force": 1.6, "static_force": 4.0, "speed": 0.01, "stick_stiffness": 2e5},
            },
            3e-3,
        ),
        (square, {"name": "quadratic-damping", "parameters": {"c2": 2e3}}, 1e-4),
        # The third harmonic of a strong damper is beyond the filter, its fifth beyond half the rate.
        (strong_square, {"name": "quadratic-damping", "parameters": {"c2": 2e4}}, 5e-4),
        # Most of a force of |v| is at sums and differences of the frequencies: 0.5 % of the motion in the band are its.
        (uneven, {"name": "asymmetric-damping", "parameters": {"difference": 100.0}}, 2e-3),
    ],
    ids=["cubic", "contact", "uneven contact", "lubricated", "square", "strong square", "uneven"],
)
def test_motion_beyond_the_filter_and_between_the_samples_counts(force, effect, error):
    n = round(RATE * PERIOD)
    frequency = np.arange(n // 2) / PERIOD
    filtered = anti_alias_response(RIG.acquisition, frequency)
    # One record of one period: its amplitudes are those of the steady motion.
    volts, linear = (
        GAIN * STIFFNESS * filtered * np.fft.rfft(motion(law))[: n // 2] * 2 / (n * FINE) for law in (force, nothing)
    )
    samples = np.fft.irfft(np.append(volts, 0.0) * n / 2, n)[:, None]
    system = balance_model(RIG.model_copy(update={"effects": (DeclaredEffect(where=("z",), **effect),)})).system()
    solution = solve(system, frequency)
    waveform = replace(record_waveform(samples, RATE, ["z.strain"], RIG), is_periodic=True)
    found = record_cell_forces(waveform, system, solution).volts(system)[:, 0]
    band = (frequency >= 5.0) & (frequency <= 38.0)
    true = (volts - linear)[band]
    assert np.linalg.norm(found[band] - true) < error * np.linalg.norm(true)


def test_the_step_between_the_ends_of_a_record_does_not_ring_in_the_rate():
    time = np.arange(1024) / RATE
    x = 0.05 * time + 1e-3 * np.sin(2 * np.pi * 3.3 * time)
    geometry = one_degree_of_freedom()
    waveform = record_waveform(GAIN * STIFFNESS * x[:, None], RATE, ["z.strain"], geometry)
    rate = waveform.differentiate(waveform.to_time_domain(waveform.volts[:, 0]) / (GAIN * STIFFNESS))
    fine = np.arange(len(rate)) * time[-1] * 1024 / 1023 / len(rate)
    error = rate - 0.05 - 1e-3 * 2 * np.pi * 3.3 * np.cos(2 * np.pi * 3.3 * fine)
    inner = slice(len(rate) // 50, -len(rate) // 50)
    assert np.abs(error[inner]).max() < 0.01 * np.ptp(rate[inner])


def test_each_function_of_time_is_contiguous():
    """Interleaved with others, forces and their derivatives took several times as long."""
    time = np.arange(256) / RATE
    volts = np.sin(2 * np.pi * np.outer(time, [3.0, 7.0]))
    waveform = record_waveform(volts, RATE, ["a.strain", "b.strain"], two_degrees_of_freedom())
    history = waveform.to_time_domain(waveform.volts)
    for functions in (history, waveform.differentiate(history)):
        assert functions.shape == (len(history), 2) and functions.T.flags.c_contiguous
