"""Reduction: rotor-harmonic hub loads of a run from its channels, the response and the static calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibrated import Calibration
from balance_cli.channel_health import ChannelHealth, live_channels
from balance_cli.check_errors import check_errors
from balance_cli.components import COMPONENTS
from balance_cli.errors import UserError
from balance_cli.estimation.hub_loads import SolvedLoads, solve_loads
from balance_cli.geometry import Geometry
from balance_cli.hub_loads import RunLoads
from balance_cli.model.plate import carried_components
from balance_cli.responses import ModelSource, ResponseSource, circular_real, load_scale, stacked_real
from balance_cli.runs import Run
from balance_cli.signals.anti_alias import anti_alias
from balance_cli.signals.azimuth import Azimuth, azimuth_from_pulses
from balance_cli.signals.harmonic_spectrum import harmonic_lines
from balance_cli.signals.harmonics import FEWEST_REVOLUTIONS, Harmonics, harmonics
from balance_cli.signals.settling import settling
from balance_cli.steady_loads import SteadyLoads, ZeroRecord, steady_loads

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Start transients have decayed to a thousandth after seven time constants.
TIME_CONSTANTS = 7.0
# Nor is less looked through than this [s]: a response may not know the slowest mode, and piezo channels forget slowly.
LEAST_LIMIT = 10.0
# Time constants over which the past of the rotor's speed still counts.
MEMORY = 3.0
# A response is refused as singular where the channels tell two loads apart worse than this.
LARGEST_CONDITION = 1e8


@dataclass(frozen=True)
class ReduceOptions:
    """Harmonics 0 to `harmonics` are reduced."""

    harmonics: int = 8


def reduce_run(
    run: Run,
    geometry: Geometry,
    calibration: Calibration,
    source: ResponseSource,
    zero: ZeroRecord | None = None,
    options: ReduceOptions | None = None,
) -> RunLoads:
    """Hub loads of one `check` or `wind` run.

    Raises UserError where the pulses or the channels that remain do not determine the loads.
    """
    options = options or ReduceOptions()
    health = live_channels(run, geometry)
    if not health.live:
        raise UserError("no channel is left", _place(run), "channels", "Mend the channels, or leave the run out")
    azimuth = _azimuth(run)
    if azimuth.turns < FEWEST_REVOLUTIONS:
        fault = f"holds {azimuth.turns} revolutions; at least {FEWEST_REVOLUTIONS} are needed"
        raise UserError(fault, _place(run), "rotor/pulse_times", "Record for longer")
    if isinstance(source, ModelSource):
        run = source.linear_part(run, health.live)
    limit = max(TIME_CONSTANTS * source.slowest_decay, LEAST_LIMIT)
    start = settling(run, azimuth, limit, health.live)
    signals = _signals(run, health)
    spectra = harmonics(run, azimuth, options.harmonics, names=signals, first_revolution=start.first_revolution)
    components = carried_components(geometry)
    steady = steady_loads(spectra, calibration, health, zero)
    dynamic = _dynamic_loads(run, spectra, azimuth, geometry, source, health, components)
    return _joined(run, spectra, steady, dynamic, source, health, azimuth, geometry)


def _place(run: Run) -> str:
    return str(run.path or run.name)


def _azimuth(run: Run) -> Azimuth:
    if run.pulse_times is None:
        raise UserError("no 1/rev pulses", _place(run), "rotor/pulse_times", "Reduce runs of kind check or wind")
    return azimuth_from_pulses(run.pulse_times)


def _signals(run: Run, health: ChannelHealth) -> tuple[str, ...]:
    return health.live + (COMPONENTS if run.has_loads else ())


def _dynamic_loads(
    run: Run,
    spectra: Harmonics,
    azimuth: Azimuth,
    geometry: Geometry,
    source: ResponseSource,
    health: ChannelHealth,
    components: tuple[str, ...],
) -> SolvedLoads:
    """Harmonics 1 to n: the anti-alias filter taken out, then the response, weighted by noise."""
    frequency = spectra.frequency_hz[1:]
    spin = run.rotor_speed and float(spectra.frequency_hz[1])
    readings = source.readings(frequency, health.live)
    columns = [COMPONENTS.index(name) for name in components]
    T = _response_of_harmonics(source, spectra, azimuth, geometry, spin)[:, readings.rows][:, :, columns]
    _check_determined(run, T, components, health)
    mine = spectra.columns(health.live)
    combination = readings.combination / anti_alias(geometry.acquisition, frequency)[:, None, None]
    y = np.einsum("hrc,hc->hr", combination, spectra.amplitude[1:, mine])
    noise = combination @ spectra.covariance[1:][:, mine][:, :, mine] @ combination.conj().swapaxes(1, 2)
    count = source.at(frequency[:1], spin).shape[1]
    real_rows = np.array([*readings.rows, *(row + count for row in readings.rows)])

    def response_covariance(loads: Array) -> Array:
        six = np.zeros((len(loads), 6), complex)
        six[:, columns] = loads[:, : len(columns)] + 1j * loads[:, len(columns) :]
        return source.covariance(frequency, spin, six)[:, real_rows[:, None], real_rows]

    scale = np.tile(load_scale(geometry.hub)[columns], 2)
    stacked = np.concatenate([y.real, y.imag], axis=1)
    return solve_loads(
        stacked_real(T), stacked, circular_real(noise), spectra.dof[1:], response_covariance, 1.0 / scale
    )


def _response_of_harmonics(
    source: ResponseSource, spectra: Harmonics, azimuth: Azimuth, geometry: Geometry, spin: float
) -> ComplexArray:
    """T (n, rows, 6) that each harmonic meets: averaged over its own spectrum, the filter's change there included."""
    orders = range(1, len(spectra.frequency_hz))
    lines = [harmonic_lines(azimuth, spectra, n, MEMORY * source.slowest_decay) for n in orders]
    at = source.at(np.concatenate([item.frequency for item in lines]), spin)
    parts = np.split(at, np.cumsum([len(item.frequency) for item in lines])[:-1])
    averages = []
    for item, value, centre in zip(lines, parts, spectra.frequency_hz[1:], strict=True):
        H = anti_alias(geometry.acquisition, item.frequency) / anti_alias(geometry.acquisition, centre)
        averages.append(np.einsum("g,grj->rj", item.weight * H, value))
    return np.stack(averages)


def _check_determined(run: Run, T: ComplexArray, components: tuple[str, ...], health: ChannelHealth) -> None:
    """UserError unless every component drives the remaining channels in a way of its own."""
    size = np.linalg.norm(T, axis=1, keepdims=True)
    lost = [name for name, norm in zip(components, size[0, 0], strict=True) if norm == 0]
    enough = not lost and T.shape[1] >= T.shape[2]
    if enough and bool(np.all(np.linalg.cond(T / size) < LARGEST_CONDITION)):
        return
    names = "; ".join(f"{name}: {reason}" for name, reason in health.left_out.items()) or "none"
    what = ", ".join(lost) or ", ".join(components)
    raise UserError(
        f"the remaining channels do not determine {what} (left out: {names})",
        str(run.path or run.name),
        "channels",
        "Mend the channels, or leave the run out with --skip-bad",
    )


def _joined(
    run: Run,
    spectra: Harmonics,
    steady: SteadyLoads,
    dynamic: SolvedLoads,
    source: ResponseSource,
    health: ChannelHealth,
    azimuth: Azimuth,
    geometry: Geometry,
) -> RunLoads:
    m = len(steady.components)
    variance = np.diagonal(dynamic.widened, axis1=1, axis2=2)
    words = np.where(dynamic.misfit, "redundancy", "")
    result = RunLoads(
        run=run.name,
        kind=run.kind,
        response=source.description,
        trim=steady.trim,
        components=steady.components,
        frequency_hz=np.asarray(np.arange(len(spectra.frequency_hz)) * azimuth.mean_rate, float),
        amplitude=np.concatenate([steady.loads[None, :].astype(complex), dynamic.loads]),
        sigma_cosine=np.concatenate([steady.sigma[None, :], np.sqrt(variance[:, :m])]),
        sigma_sine=np.concatenate([np.zeros((1, m)), np.sqrt(variance[:, m:])]),
        flags=(tuple([steady.flag] * m), *(tuple([str(word)] * m) for word in words)),
        redundancy=np.concatenate([[steady.redundancy], dynamic.surplus]),
        redundancy_limit=np.concatenate([[steady.redundancy_limit], dynamic.limit]),
        condition=np.concatenate([[steady.condition], dynamic.condition]),
        left_out=health.left_out,
        interval=spectra.interval,
        notes=azimuth.notes,
    )
    if not run.has_loads or run.kind != "check":
        return result
    return replace(result, check=check_errors(spectra, dynamic, result, geometry))
