"""Reduction in time: hub loads as functions of time by a Kalman filter or smoother, for runs that are not steady.

The channels' departures from their means over a steady part go through the filter; the means themselves go through the
static calibration, as in a reduction by harmonics. So both kinds of reduction share their mean loads, and differ in
what varies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run, excerpt, read_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identified_model import identified_system
from balance_cli.model.state_space import state_space, with_anti_alias
from balance_cli.reduction.harmonic_loads import RotorRecord, rotor_record
from balance_cli.reduction.kalman.amplitude_drift import drifting_harmonics
from balance_cli.reduction.kalman.augmented_model import MeasuredSystem
from balance_cli.reduction.kalman.data_quality import Soundness, sound_stretches
from balance_cli.reduction.kalman.filter_tuning import free_loads, loads_between_harmonics, random_loads
from balance_cli.reduction.kalman.filtering import filtered, lagged
from balance_cli.reduction.kalman.innovations import InnovationSums, InnovationTests
from balance_cli.reduction.kalman.load_history import History, LoadTrack
from balance_cli.reduction.kalman.load_recorder import LoadRecorder, TrackFrame
from balance_cli.reduction.kalman.run_filters import azimuth_locked_filters, still_filters
from balance_cli.reduction.kalman.segments import Estimates, Filters
from balance_cli.reduction.kalman.smoothing import smoothed
from balance_cli.reduction.mean_loads import ZeroRecord
from balance_cli.reduction.response_sources import ModelSource
from balance_cli.reduction.result import RunLoads
from balance_cli.signals.azimuth import Azimuth, azimuth_from_pulses
from balance_cli.signals.channel_noise import Clean, channel_noise
from balance_cli.steps.reduce import reduced_record

Array = NDArray[np.float64]

LOAD_MODELS = ("harmonics", "random", "free")
BEGINNING = 5.0
"""Time [s] of a record that tells the state with which it began."""
NEXT_TO_NOTHING = 1e-6


@dataclass(frozen=True)
class TimeOptions:
    """`smooth` the whole record, or filter it and look back `lag` [s] later; what is known of the loads; harmonics.

    A load shows in cells and behind the anti-alias filter some milliseconds late, so that a filter without any lag has
    to foretell it.
    """

    smooth: bool = True
    loads: str = "harmonics"
    lag: float = 0.05
    harmonics: int = 8


@dataclass(frozen=True)
class TimeReduction:
    """Loads of one run, amplitudes from revolution to revolution where oscillators follow them, tests of the filter.

    `noise` {channel: standard deviation of a sample's noise, V}; `bridged`: what was missing, in words.
    """

    loads: RunLoads
    track: LoadTrack | None
    innovations: InnovationTests | None
    noise: dict[str, float]
    bridged: tuple[str, ...]


@dataclass(frozen=True)
class _Case:
    """One run on its way: the steady part of it (from `start` [s] on), what is sound, how its channels read the loads.

    `mean` (c,) [V]: what the channels' departures count from.
    """

    run: Run
    sound: Soundness
    record: RotorRecord
    start: float
    azimuth: Azimuth
    system: MeasuredSystem
    mean: Array

    @property
    def interval(self) -> tuple[float, float]:
        """The steady part [s], from the first sample of the whole run."""
        first, last = self.record.spectra.interval
        return self.start + first, self.start + last

    @property
    def revolutions(self) -> tuple[int, int]:
        """Whole revolutions of the whole run in the steady part."""
        first, last = self.azimuth.count_beyond(np.array(self.interval))
        return int(np.ceil(first - 1e-6)), int(np.floor(last + 1e-6))

    def clean(self) -> Clean:
        """Sound stretches of the steady part."""
        first = int(np.ceil(self.interval[0] / self.system.step))
        spans = tuple((max(start, first), stop) for start, stop in self.sound.spans if stop > first)
        return Clean(self.run, self.sound.names, spans)

    def read(self, start: int, stop: int, channels: tuple[int, ...]) -> Array:
        """Departures from the mean in units of the noise."""
        names = [self.sound.names[i] for i in channels]
        y = read_channels(self.run, names, start, stop) - self.mean[list(channels)]
        return np.asarray(y / np.sqrt(self.system.noise[list(channels)]))


def reduce_run_in_time(
    run: Run,
    geometry: Geometry,
    calibration: Calibration,
    source: ModelSource,
    zero: ZeroRecord | None = None,
    options: TimeOptions | None = None,
    sink: Callable[[History], None] | None = None,
) -> TimeReduction:
    """Hub loads of one `check` or `wind` run by a Kalman filter or smoother; `sink` takes the history, block by block.

    Raises UserError where the pulses or channels do not serve, or a gap is too long.
    """
    options = options or TimeOptions()
    case = _case(run, geometry, source, options)
    steady = reduced_record(_without_scatter(case.record), geometry, calibration, source, zero)
    recorder = LoadRecorder(_frame(case, steady, options), sink)
    sums = InnovationSums(len(case.sound.names))
    for estimates in _estimates(case, _filters(case, steady, options), options):
        recorder.add(estimates)
        if len(estimates.channels) == len(case.sound.names):
            sums.add(estimates.innovations)
    loads = reduced_record(case.record, geometry, calibration, source, zero, recorder.mean_amplitudes()[1:])
    notes = (*case.azimuth.notes, *case.sound.notes, *loads.notes[len(case.record.azimuth.notes) :])
    return TimeReduction(
        loads=replace(loads, interval=case.interval, notes=notes),
        track=recorder.track(),
        innovations=sums.tests(case.sound.names),
        noise=dict(zip(case.sound.names, np.sqrt(case.system.noise).tolist(), strict=True)),
        bridged=case.sound.notes,
    )


def _case(run: Run, geometry: Geometry, source: ModelSource, options: TimeOptions) -> _Case:
    """The run with its steady part, means and noise."""
    sound = sound_stretches(run, geometry, live_channels(run, geometry), 0, run.samples)
    record, start = _steady_record(run, geometry, source, sound, options.harmonics)
    if not sound.gaps and set(sound.names) == set(record.health.live):
        run = record.run  # without what forces along the cells that are not linear did to its channels
    if run.pulse_times is None or run.sample_rate is None:
        raise AssertionError("a record on azimuth has pulses")
    system = _measured_system(source, geometry, sound, record, 1.0 / run.sample_rate)
    case = _Case(run, sound, record, start, azimuth_from_pulses(run.pulse_times), system, np.zeros(len(sound.names)))
    noise, mean = channel_noise(case.clean(), geometry.acquisition), _means(case)
    passing = {channel.name: channel.measures_dc for channel in geometry.channels}
    blocked = np.array([not passing[name] for name in sound.names])
    offset = np.zeros(len(system.space.channel_names))
    rows = [system.space.channel_names.index(name) for name in sound.names]
    offset[rows] = np.where(blocked, np.abs(mean) + 10.0 * np.sqrt(noise), 0.0)
    return replace(case, system=replace(system, noise=noise, offset=offset), mean=np.where(blocked, 0.0, mean))


def _steady_record(
    run: Run, geometry: Geometry, source: ModelSource, sound: Soundness, highest: int
) -> tuple[RotorRecord, float]:
    """The record on azimuth, of the longest part without a gap, and the time [s] at which that begins."""
    if not sound.gaps:
        return rotor_record(run, geometry, source, highest), 0.0
    edges = [0, *(edge for gap in sound.gaps for edge in (gap.start, gap.stop)), run.samples]
    start, stop = max(zip(edges[::2], edges[1::2], strict=True), key=lambda part: part[1] - part[0])
    assert run.sample_rate is not None
    return rotor_record(excerpt(run, start, stop), geometry, source, highest), start / run.sample_rate


def _measured_system(
    source: ModelSource, geometry: Geometry, sound: Soundness, record: RotorRecord, step: float
) -> MeasuredSystem:
    """The model in time, of the channels used and the loads that the balance carries; its noise is set later."""
    whole = state_space(identified_system(source.model), record.spin)
    columns = [COMPONENTS.index(name) for name in record.components]
    # The filter before a load that is not carried would have states that nothing drives, of no size.
    carried = replace(whole, B=whole.B[:, columns], D=whole.D[:, columns])
    space = with_anti_alias(carried, geometry.acquisition)
    rows = [space.channel_names.index(name) for name in sound.names]
    used = replace(space, mixing=space.mixing[rows])
    return MeasuredSystem(used, tuple(range(len(columns))), step, np.ones(len(rows)), np.zeros(len(whole.delay)))


def _without_scatter(record: RotorRecord) -> RotorRecord:
    """The record, its means taken as exact: what scatters about them is followed in time, and is no error of theirs."""
    covariance = record.spectra.covariance.copy()
    covariance[0] *= NEXT_TO_NOTHING
    return replace(record, spectra=replace(record.spectra, covariance=covariance))


def _means(case: _Case) -> Array:
    """Means (c,) of the channels in the steady part: of the regression on azimuth, or of what is sound."""
    spectra, (first, last) = case.record.spectra, (int(t / case.system.step) for t in case.interval)
    means = np.zeros(len(case.sound.names))
    for i, name in enumerate(case.sound.names):
        if name in spectra.names:
            means[i] = spectra.amplitude[0, spectra.names.index(name)].real
            continue
        parts = [(max(s.start, first), min(s.stop, last)) for s in case.sound.stretches if i in s.channels]
        samples = [read_channels(case.run, [name], low, high) for low, high in parts if high > low]
        means[i] = np.concatenate(samples).mean()
    return means


def _filters(case: _Case, steady: RunLoads, options: TimeOptions) -> Filters:
    """The filters for what is known of the loads."""
    held = np.abs(steady.amplitude).sum(axis=0)
    clean, system, stretches = case.clean(), case.system, case.sound.stretches
    space, columns, noise = system.space, system.columns, system.noise
    if options.loads == "harmonics":
        between = loads_between_harmonics(clean, space, columns, noise, case.azimuth)
        turning = drifting_harmonics(clean, space, columns, noise, case.azimuth, options.harmonics, between)
        return azimuth_locked_filters(system, between, turning, held, case.azimuth, stretches)
    random = random_loads(clean, space, columns, noise)
    if options.loads == "random":
        return still_filters(system, random, held, stretches)
    return still_filters(system, free_loads(random), held, stretches)


def _estimates(case: _Case, filters: Filters, options: TimeOptions) -> Iterator[Estimates]:
    beginning = round(BEGINNING / case.system.step)
    if options.smooth:
        return smoothed(case.read, case.sound.stretches, filters, beginning)
    lag = round(options.lag / case.system.step)
    if lag:
        return lagged(case.read, case.sound.stretches, filters, beginning, lag)
    return filtered(case.read, case.sound.stretches, filters, beginning)


def _frame(case: _Case, steady: RunLoads, options: TimeOptions) -> TrackFrame:
    return TrackFrame(
        run=case.run.name,
        components=steady.components,
        mean=steady.amplitude[0].real,
        mean_sigma=steady.sigma_cosine[0],
        azimuth=case.azimuth,
        step=case.system.step,
        ahead=case.system.ahead,
        highest=options.harmonics,
        revolutions=case.revolutions,
        pairs=options.loads == "harmonics",
    )
