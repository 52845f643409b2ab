"""Why no line of the loads repeats from period to period: a spike, an exciter that stops, or a wrong `period`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.run_samples import run_error, sample_rate

ComplexArray = NDArray[np.complex128]

ALIKE, DIFFERENT = 0.1, 0.3
"""Distance of the loads of a period from the median over the periods, over its size: below the first a period is like
the others, above the second it is not. Loads that have another period than declared differ by 1.4 in all of them."""
FEWEST_PERIODS = 3
"""Periods from which a median is that of most."""


def deviating_periods(loads: ComplexArray) -> tuple[int, ...]:
    """Return the numbers of the periods whose loads (P, K, u) differ from those that most have; empty without most."""
    if len(loads) < FEWEST_PERIODS:
        return ()
    median = np.median(loads.real, axis=0) + 1j * np.median(loads.imag, axis=0)
    size = float(np.linalg.norm(median))
    distance = np.linalg.norm((loads - median).reshape(len(loads), -1), axis=1)
    alike = np.count_nonzero(distance < ALIKE * size)
    return tuple(int(p) for p in np.flatnonzero(distance > DIFFERENT * size)) if 2 * alike > len(loads) else ()


def no_common_line(run: Run, loads: ComplexArray) -> UserError:
    """Return the error of a record whose loads (P, K, u) have no line in common; periods end with the record."""
    fault, periods = "no line of the loads repeats from period to period", deviating_periods(loads)
    if not periods:
        return run_error(run, fault, "Check `period` and `sample_rate`", "attribute `period`")
    return _unlike_loads(run, f"{fault}: ", periods, len(loads))


def require_like_loads(run: Run, loads: ComplexArray, first: int) -> None:
    """Raise UserError where loads (P, K, u) of periods from `first` on, which are used, are unlike those of most."""
    periods = tuple(p for p in deviating_periods(loads) if p >= first)
    if periods:
        raise _unlike_loads(run, "", periods, len(loads))


def _unlike_loads(run: Run, fault: str, periods: Sequence[int], count: int) -> UserError:
    """The error that names these periods by their times."""
    rate = sample_rate(run)
    step = run.samples // count / rate
    begin = run.samples / rate - count * step
    parts = ", ".join(f"{begin + p * step:.4g} to {begin + (p + 1) * step:.4g} s" for p in periods)
    text = f"{fault}the loads from {parts} are unlike those of most of the {count} periods"
    return run_error(run, text, "Look there for a spike or an exciter that stopped, and cut the record", "loads")
