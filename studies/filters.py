"""Frequency domain or Kalman filter: loads in time by all methods, on a balance with two degrees of freedom.

The study repeats the comparison of the paper, whose figure 11 is lost: effects of errors in the system matrix, in the
channels and in the rotor speed, and of unsteady loads, on each method. The truth is integrated in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy.signal
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.kalman.load_history import LoadHistory
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.simulation import RunTruth, simulate_run
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduce_in_time import TimeOptions, reduce_run_in_time
from studies.filters_rig import (
    CASES,
    COLUMNS,
    NOMINAL_SPEED,
    SAMPLE_RATE,
    FilterCase,
    rotor_plan,
    static_plan,
    two_degree_geometry,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DURATION = 12.0
START_EXCLUDED, END_EXCLUDED = 2.0, 0.2
"""Time [s] left out after the first and before the last pulse, so that the methods and not the ends are compared."""
BAND = 150.0
"""Upper frequency [Hz] of the second measure of errors: above 8/rev, below the anti-alias filter."""
HARMONICS = 8
LAG = 0.05
Z_95 = 1.959963984540054

NOMINAL_HARMONICS, ACTUAL_HARMONICS = "T at nominal harmonics", "T at actual harmonics"
IN_TIME = {
    "harmonics, filter": TimeOptions(smooth=False, load_model="harmonics", lag=0.0),
    "harmonics, filter 0.05 s behind": TimeOptions(smooth=False, load_model="harmonics", lag=LAG),
    "harmonics, smoother": TimeOptions(smooth=True, load_model="harmonics"),
    "random, filter": TimeOptions(smooth=False, load_model="random", lag=0.0),
    "random, filter 0.05 s behind": TimeOptions(smooth=False, load_model="random", lag=LAG),
    "random, smoother": TimeOptions(smooth=True, load_model="random"),
    "free, filter 0.05 s behind": TimeOptions(smooth=False, load_model="free", lag=LAG),
    "free, smoother": TimeOptions(smooth=True, load_model="free"),
}
METHODS = (NOMINAL_HARMONICS, ACTUAL_HARMONICS, *IN_TIME)


@dataclass(frozen=True)
class SimulatedRecord:
    """One run with its truth, the geometry, the calibration and the response for its reduction."""

    run: Run
    truth: RunTruth
    geometry: Geometry
    calibration: Calibration
    source: ModelSource


@dataclass(frozen=True)
class ReducedRecord:
    """Loads (n, 2) from sample `first` on between the pulses, sigma (n, 2) or None, amplitudes (8, 2) in `interval`."""

    first: int
    loads: Array
    sigma: Array | None
    amplitude: ComplexArray
    interval: tuple[float, float]


def filters_chunk(seed: int, duration: float = DURATION) -> pd.DataFrame:
    """Return the errors of all cases by all methods for one seed, one row each."""
    rows = [row for case in CASES.values() for row in case_rows(simulate_record(case, seed, duration), case.name)]
    return pd.DataFrame(rows).assign(seed=seed)


def simulate_record(case: FilterCase, seed: int, duration: float = DURATION) -> SimulatedRecord:
    """Simulate a run of one case and a static calibration of the same rig; the model is that of the declared rig."""
    geometry = two_degree_geometry(case.tolerances)
    rig = case.rig(geometry, np.random.default_rng([seed, 11]), duration)
    run, truth = simulate_run(rig, rotor_plan(case, duration), seed=seed)
    static, _ = simulate_run(rig, static_plan(), seed=seed)
    model = identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed"))
    return SimulatedRecord(run, truth, geometry, calibrate([static], geometry, choice=LINEAR_TERMS), ModelSource(model))


def case_rows(record: SimulatedRecord, case: str, methods: tuple[str, ...] = METHODS) -> list[dict[str, object]]:
    """Return the errors of one record by each method."""
    return [{"case": case, "method": method, **errors(record, reduce_by_method(record, method))} for method in methods]


def reduce_by_method(record: SimulatedRecord, method: str) -> ReducedRecord:
    """Reduce the record by one method."""
    if method in IN_TIME:
        return _reduce_record_in_time(record, IN_TIME[method])
    steady = reduce_run(record.run, record.geometry, record.calibration, record.source)
    amplitude = steady.amplitude[1:] if method == ACTUAL_HARMONICS else loads_at_nominal_harmonics(record)
    return _sum_of_harmonics(record, steady, amplitude)


def loads_at_nominal_harmonics(record: SimulatedRecord) -> ComplexArray:
    """Return amplitudes (8, 2) as in the paper: harmonic analysis, then T_nu = (C*C)^-1 C* of the nominal harmonics."""
    rotor = rotor_record(record.run, record.geometry, record.source, HARMONICS)
    nominal = NOMINAL_SPEED * np.arange(1, HARMONICS + 1)
    C = record.source.at(nominal, NOMINAL_SPEED)[:, :, COLUMNS]
    spectra = rotor.spectra
    s = spectra.amplitude[1:, spectra.columns(record.geometry.channel_names)]
    s = s / anti_alias_response(record.geometry.acquisition, nominal)[:, None]
    return np.asarray(np.einsum("hmc,hc->hm", np.linalg.pinv(C), s))


def _sum_of_harmonics(record: SimulatedRecord, steady: RunLoads, amplitude: ComplexArray) -> ReducedRecord:
    """Return the sum of the harmonics at the azimuth of every sample."""
    inside = _between_pulses(record)
    assert record.run.pulse_times is not None
    psi = azimuth_from_pulses(record.run.pulse_times).psi(record.truth.time[inside])
    phasors = np.exp(1j * psi[:, None] * np.arange(1, HARMONICS + 1))
    loads = steady.amplitude[0].real + np.real(phasors @ amplitude)
    return ReducedRecord(inside.start, loads, None, amplitude, steady.interval)


def _reduce_record_in_time(record: SimulatedRecord, options: TimeOptions) -> ReducedRecord:
    parts: list[LoadHistory] = []
    result = reduce_run_in_time(
        record.run, record.geometry, record.calibration, record.source, None, options, parts.append
    )
    loads, sigma = (np.concatenate([getattr(part, name) for part in parts])[:, COLUMNS] for name in ("loads", "sigma"))
    first = round(float(parts[0].time[0]) * SAMPLE_RATE)
    return ReducedRecord(first, loads, sigma, result.loads.amplitude[1:], result.loads.interval)


def _between_pulses(record: SimulatedRecord) -> slice:
    """Return the samples from the first to the last pulse."""
    pulses = record.run.pulse_times
    assert pulses is not None
    return slice(int(np.ceil(pulses[0] * SAMPLE_RATE)), int(np.floor(pulses[-1] * SAMPLE_RATE)) + 1)


def errors(record: SimulatedRecord, reduced: ReducedRecord) -> dict[str, float]:
    """Return errors relative to the true loads, both components together (rms of the two relative errors).

    `history`: rms of the error, mean load included, over the standard deviation of the load; `in_band`: the same below
    BAND; `harmonics`: rms error of harmonics 1 to 8 over their rms; `coverage` of the 95 % intervals of the
    history.
    """
    part = slice(reduced.first, reduced.first + len(reduced.loads))
    true, time = record.truth.loads[part][:, COLUMNS], record.truth.time[part]
    error, counted = reduced.loads - true, (time >= START_EXCLUDED) & (time <= time[-1] - END_EXCLUDED)
    size = true[counted].std(axis=0)
    low = scipy.signal.butter(8, BAND, fs=SAMPLE_RATE, output="sos")
    slow = np.asarray(scipy.signal.sosfiltfilt(low, error, axis=0))
    cosine, sine = record.truth.harmonics(*reduced.interval)
    amplitude = (cosine - 1j * sine)[1 : HARMONICS + 1, COLUMNS]
    hits = np.nan if reduced.sigma is None else np.mean(np.abs(error) < Z_95 * reduced.sigma, where=counted[:, None])
    return {
        "history": _pool_errors(_rms(error[counted]) / size),
        "in_band": _pool_errors(_rms(slow[counted]) / size),
        "harmonics": _pool_errors(_rms(reduced.amplitude - amplitude) / _rms(amplitude)),
        "coverage": float(hits),
    }


def _rms(values: Array | ComplexArray) -> Array:
    return np.asarray(np.sqrt(np.mean(np.abs(values) ** 2, axis=0)))


def _pool_errors(relative: Array) -> float:
    return float(np.sqrt(np.mean(relative**2)))
