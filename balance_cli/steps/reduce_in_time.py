"""Reduction in time: hub loads as functions of time by a Kalman filter or smoother, for runs that are not steady.

The filter takes the deviations of the channels from their means over a steady part. The means go through the static
calibration, as in a reduction by harmonics, so that both kinds of reduction have the same mean loads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run, excerpt_run, read_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.state_space import state_space, with_anti_alias
from balance_cli.model.system import System
from balance_cli.reduction.check_contradiction import flag_by_turbulence
from balance_cli.reduction.choices import FREE, HARMONICS, KALMAN, LOAD_MODELS, SMOOTHER
from balance_cli.reduction.kalman.amplitude_drift import fit_drifting_harmonics
from balance_cli.reduction.kalman.augmented_model import MeasuredSystem
from balance_cli.reduction.kalman.data_quality import DataQuality, assess_data_quality
from balance_cli.reduction.kalman.filter_tuning import (
    fit_loads_between_harmonics,
    fit_random_loads,
    uninformative_loads,
)
from balance_cli.reduction.kalman.filtering import filtered_estimates
from balance_cli.reduction.kalman.innovations import InnovationSums, InnovationTests
from balance_cli.reduction.kalman.load_history import LoadHistory, LoadTrack
from balance_cli.reduction.kalman.load_recorder import LoadRecorder, RecorderSettings
from balance_cli.reduction.kalman.run_filters import azimuth_locked_filters, time_invariant_filters
from balance_cli.reduction.kalman.segments import Estimates, RunFilters
from balance_cli.reduction.kalman.smoothing import smoothed_estimates
from balance_cli.reduction.response_sources import ResponseSource, no_state_space_error
from balance_cli.reduction.result import RunLoads, flag_filter
from balance_cli.reduction.rotor_record import RotorRecord, rotor_record
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals.channel_noise import CleanRecord, channel_noise
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.other_rotors import rotor_azimuth
from balance_cli.signals.run_samples import sample_rate
from balance_cli.steps.reduce import reduce_record

Array = NDArray[np.float64]

INITIAL_STATE_TIME = 5.0
"""Time [s] of a record from which its initial state is estimated: several decay times of a balance and its channels."""
NEGLIGIBLE_FACTOR = 1e-6
"""Factor on a covariance that takes it out of every sum; zero would make the weights singular."""
OFFSET_MARGIN = 10.0
"""Standard deviations of noise that the prior of an offset has beyond its observed mean: practically uninformative."""


@dataclass(frozen=True)
class TimeOptions:
    """Options of a reduction in time.

    `smooth` uses the whole record, otherwise each estimate uses the samples up to `lag` [s] after it. `load_model` is
    one of `choices.LOAD_MODELS`; `harmonics` is the highest. A load appears in the cells and behind the anti-alias
    filter some milliseconds late, so that a filter without lag would have to predict it.
    """

    smooth: bool = True
    load_model: str = LOAD_MODELS[0]
    lag: float = 0.05
    harmonics: int = 8

    @property
    def method(self) -> str:
        """The name of the method, one of `choices.METHODS`."""
        return SMOOTHER if self.smooth else KALMAN


@dataclass(frozen=True)
class TimeReduction:
    """Loads of one run, harmonics from revolution to revolution where the load model has them, tests of the filter.

    `noise` {channel: standard deviation of the noise of one sample, V}; `gap_notes`: gaps, and channels that were not
    used for a time, in words.
    """

    loads: RunLoads
    track: LoadTrack | None
    innovations: InnovationTests | None
    noise: dict[str, float]
    gap_notes: tuple[str, ...]


@dataclass(frozen=True)
class _RunSetup:
    """One run with what its filter needs: data quality, steady part, system of balance and channels, means.

    `record` is the steady part, which begins at `start` [s] of the run; `mean` (c,) [V] is what the filter subtracts.
    """

    run: Run
    data_quality: DataQuality
    record: RotorRecord
    start: float
    azimuth: Azimuth
    system: MeasuredSystem
    mean: Array

    @property
    def interval(self) -> tuple[float, float]:
        """The steady part [s], counted from the first sample of the run."""
        first, last = self.record.spectra.interval
        return self.start + first, self.start + last

    @property
    def revolutions(self) -> tuple[int, int]:
        """First and last of the run's revolutions that lie entirely in the steady part."""
        first, last = self.azimuth.extrapolated_count(np.array(self.interval))
        return int(np.ceil(first - 1e-6)), int(np.floor(last + 1e-6))

    def clean_record(self) -> CleanRecord:
        """Return the samples of the steady part at which all channels are usable."""
        first = int(np.ceil(self.interval[0] / self.system.step))
        spans = tuple((max(start, first), stop) for start, stop in self.data_quality.spans if stop > first)
        return CleanRecord(self.run, self.data_quality.names, spans)

    def read(self, start: int, stop: int, channels: tuple[int, ...]) -> Array:
        """Return samples `start` to `stop` less the means, in units of the noise."""
        names = [self.data_quality.names[i] for i in channels]
        y = read_channels(self.run, names, start, stop) - self.mean[list(channels)]
        return np.asarray(y / np.sqrt(self.system.noise[list(channels)]))


def reduce_run_in_time(
    run: Run,
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None = None,
    options: TimeOptions | None = None,
    sink: Callable[[LoadHistory], None] | None = None,
) -> TimeReduction:
    """Reduce one `check` or `wind` run by a Kalman filter or smoother; `sink` receives the history block by block.

    Raises UserError where the source has no state space, the pulses or channels are unusable, a gap is too long, or
    no filter is steady.
    """
    options = options or TimeOptions()
    setup = _set_up_run(run, geometry, source, options)
    harmonic_result = reduce_record(_with_exact_means(setup.record), geometry, calibration, source, zero)
    recorder = LoadRecorder(_recorder_settings(setup, harmonic_result, options), sink)
    sums = InnovationSums(len(setup.data_quality.names))
    for estimates in _steady_estimates(setup, harmonic_result, options):
        recorder.add(estimates)
        if len(estimates.channels) == len(setup.data_quality.names):
            sums.add(estimates.innovations)
    loads = reduce_record(setup.record, geometry, calibration, source, zero, recorder.mean_amplitudes()[1:])
    loads = flag_by_turbulence(loads, setup.record, geometry, source)
    notes = (*setup.azimuth.notes, *setup.data_quality.notes, *loads.notes[len(setup.record.azimuth.notes) :])
    innovations = sums.tests(setup.data_quality.names, options.load_model == FREE)
    return TimeReduction(
        loads=flag_filter(replace(loads, interval=setup.interval, notes=notes), innovations),
        track=recorder.track(),
        innovations=innovations,
        noise=dict(zip(setup.data_quality.names, np.sqrt(setup.system.noise).tolist(), strict=True)),
        gap_notes=setup.data_quality.notes,
    )


def _set_up_run(run: Run, geometry: Geometry, source: ResponseSource, options: TimeOptions) -> _RunSetup:
    """Return the run with its steady part, means and noise."""
    equations = source.system
    if equations is None:
        raise no_state_space_error(options.method)
    health = live_channels(run, geometry).without(source.untrusted_channels)
    data_quality = assess_data_quality(run, geometry, health)
    record, start = _steady_record(run, geometry, source, data_quality, options.harmonics)
    if not data_quality.gaps and set(data_quality.names) == set(record.health.live):
        run = record.run  # without the contribution of nonlinear cell forces
    if run.pulse_times is None or run.sample_rate is None:
        raise AssertionError("a record on azimuth has pulses")
    system = _measured_system(equations, geometry, data_quality, record, 1.0 / run.sample_rate)
    azimuth, means = rotor_azimuth(run, 1), np.zeros(len(data_quality.names))
    return _with_noise_and_means(_RunSetup(run, data_quality, record, start, azimuth, system, means), geometry)


def _with_noise_and_means(setup: _RunSetup, geometry: Geometry) -> _RunSetup:
    """Return the setup with noise and means; channels that block DC get an offset state in place of a mean."""
    noise, mean = channel_noise(setup.clean_record(), geometry.acquisition), _channel_means(setup)
    system, names = setup.system, setup.data_quality.names
    measures_dc = {channel.name: channel.measures_dc for channel in geometry.channels}
    blocks_dc = np.array([not measures_dc[name] for name in names])
    offset = np.zeros(len(system.space.channel_names))
    rows = [system.space.channel_names.index(name) for name in names]
    offset[rows] = np.where(blocks_dc, np.abs(mean) + OFFSET_MARGIN * np.sqrt(noise), 0.0)
    return replace(setup, system=replace(system, noise=noise, offset=offset), mean=np.where(blocks_dc, 0.0, mean))


def _steady_record(
    run: Run, geometry: Geometry, source: ResponseSource, data_quality: DataQuality, max_harmonic: int
) -> tuple[RotorRecord, float]:
    """Return the record over azimuth of the longest part without a gap, and the time [s] at which it begins."""
    if not data_quality.gaps:
        return rotor_record(run, geometry, source, max_harmonic, remove_other_rotors=False), 0.0
    edges = [0, *(edge for gap in data_quality.gaps for edge in (gap.start, gap.stop)), run.samples]
    start, stop = max(zip(edges[::2], edges[1::2], strict=True), key=lambda part: part[1] - part[0])
    part = excerpt_run(run, start, stop)
    return rotor_record(part, geometry, source, max_harmonic, remove_other_rotors=False), start / sample_rate(run)


def _measured_system(
    system: System, geometry: Geometry, data_quality: DataQuality, record: RotorRecord, step: float
) -> MeasuredSystem:
    """Return the state space of the used channels and carried loads; its noise and offsets are still to be set."""
    whole = state_space(system, record.spin)
    columns = [COMPONENTS.index(name) for name in record.components]
    # The anti-alias filter of a load that is not carried would have states of variance zero.
    carried = replace(whole, B=whole.B[:, columns], D=whole.D[:, columns])
    space = with_anti_alias(carried, geometry.acquisition)
    rows = [space.channel_names.index(name) for name in data_quality.names]
    used = replace(space, mixing=space.mixing[rows])
    return MeasuredSystem(used, tuple(range(len(columns))), step, np.ones(len(rows)), np.zeros(len(whole.delay)))


def _with_exact_means(record: RotorRecord) -> RotorRecord:
    """Return the record with its means taken as exact: the filter follows in time what scatters about them."""
    covariance = record.spectra.covariance.copy()
    covariance[0] *= NEGLIGIBLE_FACTOR
    return replace(record, spectra=replace(record.spectra, covariance=covariance))


def _channel_means(setup: _RunSetup) -> Array:
    """Return the means (c,) [V] of the channels in the steady part, by regression on azimuth where that has them."""
    spectra, (first, last) = setup.record.spectra, (int(t / setup.system.step) for t in setup.interval)
    means = np.zeros(len(setup.data_quality.names))
    for i, name in enumerate(setup.data_quality.names):
        if name in spectra.names:
            means[i] = spectra.amplitude[0, spectra.names.index(name)].real
            continue
        parts = [(max(s.start, first), min(s.stop, last)) for s in setup.data_quality.segments if i in s.channels]
        samples = [read_channels(setup.run, [name], low, high) for low, high in parts if high > low]
        means[i] = np.concatenate(samples).mean()
    return means


def _build_filters(setup: _RunSetup, harmonic_result: RunLoads, options: TimeOptions) -> RunFilters:
    """Return the filters of the load model."""
    step_loads = np.nansum(np.abs(harmonic_result.amplitude), axis=0)  # a mean that is not measured is NaN
    clean_record, system, segments = setup.clean_record(), setup.system, setup.data_quality.segments
    space, columns, noise = system.space, system.columns, system.noise
    if options.load_model == HARMONICS:
        layers = fit_loads_between_harmonics(clean_record, space, columns, noise, setup.azimuth)
        oscillators = fit_drifting_harmonics(
            clean_record, space, columns, noise, setup.azimuth, options.harmonics, layers
        )
        return azimuth_locked_filters(system, layers, oscillators, step_loads, setup.azimuth, segments)
    layers = fit_random_loads(clean_record, space, columns, noise)
    if options.load_model == FREE:
        layers = uninformative_loads(layers)
    return time_invariant_filters(system, layers, step_loads, segments)


def _steady_estimates(setup: _RunSetup, harmonic_result: RunLoads, options: TimeOptions) -> Iterator[Estimates]:
    """Yield the estimates of the filters. Raises UserError where the channels do not tell loads from noise."""
    try:
        yield from _run_filters(setup, _build_filters(setup, harmonic_result, options), options)
    except np.linalg.LinAlgError as error:
        raise UserError(
            "no filter is steady: the channels do not distinguish the assumed loads from noise",
            setup.run.file,
            "channels",
            "Reduce the run by harmonics, or record the channels with finer steps",
        ) from error


def _run_filters(setup: _RunSetup, filters: RunFilters, options: TimeOptions) -> Iterator[Estimates]:
    beginning = round(INITIAL_STATE_TIME / setup.system.step)
    if options.smooth:
        return smoothed_estimates(setup.read, setup.data_quality.segments, filters, beginning)
    lag = round(options.lag / setup.system.step) or None
    return filtered_estimates(setup.read, setup.data_quality.segments, filters, beginning, lag)


def _recorder_settings(setup: _RunSetup, harmonic_result: RunLoads, options: TimeOptions) -> RecorderSettings:
    return RecorderSettings(
        run=setup.run.name,
        components=harmonic_result.components,
        # Where the mean is not measured, the history is the deviation from it.
        mean=np.nan_to_num(harmonic_result.amplitude[0].real),
        mean_sigma=np.nan_to_num(harmonic_result.sigma_cosine[0]),
        azimuth=setup.azimuth,
        step=setup.system.step,
        state_lead_time=setup.system.state_lead_time,
        max_harmonic=options.harmonics,
        revolutions=setup.revolutions,
        has_oscillators=options.load_model == HARMONICS,
    )
