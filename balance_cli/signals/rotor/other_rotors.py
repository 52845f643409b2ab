"""Lines of the other rotors of a record: fitted together with the harmonics of one rotor, and taken out of the record.

What is left is the record of a single rotor, for which everything that follows is made: amplitudes, noise, tests.
Amplitudes of the reference rotor after the lines are removed are those of the joint regression. Two harmonics of
different rotors that run side by side, within a cycle or so over the record, cannot be told apart; they stay in the
record, and are named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, SampleBlock, SampleSource
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.azimuth import Azimuth, azimuth_from_pulses, with_stated_error
from balance_cli.signals.rotor.edge_weight import edge_weight
from balance_cli.signals.rotor.harmonics import BELOW_NYQUIST, FITTED_HARMONICS
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]

LEAST_SEPARATION = 1.5
"""Cycles by which two lines must part over the record to be told apart: the bins of a record are one cycle wide, and
the weight at its ends makes them a little wider."""
UNCOVERED_TURNS = 3.0
"""Turns of another rotor outside its pulses over which its azimuth is extrapolated, at constant speed."""
MODULATED_SEPARATION = 8.0
"""Cycles by which a line must part from the others for its amplitude to be fitted as a function of speed, too."""
LEAST_SPEED_CHANGE = 1e-4
"""Relative change of the speed from which amplitudes may follow it."""
SEPARATION_POINTS = 512
BLOCK = 8192
"""Samples in a block: a basis of 100 columns then takes 7 MB."""


@dataclass(frozen=True)
class ConfoundedLine:
    """Harmonic `order` of the reference rotor, beside which harmonic `other_order` of rotor `rotor` runs, at [Hz]."""

    order: int
    rotor: int
    other_order: int
    frequency: float

    @property
    def description(self) -> str:
        """The two lines in words."""
        return (
            f"{self.order}/rev cannot be told from {self.other_order}/rev of rotor {self.rotor}, "
            f"both at {self.frequency:.2f} Hz"
        )


@dataclass(frozen=True)
class RotorLines:
    """Harmonics `orders` of rotor `rotor`, whose azimuth is `azimuth`.

    The amplitudes of the `modulated` ones are parabolas of its speed, as they are beside a resonance.
    """

    rotor: int
    azimuth: Azimuth
    orders: tuple[int, ...]
    modulated: tuple[int, ...] = ()

    @property
    def columns(self) -> int:
        """The number of columns of the basis."""
        return 2 * len(self.orders) + 4 * len(self.modulated)

    def basis(self, time: Array) -> Array:
        """Return cosines and sines (m, columns) at `time` (m,) [s]."""
        count = self.azimuth.extrapolated_count(time)
        speed = self.azimuth.speed(np.clip(time, self.azimuth.first, self.azimuth.last))
        change = (speed / self.azimuth.mean_rate - 1.0)[:, None] / self._speed_change
        constant, modulated = (2.0 * np.pi * np.outer(count, orders) for orders in (self.orders, self.modulated))
        turning = np.hstack([np.cos(modulated), np.sin(modulated)])
        return np.hstack([np.cos(constant), np.sin(constant), change * turning, change**2 * turning])

    @property
    def _speed_change(self) -> float:
        """The largest relative change of the speed, which scales the parabolas."""
        return max(relative_speed_change(self.azimuth), LEAST_SPEED_CHANGE)


def relative_speed_change(azimuth: Azimuth) -> float:
    """Return the largest deviation of the speed from its mean, relative to the mean."""
    speed = azimuth.speed(np.linspace(azimuth.first, azimuth.last, SEPARATION_POINTS))
    return float(np.abs(speed / azimuth.mean_rate - 1.0).max())


@dataclass(frozen=True)
class LinesRemoved:
    """Samples of a run without lines of amplitude `coefficients` (columns, channels and loads)."""

    parent: SampleSource
    rate: float
    lines: tuple[RotorLines, ...]
    coefficients: Array

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        block = self.parent.read(start, stop)
        time = (start + np.arange(len(block.channels))) / self.rate
        removed = _joint_basis(self.lines, time) @ self.coefficients
        count = block.channels.shape[1]
        loads = None if block.loads is None else block.loads - removed[:, count:]
        return SampleBlock(start, block.channels - removed[:, :count], loads)


def rotor_azimuth(run: Run, rotor: int) -> Azimuth:
    """Return the azimuth of rotor 1, 2 and so on of a run. Raises UserError where its pulses are absent or unusable.

    Pulses after the last sample are left out, and a note says so: of the revolutions up to them there are no samples.
    """
    place = "rotor/pulse_times" if rotor == 1 else f"rotor{rotor}/pulse_times"
    pulses = rotor_pulses(run)
    times = pulses[rotor - 1] if rotor <= len(pulses) else None
    file = run.file
    if times is None:
        remedy = "Reduce it with --frequencies or --band, or record the pulses"
        raise UserError("no 1/rev pulses", file, place, remedy)
    end = run.samples / sample_rate(run)
    try:
        azimuth = azimuth_from_pulses(times[times <= end])
    except UserError as error:
        raise UserError(error.fault, error.file, place, error.remedy) from error
    if rotor == 1 and run.additions is not None and run.additions.azimuth_error_deg:
        azimuth = with_stated_error(azimuth, float(np.radians(run.additions.azimuth_error_deg)))
    beyond = int(np.count_nonzero(times > end))
    note = f"{beyond} pulse{'s'[: beyond > 1]} after the end of the record at {end:.6g} s left out: were samples lost?"
    return replace(azimuth, notes=(*azimuth.notes, note)) if beyond else azimuth


def rotor_pulses(run: Run) -> tuple[Array | None, ...]:
    """Return the pulse times [s] of each rotor of a run, the first one first."""
    return (run.pulse_times, *(() if run.additions is None else run.additions.further_pulse_times))


def other_azimuths(run: Run, rotor: int) -> tuple[Azimuth, ...]:
    """Return the azimuths of all rotors of a run but `rotor`."""
    return tuple(rotor_azimuth(run, number) for number in _other_rotors(run, rotor))


def _other_rotors(run: Run, rotor: int) -> list[int]:
    pulses = enumerate(rotor_pulses(run), 1)
    return [number for number, times in pulses if times is not None and number != rotor]


def without_other_rotors(
    run: Run, azimuth: Azimuth, rotor: int, n: int, first_revolution: int
) -> tuple[Run, tuple[ConfoundedLine, ...]]:
    """Return the run without the lines of all rotors but `rotor`, and what cannot be told from its harmonics 1 to `n`.

    `azimuth` is that of `rotor`; the lines are fitted from `first_revolution` of it on. The same run where there is no
    other rotor. Raises UserError where the pulses of another rotor do not cover the record.
    """
    others = _other_rotors(run, rotor)
    if not others:
        return run, ()
    start = float(azimuth.time_of(np.array(first_revolution)))
    lines, confounded = [], []
    for number in others:
        other = rotor_azimuth(run, number)
        _require_coverage(run, other, number, start, azimuth.last)
        own, common = _separable_lines(run, azimuth, other, number, start)
        lines.append(own)
        confounded += [line for line in common if line.order <= n]
    coefficients = _fit_lines(run, azimuth, tuple(lines), first_revolution)
    source = LinesRemoved(run.source, sample_rate(run), tuple(lines), coefficients)
    return replace(run, source=source), tuple(confounded)


def _require_coverage(run: Run, other: Azimuth, number: int, start: float, end: float) -> None:
    margin = UNCOVERED_TURNS / other.mean_rate
    if other.first - start > margin or end - other.last > margin:
        fault = f"covers {other.first:.4g} to {other.last:.4g} s of the interval from {start:.4g} to {end:.4g} s"
        remedy = "Cut the record to the part in which all rotors have pulses"
        raise UserError(fault, run.file, f"rotor{number}/pulse_times", remedy)


def _highest_order(run: Run, azimuth: Azimuth) -> int:
    """Return the harmonics of a rotor that are fitted."""
    return min(FITTED_HARMONICS, int(BELOW_NYQUIST * sample_rate(run) / 2.0 / azimuth.mean_rate))


def _separable_lines(
    run: Run, azimuth: Azimuth, other: Azimuth, number: int, start: float
) -> tuple[RotorLines, list[ConfoundedLine]]:
    """Return the harmonics of another rotor that part from all of the reference rotor, and the pairs that do not."""
    time = np.linspace(start, azimuth.last, SEPARATION_POINTS)
    count, other_count = (item.extrapolated_count(time) for item in (azimuth, other))
    span, other_span = count[-1] - count[0], other_count[-1] - other_count[0]
    highest = _highest_order(run, azimuth)
    varies = relative_speed_change(other) > LEAST_SPEED_CHANGE
    orders, modulated, common = [], [], []
    for k in range(1, _highest_order(run, other) + 1):
        near = [n for n in (int(k * other_span / span), int(k * other_span / span) + 1) if 1 <= n <= highest]
        separation = {n: float(np.ptp(k * other_count - n * count)) for n in near}
        nearest = min(separation, key=lambda n: separation[n], default=0)
        if nearest and separation[nearest] < LEAST_SEPARATION:
            common.append(ConfoundedLine(nearest, number, k, float(nearest * span / (time[-1] - time[0]))))
            continue
        orders.append(k)
        if varies and (not nearest or separation[nearest] > MODULATED_SEPARATION):
            modulated.append(k)
    return RotorLines(number, other, tuple(orders), tuple(modulated)), common


def _joint_basis(lines: Sequence[RotorLines], time: Array) -> Array:
    return np.hstack([item.basis(time) for item in lines])


def _fit_lines(run: Run, azimuth: Azimuth, lines: tuple[RotorLines, ...], first_revolution: int) -> Array:
    """Return the amplitudes (columns, channels and loads) of the lines, from a regression with the harmonics."""
    reference = RotorLines(0, azimuth, tuple(range(1, _highest_order(run, azimuth) + 1)))
    start, end = (float(t) for t in azimuth.time_of(np.array([first_revolution, azimuth.turns])))
    low, high = int(np.ceil(start * sample_rate(run))), min(int(end * sample_rate(run)) + 1, run.samples)
    width = sum(item.columns for item in lines)
    columns = width + reference.columns + 1
    signals = len(run.channel_names) + (len(COMPONENTS) if run.has_loads else 0)
    gram, moment = np.zeros((columns, columns)), np.zeros((columns, signals))
    for begin in range(low, high, BLOCK):
        block = run.read(begin, min(begin + BLOCK, high))
        time = (begin + np.arange(len(block.channels))) / sample_rate(run)
        basis = np.hstack([_joint_basis(lines, time), reference.basis(time), np.ones((len(time), 1))])
        weight = edge_weight(azimuth.extrapolated_count(time), first_revolution, azimuth.turns)
        values = block.channels if block.loads is None else np.hstack([block.channels, block.loads])
        weighted = basis.T * weight
        gram += weighted @ basis
        # A channel that is not finite is left out by its own test; its lines are of no consequence.
        moment += weighted @ np.nan_to_num(values, posinf=0.0, neginf=0.0)
    return np.asarray(np.linalg.solve(gram, moment)[:width])
