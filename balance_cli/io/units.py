"""Units in the tables and matrices of other laboratories: spellings, dimensions, and conversion to SI.

Factors are those of NIST SP 811 (2008), appendix B; exact ones are given to all digits. A unit that is a product of
force and length is understood in either order and with any separator (`N m`, `N.m`, `Nm`, `in-lbf`, `ft lbf`).
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]

FORCE, MOMENT, VOLTAGE, RATIO, CHARGE = "N", "N m", "V", "V/V", "C"
ACCELERATION, ANGLE, FREQUENCY, TIME, LENGTH = "m/s2", "rad", "Hz", "s", "m"
TEMPERATURE, MASS, NUMBER, PRESSURE = "degC", "kg", "1", "Pa"

MOST_SUGGESTED = 10
"""Units that a remedy lists: all of forces, the first of moments."""
POUND_FORCE = 4.4482216152605
STANDARD_GRAVITY = 9.80665
INCH, FOOT = 0.0254, 0.3048

_FORCES = {
    "N": 1.0,
    "mN": 1e-3,
    "daN": 10.0,
    "kN": 1e3,
    "MN": 1e6,
    "lbf": POUND_FORCE,
    "ozf": POUND_FORCE / 16,
    "kip": 1e3 * POUND_FORCE,
    "gf": 1e-3 * STANDARD_GRAVITY,
    "kgf": STANDARD_GRAVITY,
}
_LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": INCH, "ft": FOOT}
_OTHERS: dict[str, dict[str, float]] = {
    VOLTAGE: {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    RATIO: {"V/V": 1.0, "mV/V": 1e-3, "uV/V": 1e-6},
    CHARGE: {"C": 1.0, "nC": 1e-9, "pC": 1e-12},
    ACCELERATION: {"m/s2": 1.0, "mm/s2": 1e-3, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY},
    ANGLE: {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "rev": 2 * math.pi},
    FREQUENCY: {"Hz": 1.0, "kHz": 1e3, "rpm": 1 / 60, "rad/s": 0.5 / math.pi, "deg/s": 1 / 360},
    TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    PRESSURE: {
        "Pa": 1.0,
        "hPa": 100.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "mbar": 100.0,
        "bar": 1e5,
        "psi": POUND_FORCE / INCH**2,
    },
    MASS: {"kg": 1.0, "g": 1e-3, "lb": 0.45359237},
    NUMBER: {"1": 1.0, "%": 1e-2, "um/m": 1e-6},
}
_SPELLINGS: dict[str, tuple[str, ...]] = {
    "lbf": ("lb", "lbs", "lb f", "pound", "pounds"),
    "kgf": ("kp", "kg f"),
    "ozf": ("oz", "oz f"),
    "kip": ("klbf",),
    "N": ("newton", "newtons"),
    "in": ("inch", "inches", '"'),
    "ft": ("foot", "feet"),
    "um": ("micron",),
    "V": ("volt", "volts"),
    "m/s2": ("m s-2", "m/s/s"),
    "g": ("gn", "g_n", "g0"),
    "deg": ("degree", "degrees"),
    "rev": ("revs", "revolution", "revolutions"),
    "rpm": ("1/min", "min-1", "U/min", "rev/min"),
    "Hz": ("1/s", "s-1", "rev/s"),
    "s": ("sec", "second", "seconds", "sek", "sekunden"),
    "h": ("hr",),
    "1": ("-", "count", "counts", "cts", "bit", "bits", "digit", "digits", "LSB", "none", "steps"),
    "%": ("percent",),
    "um/m": ("ue", "ustrain", "microstrain", "uepsilon"),
}
_MASS_SPELLINGS = {"g": ("gram", "grams"), "kg": ("kgs", "kilogram", "kilograms")}
_WEIGHTS = {"g": "gf", "kg": "kgf", "lb": "lbf"}
"""Units of the weights of masses under standard gravity."""
_TEMPERATURES = {
    "degC": (("C", "celsius", "oC"), 1.0, 0.0),
    "degF": (("F", "fahrenheit"), 5 / 9, -160 / 9),
    "K": (("kelvin",), 1.0, -273.15),
}
_SIGNS = str.maketrans(
    {
        "µ": "u",
        "μ": "u",
        "ε": "e",
        "ϵ": "e",
        "·": " ",
        "⋅": " ",
        "×": " ",
        "*": " ",
        "²": "2",
        "°": "deg",
        "º": "deg",
        "˚": "deg",
        "^": None,
    }
)


@dataclass(frozen=True)
class Unit:
    """A unit of measurement: its value in the base unit is `factor * value + offset`.

    `dimension` is the base unit: that of SI, but `degC` for temperatures and `Hz` for speeds of rotation, as in run
    files.
    """

    symbol: str
    dimension: str
    factor: float
    offset: float = 0.0

    def to_base(self, values: ArrayLike) -> Array:
        """Convert values from this unit to the base unit."""
        return np.asarray(np.asarray(values, float) * self.factor + self.offset)


@lru_cache(maxsize=256)  # a batch reads the same units in every file
def parse_unit(text: str, *dimensions: str) -> Unit:
    """Find the unit that a text names, among those of some dimensions (base units; all where none is given).

    Upper and lower case count where they make a difference (`mN`, `MN`). Raises UserError, without file and place, for
    an unknown unit, one of another dimension, one with two meanings, or mega where only milli is known (`MV`).
    """
    spelling = _normalize(text)
    units = _units_by_spelling().get(spelling) or _ignore_case(spelling)
    fitting = [unit for unit in units if not dimensions or unit.dimension in dimensions]
    if len(fitting) == 1:
        _require_prefix(spelling, fitting[0])
        return fitting[0]
    if fitting:
        meanings = " or ".join(f"a unit of {unit.dimension}" for unit in fitting)
        clear = " or ".join(unit.dimension for unit in fitting)
        raise UserError(f"the unit `{text.strip()}` can be {meanings}", remedy=f"Convert the values to {clear}")
    if units:
        mass = next((unit for unit in units if unit.dimension == MASS and FORCE in dimensions), None)
        found, needed = (mass or units[0]).dimension, " or ".join(dimensions)
        remedy = _remedy_for_mass(mass) if mass else f"Write {_suggest(spelling, dimensions)}"
        raise UserError(f"`{text.strip()}` is a unit of {found}, where one of {needed} is needed", remedy=remedy)
    raise UserError(f"unknown unit `{text.strip()}`", remedy=f"Write {_suggest(spelling, dimensions)}")


def is_unit(text: str) -> bool:
    """Whether a text names a unit, of one dimension or several."""
    spelling = _normalize(text)
    return bool(spelling) and bool(_units_by_spelling().get(spelling) or _ignore_case(spelling))


def can_be_unit_of(text: str, dimension: str) -> bool:
    """Whether a text names a unit of a dimension (its base unit), whatever else it may name."""
    spelling = _normalize(text)
    units = _units_by_spelling().get(spelling) or _ignore_case(spelling) if spelling else ()
    return any(unit.dimension == dimension for unit in units)


def short_reading(value: float, base_unit: str) -> str:
    """A reading with three digits, in the unit of its quantity in which it is short: V, mV or uV, mV/V or uV/V."""
    usual = {VOLTAGE: (("V", 1.0), ("mV", 1e-3), ("uV", 1e-6)), RATIO: (("mV/V", 1e-3), ("uV/V", 1e-6))}
    scales = usual.get(base_unit)
    if scales is None:
        return f"{value:.3g}"
    symbol, factor = next(((s, f) for s, f in scales if abs(value) >= f), scales[-1])
    return f"{value / factor:.3g} {symbol}"


def unit_symbols(*dimensions: str) -> tuple[str, ...]:
    """Symbols of all units of some dimensions, in the order of the table."""
    units = dict.fromkeys(unit for _, unit in _all_units() if unit.dimension in dimensions)
    return tuple(unit.symbol for unit in units)


@lru_cache(maxsize=1024)
def _normalize(text: str) -> str:
    """Reduce separators to single spaces and special signs to letters."""
    plain = text.strip().translate(_SIGNS)
    plain = re.sub(r"(?i)degr?(?:ees?)?[._\s]*(?=[CFK]$)", "deg", plain)
    if len(plain) > 1:
        plain = re.sub(r"(?<=[A-Za-z])[.\-_](?=[A-Za-z])", " ", plain)
    return re.sub(r"\s+", " ", re.sub(r"\s*/\s*", "/", plain)).strip()


def _all_units() -> Iterator[tuple[str, Unit]]:
    """Every spelling with its unit; the first spelling of each unit is its symbol."""
    for symbol, factor in _FORCES.items():
        yield from _spell(Unit(symbol, FORCE, factor))
    for symbol, factor in _LENGTHS.items():
        yield from _spell(Unit(symbol, LENGTH, factor))
    yield from _moments()
    for dimension, factors in _OTHERS.items():
        for symbol, factor in factors.items():
            yield from _spell(Unit(symbol, dimension, factor))
    for symbol, (spellings, factor, offset) in _TEMPERATURES.items():
        for spelling in (symbol, *spellings):
            yield spelling, Unit(symbol, TEMPERATURE, factor, offset)


def _spell(unit: Unit) -> Iterator[tuple[str, Unit]]:
    """The symbol and its other spellings; those of `g` are of the acceleration, not of the mass."""
    others = (_MASS_SPELLINGS if unit.dimension == MASS else _SPELLINGS).get(unit.symbol, ())
    yield from ((spelling, unit) for spelling in (unit.symbol, *others))


def _moments() -> Iterator[tuple[str, Unit]]:
    """Products of force and length in either order; joined without a space only where no other unit reads so."""
    taken = set(_FORCES) | {symbol for factors in _OTHERS.values() for symbol in factors}
    for force, force_factor in _FORCES.items():
        for length, length_factor in _LENGTHS.items():
            unit = Unit(f"{force} {length}", MOMENT, force_factor * length_factor)
            for first in (force, *_SPELLINGS.get(force, ())):
                for second in (length, *_SPELLINGS.get(length, ())):
                    yield f"{first} {second}", unit
                    yield f"{second} {first}", unit
                    yield from ((joined, unit) for joined in (first + second,) if joined not in taken)
            if length in ("in", "ft"):
                yield length + force, unit


@cache
def _units_by_spelling() -> dict[str, tuple[Unit, ...]]:
    table: dict[str, dict[Unit, None]] = {}
    for spelling, unit in _all_units():
        table.setdefault(spelling, {})[unit] = None
    return {spelling: tuple(units) for spelling, units in table.items()}


def _ignore_case(spelling: str) -> tuple[Unit, ...]:
    """Units whose spelling differs in upper and lower case only; none where two sizes of one dimension do."""
    matches = [
        unit for known, units in _units_by_spelling().items() if known.lower() == spelling.lower() for unit in units
    ]
    distinct = tuple(dict.fromkeys(matches))
    return distinct if len({unit.dimension for unit in distinct}) == len(distinct) else ()


def _require_prefix(spelling: str, unit: Unit) -> None:
    """Raise UserError where a spelling is that of a unit but for mega in place of milli, or the reverse.

    Ratios are none of it: `MV/V` is a head in capitals, as no bridge gives megavolts for a volt.
    """
    other = spelling[:1].swapcase() + spelling[1:]
    table = _units_by_spelling()
    if (
        spelling in table
        or spelling[:1] not in ("m", "M")
        or unit.dimension == RATIO
        or unit not in table.get(other, ())
    ):
        return
    if any(base.dimension == unit.dimension for base in table.get(spelling[1:], ())):
        prefixes = ("mega", "milli") if spelling.startswith("M") else ("milli", "mega")
        fault = f"the unit `{spelling}` has the prefix {prefixes[0]}, and `{other}` is {prefixes[1]}"
        raise UserError(fault, remedy=f"Write {other} if that is meant, or convert the values to {unit.dimension}")


def _remedy_for_mass(mass: Unit) -> str:
    """A load stated as a mass needs the word of the user that standard gravity is meant."""
    return f"A mass is no load: write {_WEIGHTS[mass.symbol]} for its weight under standard gravity"


def _suggest(spelling: str, dimensions: tuple[str, ...]) -> str:
    """The nearest spelling, then the usual units of the dimensions."""
    fitting = {
        known: unit
        for known, units in _units_by_spelling().items()
        for unit in units
        if not dimensions or unit.dimension in dimensions
    }
    near = difflib.get_close_matches(spelling, fitting, n=1, cutoff=0.6)
    usual = ", ".join(unit_symbols(*dimensions)[:MOST_SUGGESTED]) if dimensions else "one of the units in docs/files.md"
    return f"{fitting[near[0]].symbol} (did you mean that?), or {usual}" if near else usual
