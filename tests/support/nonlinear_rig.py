"""A balance whose channels curve with the loads: its readings, its calibration, and records under constant loads."""

from functools import cache

import numpy as np

from balance_cli.calibration.terms import Term, term_from_name, term_values
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.signals.rotor.harmonics import Harmonics
from balance_cli.steps.calibrate import calibrate
from tests.support.static_runs import AMPLITUDE, C0, RIG, loading

NAMES = tuple(channel.name for channel in RIG.channels if channel.measures_dc)
# Nonlinear part of a channel [V at the calibrated range]: about half a per cent.
NONLINEAR_PARTS = {
    ("Fz^2", "z1.strain"): 0.008,
    ("Fz^2", "z2.strain"): 0.008,
    ("Fz|Fz|", "z3.strain"): -0.006,
    ("|Mx|", "z4.strain"): 0.003,
    ("Fx^3", "x.strain"): 0.007,
    ("Fx Fz", "x.strain"): 0.006,
}
NOISE = 1e-4
ZERO = 0.05


def readings(loads):
    """Readings (m, 8) beyond the zero of loads (m, 6)."""
    loads = np.atleast_2d(loads)
    volts = loads @ C0.T
    for (term, channel), size in NONLINEAR_PARTS.items():
        volts[:, NAMES.index(channel)] += size * values(term_from_name(term, COMPONENTS), loads)
    return volts


def values(term: Term, loads):
    """The term of loads (m, 6) over the largest that are applied."""
    return term_values([term], loads / AMPLITUDE)[:, 0]


COMBINED_POSES = 40


def static_runs(rng, curved=True, combined=True):
    """Each load by itself about zero and about a steady lift either way; `combined`: and poses with all of them."""
    trims = {"bare": 0.0, "lift": 1500.0, "push": -1500.0}
    each = []
    for name, lift in trims.items():
        loads = loading((0, 0, lift, 0, 0, 0), scale=1.0 if not lift else 0.5)
        if combined and not lift:
            loads = np.vstack([loads, 0.8 * AMPLITUDE * rng.uniform(-1, 1, (COMBINED_POSES, 6))])
        volts = readings(loads) if curved else loads @ C0.T
        channels = ZERO + volts + NOISE * rng.normal(size=(len(loads), len(NAMES)))
        each.append(
            Run(f"static-{name}", RIG.rig, "static", NAMES, len(loads), MemorySource(channels, loads), trim=name)
        )
    return tuple(each)


@cache
def calibration(curved=True, combined=True):
    return calibrate(static_runs(np.random.default_rng(1), curved, combined), RIG)


def record(name, loads, shift=0.0, noise=NOISE, seed=0, curved=True, kind="wind", rate=200.0):
    """Ten seconds under constant loads, with a pulse each revolution."""
    speed, seconds = 10.0, 10.0
    samples = int(rate * seconds)
    volts = readings(loads) if curved else np.atleast_2d(loads) @ C0.T
    channels = ZERO + shift + volts + noise * np.random.default_rng(seed).normal(size=(samples, len(NAMES)))
    pulses = np.arange(0.02, seconds - 0.02, 1 / speed) if kind == "wind" else None
    return Run(
        name,
        RIG.rig,
        kind,
        NAMES,
        samples,
        MemorySource(channels, None),
        has_loads=False,
        sample_rate=rate,
        rotor_speed=speed if kind == "wind" else 0.0,
        pulse_times=pulses,
    )


def spectra(volts, noise=0.0):
    """The mean of a record, as channels give it."""
    c = len(NAMES)
    covariance = np.broadcast_to(noise**2 * np.eye(c), (1, c, c)).astype(complex)
    mean = np.asarray(volts, complex).reshape(1, c)
    return Harmonics("w", NAMES, np.zeros(1), mean, covariance, np.ones(1), (0.0, 1.0), (0, 1), (0, 1))


def other_flags(flags):
    """The flags without `untested` where one sensor tells a mean: the torque meter Mz, cell x Fx, and with it My."""
    on_one_sensor = [name in ("Fx", "My", "Mz") for name in COMPONENTS]
    return tuple(
        "; ".join(word for word in flag.split("; ") if word != "untested" or not alone)
        for flag, alone in zip(flags, on_one_sensor, strict=True)
    )


def other_flags_of_rows(flags):
    """The flags of rows of a table without those of loads that rest on one sensor, as `other_flags` of means."""
    on_one_sensor = ("untested Fx Mz", "untested Fx My Mz")
    return ["; ".join(word for word in flag.split("; ") if word not in on_one_sensor) for flag in flags]
