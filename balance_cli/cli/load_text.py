"""The loads of a run as text: mean and blade harmonic of each component, with sigma, and whether to trust them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.reduction.flags import NOT_MEASURED, SEPARATOR, trust_word

if TYPE_CHECKING:
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.reduction.result import RunLoads

NOT_KNOWN = "-"
FEWEST_DIGITS = 2
"""Significant digits of sigma, to which the value is rounded: a third would be noise of the noise."""


def blade_harmonic(geometry: Geometry, harmonics: int) -> int:
    """Return the harmonic of the blades, 1 where the geometry has no rotor or fewer harmonics were reduced."""
    blades = geometry.rotor.blades if geometry.rotor else 1
    return blades if blades <= harmonics else 1


def load_lines(loads: RunLoads, geometry: Geometry) -> Iterator[str]:
    """Yield a table of one run: a row a component with mean, blade harmonic, sigma of both and a word of trust."""
    from balance_cli.reduction.polar import polar_sigma

    n = blade_harmonic(geometry, len(loads.frequency_hz) - 1)
    yield f"   {'':8}{'mean':>11} {'sigma':>9}  {f'{n}/rev':>11} {'sigma':>9}  trust in mean, {n}/rev"
    sigma, _ = polar_sigma(loads.amplitude[n], loads.sigma_cosine[n], loads.sigma_sine[n])
    for m, component in enumerate(loads.components):
        measured = NOT_MEASURED not in loads.flags[0][m].split(SEPARATOR)
        mean, mean_sigma = number_pair(float(loads.amplitude[0, m].real), float(loads.sigma_cosine[0, m]))
        first = (mean, mean_sigma) if measured else (NOT_KNOWN, NOT_KNOWN)
        second = number_pair(abs(complex(loads.amplitude[n, m])), float(sigma[m]))
        words = f"{trust_word(loads.flags[0][m])}, {trust_word(loads.flags[n][m])}"
        label = f"{component} {UNIT_OF[component]}"
        yield f"   {label:8}{first[0]:>11} {first[1]:>9}  {second[0]:>11} {second[1]:>9}  {words}"


def trust_line(loads: RunLoads) -> str:
    """Return the worst word of trust of a run, with the number of rows of each flag."""
    flags = [word for row in loads.flags for word in row]
    counts = ", ".join(f"{word} ({count} of {len(flags)} rows)" for word, count in loads.flag_counts.items())
    worst = trust_word(SEPARATOR.join(flags))
    return f"   trust: {worst}{f'; {counts}' if counts else ''}"


def number_pair(value: float, sigma: float) -> tuple[str, str]:
    """Return value and sigma, both to the second significant digit of sigma."""
    if not math.isfinite(value):
        return NOT_KNOWN, NOT_KNOWN
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.6g}", NOT_KNOWN
    decimals = FEWEST_DIGITS - 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    if 0 <= decimals <= 6 and abs(value) < 1e7:
        return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"
    digits = max(math.floor(math.log10(max(abs(value), sigma))) + 1 + decimals, FEWEST_DIGITS)
    return f"{value:.{min(digits, 12) - 1}e}", f"{sigma:.{FEWEST_DIGITS - 1}e}"
