"""Factors between units that are mistaken for each other in a test hall, and what a factor suggests."""

from __future__ import annotations

import numpy as np

from balance_cli.io.units import FOOT, INCH, POUND_FORCE, STANDARD_GRAVITY

FORCE_UNITS = {
    "kN": 1e3,
    "MN": 1e6,
    "mN (or in N under a head of kN)": 1e-3,
    "lbf": POUND_FORCE,
    "kgf": STANDARD_GRAVITY,
    "daN": 10.0,
}
MOMENT_UNITS = {
    "kN m": 1e3,
    "N mm": 1e-3,
    "N cm": 1e-2,
    "in lbf": POUND_FORCE * INCH,
    "ft lbf": POUND_FORCE * FOOT,
    "kgf m": STANDARD_GRAVITY,
}
VOLT_UNITS = {"mV": 1e-3, "uV": 1e-6, "kV": 1e3}

UNIT_TOLERANCE = 0.06
"""Departure of a factor from that between two units: tolerances of stiffness change a response by about as much. Units
that differ by less than twice this (kgf and daN) are all named."""


def suggest_units(factor: float, units: dict[str, float]) -> str:
    """Return which units would explain that a value is `factor` times too large in SI; empty where none does.

    A value that is written in a unit of v SI units is v times too small, and one that was converted twice v times too
    large.
    """
    size = abs(factor)
    written = [name for name, value in units.items() if abs(np.log(size * value)) < UNIT_TOLERANCE]
    twice = [name for name, value in units.items() if abs(np.log(size / value)) < UNIT_TOLERANCE]
    if written:
        return f"are they in {' or '.join(written)}?"
    return f"were they converted from {' or '.join(twice)} twice, or not at all?" if twice else ""
