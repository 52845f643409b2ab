"""A calibration stand for tests: a known balance of 8 channels and 6 loads with few nonlinear terms."""

import numpy as np

from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.terms import linear_terms, term_from_name, term_values
from balance_cli.campaign.rig.components import COMPONENTS

CHANNELS = (*(f"g{i + 1}" for i in range(7)), "torque")
FULL_RANGE = np.array([800.0, 800.0, 3500.0, 400.0, 400.0, 450.0])
NONLINEAR_TERMS = {
    "g1": {"Fz^2": 0.015, "Fx |My|": -0.008},
    "g3": {"Mx My": 0.012},
    "g5": {"Fy|Fy|": -0.02, "|Fx Fz|": 0.006},
    "torque": {"Mz^3": 0.01},
}
NOISE = 4e-4


def stand_loads():
    """Loads (m, 6) over the calibrated range and their load series (m,): single ramps, then beside another load."""
    up = np.r_[np.arange(1, 6), np.arange(4, -1, -1)] / 5.0
    eye = np.eye(6)
    parts = [np.outer(np.r_[up, -up], eye[i]) for i in range(6)]
    for i in range(6):
        for j in range(6):
            for sign in (1.0, -1.0) if i != j else ():
                other = sign if i < j else -sign
                parts.append(np.outer(np.r_[0.0, up], sign * eye[i]) + 0.6 * other * eye[j])
    return np.vstack(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])


def true_model():
    """Terms and coefficients (p, 8) of the balance."""
    rng = np.random.default_rng(12)
    straight = rng.normal(size=(8, 6))
    straight[7] = 0.02 * straight[7] + np.eye(6)[5]
    names = sorted({name for terms in NONLINEAR_TERMS.values() for name in terms})
    terms = (*linear_terms(6), *(term_from_name(name, COMPONENTS) for name in names))
    b = np.zeros((len(terms), 8))
    b[:6] = straight.T
    for channel, curved in NONLINEAR_TERMS.items():
        for name, value in curved.items():
            b[6 + names.index(name), CHANNELS.index(channel)] = value
    return terms, b


def stand_points(seed=0, noise=NOISE):
    """A calibration of the balance, with a zero for each load series."""
    rng = np.random.default_rng(seed)
    x, sequence = stand_loads()
    terms, b = true_model()
    zeros = 0.01 * rng.normal(size=(sequence[-1] + 1, 8))
    read = term_values(terms, x) @ b + zeros[sequence] + noise * rng.normal(size=(len(x), 8))
    return CalibrationPoints(
        CHANNELS, COMPONENTS, ("stand",), read, x * FULL_RANGE, np.zeros(len(x), int), np.ones(len(x)), FULL_RANGE
    )
