"""Frequency responses as universal file: datasets 151 (header), 164 (units) and 58 (functions), in text.

The layout is that of the universal file format of SDRC, as the University of Cincinnati documents it. Numbers are in
double precision; abscissas have six digits, as the format has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.io.errors import UserError
from balance_cli.io.version import __version__
from balance_cli.signals.response.transfer import Transfer
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]

DELIMITER = "    -1"
FREQUENCY_RESPONSE, COMPLEX_DOUBLE = 4, 6
"""Codes of dataset 58: the type of the function, and that of its ordinate."""
UNKNOWN, EXCITATION_FORCE, FREQUENCY = 0, 13, 18
"""Codes of dataset 58: specific data types of an axis. Volts have none of their own."""
HUB_NODE = 1
"""Node of the excitation; the channels are the nodes after it, in their order."""
EVEN_TOLERANCE = 1e-9
"""Relative deviation of the steps of a frequency axis from their mean, below which it is evenly spaced."""
SI_UNITS = "SI - mKs (Newton)"


def uff_text(transfer: Transfer, created: str) -> str:
    """Return frequency responses as text of a universal file; `created` is the time of the result in ISO 8601.

    One function for each run, component and channel: the response [V/N, V/(N m)] at the node of the channel (direction
    0, a scalar) to the hub (node 1; directions 1 to 6: x, y, z and the rotations about them).
    Raises UserError where `created` is no date.
    """
    try:
        when = datetime.fromisoformat(created)
    except ValueError as error:
        raise UserError(f"`{created}` is no date", place="created", remedy="Create the result again") from error
    lines = [*header(transfer.geometry.rig, f"frequency responses, geometry {transfer.geometry.name}", when), *units()]
    for response in transfer.responses:
        for j in range(len(response.components)):
            for i in range(len(response.channel_names)):
                lines += _function(transfer, response, i, j, when)
    return "\n".join(lines) + "\n"


def printable_text(value: str) -> str:
    """Return a line of at most 80 printable ASCII characters, NONE for an empty one."""
    shown = "".join(c if c.isprintable() and c.isascii() else "?" for c in value)[:80]
    return shown.strip() or "NONE"


def date_and_time(when: datetime) -> tuple[str, str]:
    """Return date and time as the format has them."""
    months = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
    return f"{when.day:02d}-{months[when.month - 1]}-{when.year % 100:02d}", f"{when:%H:%M:%S}"


def header(name: str, description: str, when: datetime) -> list[str]:
    """Return the lines of dataset 151 for a model of this name."""
    date, time = date_and_time(when)
    program = f"balance-cli {__version__}"
    return [
        DELIMITER,
        "   151",
        printable_text(name),
        printable_text(description),
        printable_text(program),
        f"{date:<10}{time:<10}{0:10d}{0:10d}{0:10d}",
        f"{date:<10}{time:<10}",
        printable_text(program),
        f"{date:<10}{time:<10}",
        DELIMITER,
    ]


def units() -> list[str]:
    """Return the lines of dataset 164: SI units."""
    unit_factor = f"{1.0:25.17E}".replace("E", "D")
    kelvin = f"{273.15:25.17E}".replace("E", "D")
    return [DELIMITER, "   164", f"{1:10d}{SI_UNITS:<20}{2:10d}", unit_factor * 3, kelvin, DELIMITER]


def _function(transfer: Transfer, response: FrequencyResponse, i: int, j: int, when: datetime) -> list[str]:
    """Return the lines of one dataset 58: channel i over component j."""
    channel, component = response.channel_names[i], response.components[j]
    number, node, direction = i + 1, HUB_NODE + 1 + i, COMPONENTS.index(component) + 1
    date, time = date_and_time(when)
    length = 0 if UNIT_OF[component] == "N" else 1
    channel_name, load_name = printable_text(channel), component
    value = response.response[:, i, j]
    return [
        DELIMITER,
        "    58",
        printable_text(f"{channel} over {component}"),
        printable_text(f"run {response.run}, estimator {response.estimator}"),
        f"{date} {time}",
        printable_text(f"rig {transfer.geometry.rig}, geometry {transfer.geometry.name}"),
        "NONE",
        f"{FREQUENCY_RESPONSE:5d}{number:10d}{0:5d}{0:10d} {channel_name[:10]:<10}{node:10d}{0:4d}"
        f" {'hub':<10}{HUB_NODE:10d}{direction:4d}",
        _abscissa_record(response.frequency),
        axis_record(FREQUENCY, 0, 0, "Frequency", "Hz"),
        axis_record(UNKNOWN, 0, 0, channel_name, "V"),
        axis_record(EXCITATION_FORCE, length, 1, load_name, UNIT_OF[component]),
        axis_record(UNKNOWN, 0, 0, "NONE", "NONE"),
        *_values(response.frequency, value),
        DELIMITER,
    ]


def axis_record(kind: int, length: int, force: int, label: str, unit: str) -> str:
    """Return a record of dataset 58 that describes an axis."""
    return f"{kind:10d}{length:5d}{force:5d}{0:5d} {label[:20]:<20} {unit[:20]:<20}"


def _is_even(frequency: Array) -> bool:
    """Whether the frequencies, rounded as the format rounds start and step, have equal steps."""
    if len(frequency) < 2:
        return False
    start, step = (float(f"{x:.5E}") for x in (frequency[0], float(np.mean(np.diff(frequency)))))
    return bool(np.allclose(start + step * np.arange(len(frequency)), frequency, rtol=EVEN_TOLERANCE, atol=0.0))


def _abscissa_record(frequency: Array) -> str:
    even = _is_even(frequency)
    step = float(np.mean(np.diff(frequency))) if even else 0.0
    return f"{COMPLEX_DOUBLE:10d}{len(frequency):10d}{int(even):10d}{frequency[0]:13.5E}{step:13.5E}{0.0:13.5E}"


def _values(frequency: Array, value: NDArray[np.complex128]) -> Iterator[str]:
    """Yield the values: two complex numbers a line where the abscissa is even, else one with its abscissa."""
    if _is_even(frequency):
        for start in range(0, len(value), 2):
            yield "".join(f"{x.real:20.12E}{x.imag:20.12E}" for x in value[start : start + 2])
        return
    for f, x in zip(frequency, value, strict=True):
        yield f"{f:13.5E}{x.real:20.12E}{x.imag:20.12E}"
