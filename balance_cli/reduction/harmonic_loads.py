"""The dynamic part of a reduction: harmonics 1 to n of the hub loads, by a response alone, without a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import ChannelHealth, live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.plate import carried_components
from balance_cli.reduction.response_sources import ModelSource, ResponseSource, circular_real, load_scale, stacked_real
from balance_cli.reduction.weighted_least_squares import SolvedLoads, solve_loads
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.channel_noise import CleanRecord, channel_noise
from balance_cli.signals.rotor.azimuth import Azimuth, azimuth_from_pulses
from balance_cli.signals.rotor.harmonic_spectrum import harmonic_lines
from balance_cli.signals.rotor.harmonics import FEWEST_REVOLUTIONS, Harmonics, estimate_harmonics
from balance_cli.signals.transient_end import transient_end

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Start transients have decayed to a thousandth after seven time constants.
TRANSIENT_TIME_CONSTANTS = 7.0
# Nor is less looked through than this [s]: a response may not know the slowest mode, and piezo channels forget slowly.
MIN_TRANSIENT_TIME = 10.0
# Time constants over which the past of the rotor's speed still counts.
SPEED_MEMORY = 3.0
# A response is refused as singular where the channels tell two loads apart worse than this.
LARGEST_CONDITION = 1e8


@dataclass(frozen=True)
class RotorRecord:
    """A record on azimuth: its usable channels, and the harmonics of these and of the loads once it has settled.

    `components` are those that the balance carries.
    """

    run: Run
    health: ChannelHealth
    azimuth: Azimuth
    spectra: Harmonics
    components: tuple[str, ...]

    @property
    def spin(self) -> float:
        """Speed [Hz] of the rotor over the interval; 0 where it stands still."""
        return self.run.rotor_speed and float(self.spectra.frequency_hz[1])


def rotor_record(run: Run, geometry: Geometry, source: ResponseSource, max_harmonic: int = 8) -> RotorRecord:
    """Harmonics 0 to `highest` of one `check` or `wind` run, from where its start transient has gone.

    Raises UserError where no channel is left, or the pulses do not serve.
    """
    health = live_channels(run, geometry)
    if not health.live:
        raise UserError("no channel is left", _place(run), "channels", "Mend the channels, or leave the run out")
    azimuth = _azimuth(run)
    if azimuth.turns < FEWEST_REVOLUTIONS:
        fault = f"holds {azimuth.turns} revolutions; at least {FEWEST_REVOLUTIONS} are needed"
        raise UserError(fault, _place(run), "rotor/pulse_times", "Record for longer")
    if isinstance(source, ModelSource):
        run = source.remove_nonlinear_contribution(run, health.live)
    limit = max(TRANSIENT_TIME_CONSTANTS * source.slowest_decay, MIN_TRANSIENT_TIME)
    start = transient_end(run, azimuth, limit, health.live)
    signals = health.live + (COMPONENTS if run.has_loads else ())
    spectra = estimate_harmonics(run, azimuth, max_harmonic, names=signals, first_revolution=start.first_revolution)
    return RotorRecord(run, health, azimuth, spectra, carried_components(geometry))


def _place(run: Run) -> str:
    return str(run.path or run.name)


def _azimuth(run: Run) -> Azimuth:
    if run.pulse_times is None:
        raise UserError("no 1/rev pulses", _place(run), "rotor/pulse_times", "Reduce runs of kind check or wind")
    return azimuth_from_pulses(run.pulse_times)


def harmonic_loads(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> SolvedLoads:
    """Harmonics 1 to n: the anti-alias filter taken out, then the response, weighted by noise.

    Raises UserError where the channels that remain do not determine the loads.
    """
    spectra, health = record.spectra, record.health
    frequency = spectra.frequency_hz[1:]
    channel_combination = source.channel_combination(frequency, health.live)
    columns = [COMPONENTS.index(name) for name in record.components]
    T = harmonic_response(record, geometry, source)[:, channel_combination.rows][:, :, columns]
    _check_determined(T, record)
    mine = spectra.columns(health.live)
    combination = channel_combination.combination / anti_alias_response(geometry.acquisition, frequency)[:, None, None]
    y = np.einsum("hrc,hc->hr", combination, spectra.amplitude[1:, mine])
    noise = combination @ spectra.covariance[1:][:, mine][:, :, mine] @ combination.conj().swapaxes(1, 2)
    count = source.at(frequency[:1], record.spin).shape[1]
    real_rows = np.array([*channel_combination.rows, *(row + count for row in channel_combination.rows)])

    def response_covariance(loads: Array) -> Array:
        six = np.zeros((len(loads), 6), complex)
        six[:, columns] = loads[:, : len(columns)] + 1j * loads[:, len(columns) :]
        return source.covariance(frequency, record.spin, six)[:, real_rows[:, None], real_rows]

    scale = np.tile(load_scale(geometry.hub)[columns], 2)
    stacked = np.concatenate([y.real, y.imag], axis=1)
    sample = np.diag(_channel_noise(record, geometry)).astype(complex)
    weighting_covariance = circular_real(combination @ sample @ combination.conj().swapaxes(1, 2))
    return solve_loads(
        stacked_real(T),
        stacked,
        circular_real(noise),
        spectra.dof[1:],
        response_covariance,
        1.0 / scale,
        weighting_covariance,
    )


def _channel_noise(record: RotorRecord, geometry: Geometry) -> Array:
    """Variance (c,) of a sample of each live channel's own noise, in the interval of the harmonics."""
    assert record.run.sample_rate is not None
    start, stop = (int(t * record.run.sample_rate) for t in record.spectra.interval)
    return channel_noise(CleanRecord(record.run, record.health.live, ((start, stop),)), geometry.acquisition)


def harmonic_response(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> ComplexArray:
    """T (n, rows, 6) that each harmonic meets: averaged over its own spectrum, the filter's change there included."""
    azimuth, spectra = record.azimuth, record.spectra
    orders = range(1, len(spectra.frequency_hz))
    lines = [harmonic_lines(azimuth, spectra, n, SPEED_MEMORY * source.slowest_decay) for n in orders]
    at = source.at(np.concatenate([item.frequency for item in lines]), record.spin)
    parts = np.split(at, np.cumsum([len(item.frequency) for item in lines])[:-1])
    averages = []
    for item, value, centre in zip(lines, parts, spectra.frequency_hz[1:], strict=True):
        H = anti_alias_response(geometry.acquisition, item.frequency) / anti_alias_response(
            geometry.acquisition, centre
        )
        averages.append(np.einsum("g,grj->rj", item.weight * H, value))
    return np.stack(averages)


def _check_determined(T: ComplexArray, record: RotorRecord) -> None:
    """UserError unless every component drives the remaining channels in a way of its own."""
    size = np.linalg.norm(T, axis=1, keepdims=True)
    lost = [name for name, norm in zip(record.components, size[0, 0], strict=True) if norm == 0]
    enough = not lost and T.shape[1] >= T.shape[2]
    if enough and bool(np.all(np.linalg.cond(T / size) < LARGEST_CONDITION)):
        return
    names = "; ".join(f"{name}: {reason}" for name, reason in record.health.left_out.items()) or "none"
    what = ", ".join(lost) or ", ".join(record.components)
    raise UserError(
        f"the remaining channels do not determine {what} (left out: {names})",
        _place(record.run),
        "channels",
        "Mend the channels, or leave the run out with --skip-bad",
    )
