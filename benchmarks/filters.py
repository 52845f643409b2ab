"""Speed of filters and smoothers compared with filterpy; time and peak memory of a whole reduction in time.

The model is the balance of the sample campaign with a flexible support and a delayed channel, and six loads. With
filterpy it is the usual loop, `predict` and `update` of a `KalmanFilter` for each sample, with the same F, H, Q and R;
it starts with the steady covariance, so that the results should agree. Its `rts_smoother` follows, with a
pseudo-inverse: hardly any noise drives some modes of the balance, and the inverse of their covariance overflows.

The peak memory of a reduction of ten minutes is compared with that of two.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.balance import balance_model
from balance_cli.model.state_space import state_space, with_anti_alias
from balance_cli.reduction.kalman.augmented_model import MeasuredSystem
from balance_cli.reduction.kalman.azimuth_locked import AzimuthLockedFilter
from balance_cli.reduction.kalman.channel_filter import ChannelFilter
from balance_cli.reduction.kalman.load_models import BandLimitedNoise, LoadLayer, LowPassDrift, Oscillators
from balance_cli.reduction.kalman.run_filters import azimuth_locked_filters, time_invariant_filters
from balance_cli.reduction.kalman.segments import RunFilters, Segment
from balance_cli.reduction.kalman.steady_matrices import SteadyMatrices
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import identify
from balance_cli.steps.reduce_in_time import reduce_run_in_time
from benchmarks.comparison import Comparison, program_with_version
from benchmarks.filters_memory import RATE, SPEED, ReductionCase

Array = NDArray[np.float64]
ROOT = Path(__file__).parents[1]

SAMPLES, FILTERPY_SAMPLES = 8000, 300
"""Samples for the filters here, and for filterpy."""
REPETITIONS = 3
SHORT, LONG = 120.0, 600.0
"""Lengths [s] of the records whose peak memory is compared."""
SUPPORT = {
    "mass": 300.0,
    "inertia_psi": 30.0,
    "inertia_theta": 25.0,
    "inertia_phi": 20.0,
    "damping_ratio": 0.03,
    "z": -0.3,
    "compliance_x": 2e-9,
    "compliance_y": 3e-9,
    "compliance_z": 1e-9,
    "compliance_psi": 1e-8,
    "compliance_theta": 2e-8,
    "compliance_phi": 1e-8,
}
SIZES = np.array([50.0, 50.0, 80.0, 10.0, 10.0, 8.0])
"""Standard deviations [N, N m] of the loads between the harmonics."""


def compare() -> list[Comparison]:
    """Time the smoother of random loads beside filterpy's, and the whole reduction."""
    channel_filter = _channel_filter(_time_invariant())
    seconds, reference, differences = _times_beside_filterpy(channel_filter)
    steady = channel_filter.at(0)
    size = f"{steady.model.order} states, {len(steady.model.H)} channels, {RATE:g} Hz"
    ours, theirs = (sum(item) for item in (seconds, (reference.filtering, reference.smoothing)))
    note = f"{size}: {1 / ours / RATE:.0f} times real time; loads {max(differences):.0e} of their sigma apart"
    program = program_with_version("filterpy", "KalmanFilter, rts_smoother")
    return [Comparison("`reduce --method smoother`", "sample", ours, program, theirs, note)]


def run() -> str:
    """Time the filters and reductions, and return the text of the results."""
    try:
        import filterpy
    except ImportError:
        return "filterpy is not installed: pip install '.[bench]'"
    text = [f"samples {SAMPLES}, of filterpy {filterpy.__version__} {FILTERPY_SAMPLES}"]
    text += _compare_with_filterpy("random loads", _channel_filter(_time_invariant()))
    text += _compare_with_filterpy("locked to the azimuth", _constant_speed_filter(_channel_filter(_azimuth_locked())))
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case"
        case.write_bytes(pickle.dumps(_campaign()))
        text += _whole_reduction(case)
        text += _peak_memory(case)
    return "\n".join(text)


# ---- filters ---------------------------------------------------------------------------------------------------------


def _balance() -> MeasuredSystem:
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    effects = (
        DeclaredEffect(name="support-flexibility", where=("x", "y", "z", "psi", "theta", "phi"), parameters=SUPPORT),
        DeclaredEffect(name="time-delay", where=("z1.piezo",), parameters={"delay": 1e-3}),
    )
    system = balance_model(geometry.model_copy(update={"effects": effects})).system()
    space = with_anti_alias(state_space(system, SPEED), geometry.acquisition)
    channels = len(space.channel_names)
    return MeasuredSystem(space, tuple(range(6)), 1.0 / RATE, np.full(channels, 1e-8), np.zeros(channels))


def _load_layers(*bands: float) -> list[LoadLayer]:
    return [LowPassDrift(SIZES, 0.1, 5.0), *(BandLimitedNoise(0.1 * SIZES, band) for band in bands)]


def _segments(system: MeasuredSystem) -> tuple[Segment, ...]:
    return (Segment(0, SAMPLES, tuple(range(len(system.noise)))),)


def _time_invariant() -> RunFilters:
    system = _balance()
    return time_invariant_filters(system, _load_layers(40.0, 150.0), 10.0 * SIZES, _segments(system))


def _azimuth_locked() -> RunFilters:
    system = _balance()
    turns = np.arange(int(SAMPLES / RATE * SPEED) + 4)
    azimuth = Azimuth((turns - 0.5) / SPEED, turns)
    oscillators = Oscillators(0.01 * np.tile(SIZES, (8, 1)), 0.3 * np.tile(SIZES, (8, 1)), tuple(range(1, 9)))
    return azimuth_locked_filters(system, _load_layers(100.0), oscillators, 10.0 * SIZES, azimuth, _segments(system))


def _channel_filter(filters: RunFilters) -> ChannelFilter:
    (channel_filter,) = filters.channel_filters.values()
    return channel_filter


def _constant_speed_filter(channel_filter: ChannelFilter) -> ChannelFilter:
    """Return the filter with a single model at both ends of its speed grid, as filterpy needs it."""
    assert isinstance(channel_filter, AzimuthLockedFilter)
    first = channel_filter.filters[0]
    oscillator_states = replace(
        channel_filter.oscillator_states, azimuth=lambda sample: 2 * np.pi * channel_filter.speeds[0] * sample / RATE
    )
    return replace(channel_filter, filters=(first, first), oscillator_states=oscillator_states)


def _compare_with_filterpy(name: str, channel_filter: ChannelFilter) -> list[str]:
    """Compare time per sample and results of filter and smoother."""
    steady = channel_filter.at(0)
    (filtering, smoothing), reference, differences = _times_beside_filterpy(channel_filter)
    return [
        f"{name}, states {steady.model.order}, channels {len(steady.model.H)}",
        _ratio_line("filter", filtering, reference.filtering),
        _ratio_line("filter and smoother", filtering + smoothing, reference.filtering + reference.smoothing),
        f"  largest difference over the standard deviation of a load: {differences[0]:.1e} (filter), "
        f"{differences[1]:.1e} (smoother)",
    ]


def _times_beside_filterpy(
    channel_filter: ChannelFilter,
) -> tuple[tuple[float, float], FilterpyResult, tuple[float, float]]:
    """Return seconds per sample of filter and smoother, those of filterpy, and how far their loads are apart."""
    steady = channel_filter.at(0)
    y, start = _draw_channels(steady, SAMPLES), np.zeros(steady.model.order)
    filter_block = channel_filter.forward_pass(0, y, start)
    channel_filter.backward_pass(filter_block, start)  # computes what is cached
    filtering = _seconds_per_sample(lambda: channel_filter.forward_pass(0, y, start))
    smoothing = _seconds_per_sample(lambda: channel_filter.backward_pass(filter_block, start))
    reference = _with_filterpy(steady, y[:FILTERPY_SAMPLES])
    filter_block = channel_filter.forward_pass(0, y[:FILTERPY_SAMPLES], start)
    smoothed = channel_filter.backward_pass(filter_block, start)[0].loads
    differences = (
        _largest_difference(reference.predicted, filter_block.predicted),
        _largest_difference(reference.smoothed, smoothed),
    )
    return (filtering, smoothing), reference, differences


def _ratio_line(name: str, seconds: float, reference: float) -> str:
    rates = (
        f"{1 / seconds:8.0f} samples a second, {1 / seconds / RATE:.0f} times real time; filterpy {1 / reference:6.0f}"
    )
    return f"  {name:20s}{rates}, ratio {reference / seconds:.0f}"


def _largest_difference(loads: Array, reference: Array) -> float:
    return float(np.max(np.abs(loads - reference).max(axis=0) / reference.std(axis=0)))


def _draw_channels(steady: SteadyMatrices, samples: int) -> Array:
    """Draw channels (n, c) from the model."""
    model, rng = steady.model, np.random.default_rng(0)
    value, vector = np.linalg.eigh(model.Q)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    noise = rng.standard_normal((samples, model.order)) @ root.T
    x, y = np.zeros(model.order), rng.standard_normal((samples, len(model.H)))
    for k in range(samples):
        y[k] += model.H @ x
        x = model.F @ x + noise[k]
    return y


def _seconds_per_sample(call: Callable[[], object]) -> float:
    return min(_seconds(call) for _ in range(REPETITIONS)) / SAMPLES


def _seconds(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


@dataclass(frozen=True)
class FilterpyResult:
    """Loads (n, m), and seconds per sample."""

    predicted: Array
    smoothed: Array
    filtering: float
    smoothing: float


def _with_filterpy(steady: SteadyMatrices, y: Array) -> FilterpyResult:
    from filterpy.kalman import KalmanFilter

    model = steady.model
    kalman = KalmanFilter(dim_x=model.order, dim_z=len(model.H))
    kalman.F, kalman.H, kalman.Q, kalman.R = model.F, model.H, model.Q, np.eye(len(model.H))
    kalman.x, kalman.P = np.zeros(model.order), steady.P
    before, states, covariances = [], [], []
    start = time.process_time()
    for now in y:
        before.append(kalman.x)
        kalman.update(now)
        states.append(kalman.x)
        covariances.append(kalman.P)
        kalman.predict()
    filtered = time.process_time()
    smoothed = kalman.rts_smoother(np.array(states), np.array(covariances), inv=np.linalg.pinv)[0]
    end = time.process_time()
    U, n = model.U, len(y)
    return FilterpyResult(np.array(before) @ U.T, smoothed @ U.T, (filtered - start) / n, (end - filtered) / n)


# ---- whole reductions ------------------------------------------------------------------------------------------------


def _campaign() -> ReductionCase:
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    sweeps = [open_run(path) for path in sorted((ROOT / "sample_data").glob("s*.h5"))]
    model = identify(measured_spectra(sweeps, geometry), geometry)
    return ReductionCase(
        geometry, calibrate([item for item in sweeps if item.kind == "static"], geometry), ModelSource(model)
    )


def _whole_reduction(path: Path) -> list[str]:
    case: ReductionCase = pickle.loads(path.read_bytes())
    record = open_run(ROOT / "sample_data" / "wind-1.h5")
    assert record.sample_rate is not None
    length = record.samples / record.sample_rate
    seconds = _seconds(lambda: reduce_run_in_time(record, case.geometry, case.calibration, case.source))
    return [f"whole reduction of {length:.0f} s: {seconds:.1f} s, {length / seconds:.0f} times real time"]


def _peak_memory(path: Path) -> list[str]:
    peaks = [_peak_memory_of_process(path, length) for length in (SHORT, LONG)]
    text = " and ".join(f"{peak:.0f} MB for {length:.0f} s" for peak, length in zip(peaks, (SHORT, LONG), strict=True))
    held = (LONG - SHORT) * RATE * 15 * 8 / 2**20
    return [
        f"peak memory {text}: {peaks[1] - peaks[0]:.0f} MB more; the samples of the difference alone are {held:.0f} MB"
    ]


def _peak_memory_of_process(path: Path, length: float) -> float:
    """Return the peak memory [MB] of a process that reduces a record of this length [s]."""
    command = [sys.executable, "-m", "benchmarks.filters_memory", str(path), str(length)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout)
