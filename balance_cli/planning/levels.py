"""The largest levels of excitations that exciters, cells and channels can bear."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve
from balance_cli.planning.hall import Hall, RecordSettings, excitable_components, hit_period
from balance_cli.simulation.excitation import Power, half_sine_hits, line_power, multisine_lines
from balance_cli.simulation.plans import Component, ForcePoint
from balance_cli.simulation.statics import load_row

Array = NDArray[np.float64]

CREST_FACTOR = 4.0
"""Peak over rms of a signal of many lines with random phases: exceeded by one period of 600 lines in 25.

It is that of cells and channels, too: their resonances mix the phases of any excitation."""
LINES = 2000
"""Frequencies at which the response is summed for the level: several in the width of a mode of damping ratio 0.005."""
STATIC_SHARE = 1e-3
"""Frequency over the start of the band at which the response to mean loads is taken: far below every mode."""
HIT_SAMPLES = 16
"""Samples in the contact of a hit, on which its peak is sought."""
LONGEST_HIT_PERIOD = 2**16
"""Lines of the response to a hit, at most."""


@dataclass(frozen=True)
class LevelLimit:
    """The largest rms level [N, N m] of one component alone, and what limits it."""

    component: Component
    level: float
    reason: str


@dataclass(frozen=True)
class BandResponse:
    """Responses at frequencies of the band per unit load: `volts` (f, c, 6), cells' `forces` (f, cells, 6)."""

    frequency: Array
    volts: NDArray[np.complex128]
    forces: NDArray[np.complex128]


def band_response(geometry: Geometry, band: tuple[float, float], system: System) -> BandResponse:
    """The response of channels and cells over the band."""
    frequency = np.linspace(*band, LINES)
    solution = solve(system, frequency)
    return BandResponse(frequency, response(system, solution), solution.forces[:, : len(geometry.cells)])


def level_limits(
    geometry: Geometry,
    hall: Hall,
    settings: RecordSettings,
    system: System,
    powers: Mapping[Component, Power] | None = None,
    steady: Mapping[Component, float] | None = None,
) -> tuple[LevelLimit, ...]:
    """The largest level of each component that can be excited alone, and what limits it.

    `powers`: relative power of the lines of a component; `steady`: mean loads, which take their part of the ranges of
    the cells. Raises UserError where the mean loads alone are too much.
    """
    shown = band_response(geometry, settings.band, system)
    room = _room_of_cells(geometry, hall, settings, system, steady or {})
    powers = powers or {}
    return tuple(
        min(_limits_of(name, geometry, hall, settings, shown, room, powers.get(name)), key=lambda item: item.level)
        for name in excitable_components(geometry, hall)
    )


def _room_of_cells(
    geometry: Geometry, hall: Hall, settings: RecordSettings, system: System, steady: Mapping[Component, float]
) -> Array:
    """Force (cells,) that the sweeps may make in each cell, beside the mean loads."""
    room = hall.margin * np.array([cell.full_range for cell in geometry.cells])
    if not steady:
        return room
    loads = load_row(steady)
    solution = solve(system, np.array([STATIC_SHARE * settings.band[0]]))
    room = room - np.abs(np.real(solution.forces[0, : len(geometry.cells)]) @ loads)
    if room.min() <= 0:
        name = geometry.cells[int(np.argmin(room))].name
        fault = f"the mean loads take more than {100 * hall.margin:g} % of the range of cell {name}"
        raise UserError(fault, place="trims", remedy="Give smaller mean loads")
    return np.asarray(room)


def multisine_crest_factor(hall: Hall, settings: RecordSettings, power: Power | None) -> float:
    """The largest peak over rms of any excitation of a component that the hall can choose.

    That of a multisine with fixed phases is computed, for each band; with `power` it has one component to itself.
    """
    if hall.phases == "random" or set(hall.excitations) != {"multisine"}:
        return CREST_FACTOR
    rng = np.random.default_rng(0)  # not used by fixed phases
    counts = {1} if power else {1, min(hall.simultaneous, len(hall.exciters or COMPONENTS))}
    return max(
        multisine_lines(settings.period, band, 1.0, rng, count, shift, hall.phases, power).crest_factor
        for band in (settings.band, *hall.bands)
        for count in counts
        for shift in range(count)
    )


def _limits_of(
    name: Component,
    geometry: Geometry,
    hall: Hall,
    settings: RecordSettings,
    shown: BandResponse,
    room: Array,
    power: Power | None,
) -> Iterator[LevelLimit]:
    """Every limit of the level of one component."""
    column = COMPONENTS.index(name)
    share = line_power(shown.frequency, power)
    share = share / share.sum()
    exciter = hall.exciters[name] if hall.exciters else None
    if exciter is not None and exciter.rms is not None:
        yield LevelLimit(name, exciter.rms, "rms of the exciter")
    if exciter is not None and exciter.peak is not None:
        yield LevelLimit(name, exciter.peak / multisine_crest_factor(hall, settings, power), "peak of the exciter")
    forces = np.sqrt(share @ np.abs(shown.forces[:, :, column]) ** 2)
    for cell, force, left in zip(geometry.cells, forces, room, strict=True):
        most = left if exciter else min(left, hall.cell_share * cell.full_range)
        if force > 0:
            yield LevelLimit(name, most / (CREST_FACTOR * force), f"range of cell {cell.name}")
    volts = np.sqrt(share @ np.abs(shown.volts[:, :, column]) ** 2)
    for channel, volt in zip(geometry.channels, volts, strict=True):
        if channel.range is not None and volt > 0:
            limit = hall.margin * channel.range / (CREST_FACTOR * volt)
            yield LevelLimit(name, limit, f"range of channel {channel.name}")
    if exciter is None and any(meter.component == name for meter in geometry.shaft_meters):
        yield from _torque_limit(name, geometry, hall)


def _torque_limit(name: Component, geometry: Geometry, hall: Hall) -> Iterator[LevelLimit]:
    """The torque meter has no declared range: its rated load limits it, else the cells' range at the hub's height."""
    rated = (geometry.rated_loads or {}).get(name)
    reach = max(float(np.linalg.norm(np.asarray(cell.position)[:2])) for cell in geometry.cells)
    largest = rated if rated is not None else min(cell.full_range for cell in geometry.cells) * max(reach, 0.1)
    yield LevelLimit(name, hall.cell_share * largest / CREST_FACTOR, "range of the torque meter, taken from the cells")


def limit_spectra(name: Component, geometry: Geometry, shown: BandResponse, limit: LevelLimit) -> Array:
    """How much of what limits a component each frequency (f,) takes, per unit power there.

    One everywhere where an exciter limits the level; the squared response of the cell or channel that limits it else.
    """
    column = COMPONENTS.index(name)
    for i, cell in enumerate(geometry.cells):
        if limit.reason == f"range of cell {cell.name}":
            return np.asarray(np.abs(shown.forces[:, i, column]) ** 2)
    for i, channel in enumerate(geometry.channels):
        if limit.reason == f"range of channel {channel.name}":
            return np.asarray(np.abs(shown.volts[:, i, column]) ** 2)
    return np.ones(len(shown.frequency))


def hit_level(
    point: ForcePoint, geometry: Geometry, hall: Hall, settings: RecordSettings, contact: float, system: System
) -> float:
    """The rms level [N] of hits at a point: that of the largest peak that hammer, cells and channels can bear."""
    assert hall.hammer is not None
    step = contact / HIT_SAMPLES
    count = min(round(hit_period(hall, settings) / step), LONGEST_HIT_PERIOD)
    time = step * np.arange(count, dtype=float)
    wave = half_sine_hits(time, count * step, contact, 1.0, (0.25 / step, 0.5 / step))
    spectrum = np.fft.rfft(wave)
    used = np.fft.rfftfreq(count, step) <= settings.band[1]
    frequency = np.asarray(np.fft.rfftfreq(count, step)[used], float)
    frequency[0] = STATIC_SHARE * settings.band[0]
    solution = solve(system, frequency)
    wrench = point.wrench(geometry.hub)
    limits = [hall.hammer.peak / float(np.abs(wave).max())]
    signals = (solution.forces[:, : len(geometry.cells)], response(system, solution))
    ranges = ([cell.full_range for cell in geometry.cells], [item.range or np.inf for item in geometry.channels])
    for signal, largest in zip(signals, ranges, strict=True):
        padded = np.zeros((len(spectrum), signal.shape[1]), complex)
        padded[used] = (signal @ wrench) * spectrum[used, None]
        peak = np.abs(np.fft.irfft(padded, count, axis=0)).max(axis=0)
        limits += [hall.margin * full / value for full, value in zip(largest, peak, strict=True) if value > 0]
    # The rms of one hit in `hit_period`, where the lines above are those of a shorter time.
    return float(min(limits) * np.sqrt(count * step / hit_period(hall, settings)))
