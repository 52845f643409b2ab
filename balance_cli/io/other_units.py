"""Units that no load and no reading has, in the heads of tables that have other columns, too."""

from __future__ import annotations

import re

from balance_cli.io.units import is_unit

OTHER_UNITS = (
    *("A", "mA", "W", "mW", "kW", "VA", "J", "kJ", "Wh", "Ah", "mAh", "Ohm", "kOhm", "T", "mT", "dB", "l", "ml"),
    *("kph", "kmh", "mph", "kt", "kts", "knots", "mmHg", "inHg", "inH2O", "mmH2O", "torr", "atm", "raw", "adc"),
)
"""Units beside those of loads and readings: test stands record currents, powers and speeds of the air, too."""
_CLOCK = re.compile(r"^h{1,2}:m{1,2}(:s{1,2}([.:]\w+)?)?$", re.IGNORECASE)
"""How times of day are written, in place of a unit: `hh:mm:ss`."""
_POWER = re.compile(r"\^?-?\d$")


def is_other_unit(cell: str) -> bool:
    """Whether a cell is a unit outside the table of units, or a quotient of units: `A`, `kg/m^3`, `hh:mm:ss`."""
    parts = [_POWER.sub("", part.strip(" ()")) for part in re.split(r"[/*·]", cell)]
    return bool(_CLOCK.match(cell)) or all(
        part and (part in OTHER_UNITS or part == "1" or is_unit(part)) for part in parts
    )
