"""The sample rate that a foreign file states beside its channels, in its head or as a number of its own."""

from __future__ import annotations

from balance_cli.importers.base import ForeignFile
from balance_cli.importers.written_numbers import whole_rate
from balance_cli.io.units import TIME, Unit, parse_unit

CLOCK_UNITS = {"ns": 1e-9, "d": 86400.0, "day": 86400.0, "days": 86400.0}
"""[s]. Units of times alone: counters of computers, and dates of spreadsheets."""
RATE_TOLERANCE = 1e-3
"""Relative difference from which the rate in the head of a file contradicts its times."""
LARGEST = 1e12
"""[Hz], or of a step its inverse [1/s]: a thousand times what any converter reaches."""
RATE_NAMES = ("sample_rate", "fs", "samplerate", "sampling_rate", "rate", "sr")

STEP_NAMES = ("dt", "ts", "delta_t", "increment", "sample_interval", "time_step")
"""Names of a time step [s]; `increment` is that of Siemens Testlab."""


def time_unit(text: str) -> Unit:
    """Return the unit of times that a text names. Raises UserError, without file and place, where it names none."""
    factor = CLOCK_UNITS.get(text)
    return parse_unit(text, TIME) if factor is None else Unit(text, TIME, factor)


def stated_rates(file: ForeignFile) -> list[float]:
    """Return the different rates [Hz] that the file states beside its channels, themselves or by steps."""
    stated = [(name.rpartition(".")[2].lower(), value) for name, value in file.scalars.items() if _is_possible(value)]
    rates = [value for name, value in stated if name in RATE_NAMES]
    return list(dict.fromkeys(rates or [whole_rate(1.0 / value) for name, value in stated if name in STEP_NAMES]))


def _is_possible(value: float) -> bool:
    """Whether a number and its inverse are finite and positive."""
    return 1.0 / LARGEST < value < LARGEST


def stated_rate(file: ForeignFile) -> float | None:
    """Return the rate [Hz] that the file states, None where it states several or none."""
    rates = stated_rates(file)
    return rates[0] if len(rates) == 1 else None


def contradiction(file: ForeignFile, rate: float, source: str) -> str:
    """Return what to tell where the file states other rates than that of `source`, which was taken; else empty."""
    stated = stated_rates(file)
    if not stated or any(abs(rate / each - 1.0) < RATE_TOLERANCE for each in stated):
        return ""
    listed = " and ".join(f"{each:.10g}" for each in stated)
    return f"{file.path.name}: the file states {listed} Hz, {source} {rate:.10g} Hz, which was taken"
