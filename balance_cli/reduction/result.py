"""Reduced hub loads: what `reduce` leaves behind and the report and other people's scripts take up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.kalman.innovations import InnovationTests
from balance_cli.reduction.kalman.load_history import LoadTrack

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LOAD_TABLE_COLUMNS = (
    "run",
    "component",
    "unit",
    "harmonic",
    "frequency_hz",
    "cosine",
    "sine",
    "amplitude",
    "phase_deg",
    "sigma_cosine",
    "sigma_sine",
    "flag",
)


@dataclass(frozen=True)
class CheckErrors:
    """Reduced against applied loads of a check run, over harmonics 1 to 8 (contract, `load_error`).

    load_error {component applied: relative error}, interaction {component not applied: relative to the largest applied
    force}; load_noise and interaction_noise: what the record's noise alone would leave of each. `applied` (n+1, m) are
    the loads as the exciter measured them, anti-alias filter taken out.
    """

    load_error: dict[str, float]
    interaction: dict[str, float]
    load_noise: dict[str, float]
    interaction_noise: dict[str, float]
    applied: ComplexArray


@dataclass(frozen=True)
class TimeDomainResult:
    """How a Kalman filter or smoother found the loads, and whether it was what it takes itself for.

    `loads_as`: what was known of the loads (`harmonics`, `random`, `free`); `lag` [s] of a filter behind the samples,
    None where it has none; `innovations` tested, None where no stretch has all channels; `track`: harmonics from
    revolution to revolution, None where nothing follows them; `noise` {channel: standard deviation of a sample's noise,
    V}; `bridged`: what was missing, in words.
    """

    loads_as: str
    lag: float | None
    innovations: InnovationTests | None
    track: LoadTrack | None
    noise: dict[str, float]
    bridged: tuple[str, ...]


@dataclass(frozen=True)
class RunLoads:
    """Hub loads of one run: m components, harmonics 0 to n.

    frequency_hz (n+1,): n times the mean pulse rate of the record; amplitude (n+1, m) = cosine - j sine; sigma_cosine,
    sigma_sine (n+1, m); flags (n+1, m) words, empty where all is well; redundancy, redundancy_limit, condition (n+1,),
    NaN where there is none; interval [s] that was used; `in_time`: where the loads were found by a filter or smoother.
    """

    run: str
    kind: str
    response: str
    trim: str
    components: tuple[str, ...]
    frequency_hz: Array
    amplitude: ComplexArray
    sigma_cosine: Array
    sigma_sine: Array
    flags: tuple[tuple[str, ...], ...]
    redundancy: Array
    redundancy_limit: Array
    condition: Array
    left_out: dict[str, str]
    interval: tuple[float, float]
    notes: tuple[str, ...] = ()
    check: CheckErrors | None = None
    in_time: TimeDomainResult | None = None


@dataclass(frozen=True)
class HubLoads:
    """Hub loads of all runs of one reduction, and the geometry of the calibration behind them.

    `method` is `harmonic`, `kalman` or `smoother`.
    """

    method: str
    response: str
    geometry: Geometry
    runs: dict[str, RunLoads]


def load_table(loads: HubLoads) -> pd.DataFrame:
    """One row per run, component and harmonic (contract, LOADS)."""
    import pandas as pd

    rows = [row for run in loads.runs.values() for row in _rows(run)]
    return pd.DataFrame(rows, columns=list(LOAD_TABLE_COLUMNS))


def _rows(run: RunLoads) -> list[tuple[object, ...]]:
    from balance_cli.campaign.rig.components import UNIT_OF

    rows: list[tuple[object, ...]] = []
    for m, component in enumerate(run.components):
        for n, frequency in enumerate(run.frequency_hz):
            value = complex(run.amplitude[n, m])
            cosine, sine = value.real, -value.imag
            phase = float(np.degrees(np.arctan2(-sine, cosine)))
            sigmas = (run.sigma_cosine[n, m], run.sigma_sine[n, m])
            identity = (run.run, component, UNIT_OF[component], n, frequency)
            rows.append((*identity, cosine, sine, abs(value), phase, *sigmas, run.flags[n][m]))
    return rows
