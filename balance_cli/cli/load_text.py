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
MOST_TONES = 3
"""Tones of a table of text: more do not fit a line."""
FEWEST_DIGITS = 2
"""Significant digits of sigma, to which the value is rounded: a third would be noise of the noise."""


def blade_harmonic(geometry: Geometry, harmonics: int) -> int:
    """Return the harmonic of the blades, 1 where the geometry has no rotor or fewer harmonics were reduced."""
    blades = geometry.rotor.blades if geometry.rotor else 1
    return blades if blades <= harmonics else 1


def load_lines(loads: RunLoads, geometry: Geometry, tones: bool = False) -> Iterator[str]:
    """Yield a table of one run, a row a component: mean and blade harmonic, sigma of both, a word of trust of each.

    Of `tones` in place of harmonics the first MOST_TONES are shown.
    """
    from balance_cli.reduction.polar import polar_sigma

    last = len(loads.frequency_hz) - 1
    shown = tuple(range(1, min(last, MOST_TONES) + 1)) if tones else (blade_harmonic(geometry, last),)
    names = ["mean", *(f"{loads.frequency_hz[n]:.5g} Hz" if tones else f"{n}/rev" for n in shown)]
    yield "   " + " " * 8 + "".join(f"{name:>12} {'sigma':>9}" for name in names) + f"  trust in {', '.join(names)}"
    sigma, _ = polar_sigma(loads.amplitude, loads.sigma_cosine, loads.sigma_sine)
    for m, component in enumerate(loads.components):
        measured = NOT_MEASURED not in loads.flags[0][m].split(SEPARATOR)
        mean = number_pair(float(loads.amplitude[0, m].real), float(loads.sigma_cosine[0, m]))
        pairs = [mean if measured else (NOT_KNOWN, NOT_KNOWN)]
        pairs += [number_pair(abs(complex(loads.amplitude[n, m])), float(sigma[n, m])) for n in shown]
        words = ", ".join(trust_word(loads.flags[n][m]) for n in (0, *shown))
        label = f"{component} {UNIT_OF.get(component, '')}"
        yield f"   {label:8}" + "".join(f"{value:>12} {spread:>9}" for value, spread in pairs) + f"  {words}"


def trust_line(loads: RunLoads) -> str:
    """Return the worst word of trust of a run, with the number of rows of each flag."""
    flags = [word for row in loads.flags for word in row]
    counts = ", ".join(f"{word} ({count} of {len(flags)} rows)" for word, count in loads.flag_counts.items())
    worst = trust_word(SEPARATOR.join(flags))
    if list(loads.flag_counts) == [worst]:
        return f"   trust: {counts}"
    return f"   trust: {worst}{f': {counts}' if counts else ''}"


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
