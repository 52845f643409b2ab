"""Pick-up of the mains, whose phase is unknown in every run.

A tone a cos(2 pi f t + phi) adds a C (cos phi, sin phi)' to the lines of a run. With B the form of the likelihood (free
motion eliminated), b = B(C, r) and B(C, C) = n I, chi-square averaged over all phases is

    chi2(r) + a^2 n - 2 ln I0(a |b|)

(Rice's distribution; Helstrom, Statistical Theory of Signal Detection, 1968, chapter V). Its derivatives by all other
parameters are those at the expected tone, m = a I1/I0(a |b|) b/|b| in the place of a (cos phi, sin phi). In a^2 it is
regular at zero, where the gradient has the mean zero that a score must have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.transients import RunTransient
from balance_cli.model.mechanics.equations import InterferenceTone
from balance_cli.model.system import System
from balance_cli.signals.run_spectrum import RecordWaveform, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
WeightFunction = Callable[[slice, ComplexArray], ComplexArray]

# Half the phase over a record below which a sum of its phasors is expanded in it.
SMALL_PHASE = 1e-3


@dataclass(frozen=True)
class LikelihoodForm:
    """The bilinear form B of the likelihood over the lines of one run, its free motion eliminated."""

    lines: slice
    apply_weight: WeightFunction
    transient: RunTransient | None

    def __call__(self, left: ComplexArray, right: ComplexArray) -> Array:
        """B (q, s) of columns (k, c, q) and (k, c, s)."""
        return np.asarray(2.0 * np.real(self.weighted(left).conj().T @ right.reshape(-1, right.shape[2])))

    def weighted(self, left: ComplexArray) -> ComplexArray:
        """What the form has on its left for columns (k, c, q): (k c, q)."""
        weighted = self.apply_weight(self.lines, left).reshape(-1, left.shape[2])
        if self.transient is None:
            return weighted
        # Solved on the left, which has few columns; the right may be the slopes by every parameter.
        of_motion = self.transient.weighted.reshape(len(weighted), -1)
        return np.asarray(weighted - of_motion @ self.transient.amplitudes(self.motion(left)))

    def motion(self, columns: ComplexArray) -> Array:
        """What columns (k, c, q) have to do with the free motion (2m, q)."""
        assert self.transient is not None
        weighted = self.transient.weighted
        return 2.0 * np.real(weighted.reshape(-1, weighted.shape[2]).conj().T @ columns.reshape(-1, columns.shape[2]))


@dataclass(frozen=True)
class MainsTone:
    """One pickup in one run: columns C and slope dC/df (k, c, 2), n, b (2,), and the expected tone (2,)."""

    pickup: InterferenceTone
    form: LikelihoodForm
    columns: ComplexArray
    derivative: ComplexArray
    n: float
    b: Array
    expected: Array

    @property
    def power(self) -> float:
        """a^2 [V2]."""
        return float(self.pickup.power.value)

    @property
    def magnitude(self) -> float:
        """|b|."""
        return float(np.hypot(*self.b))

    @property
    def mean_resultant_length(self) -> float:
        """I1/I0 (a |b|): how well the phase is known."""
        from scipy.special import i0e, i1e

        x = np.sqrt(self.power) * self.magnitude
        return float(i1e(x) / i0e(x))

    @property
    def chi2(self) -> float:
        """What the phases' average has beside chi-square at the expected tone."""
        from scipy.special import i0e

        x, m = np.sqrt(self.power) * self.magnitude, self.expected
        averaged = self.power * self.n - 2.0 * (x + np.log(i0e(x)))
        return float(averaged + 2.0 * m @ self.b - m @ self.form(self.columns, self.columns) @ m)

    def curvature(self, derivatives: ComplexArray) -> tuple[Array, Array]:
        """Add the tone's own derivatives to `slopes` (k, c, p); what half the gradient and the information then lack.

        The phase is eliminated from the information as far as it is known.
        """
        unit = self.b / max(self.magnitude, 1e-300)
        ratio = _bessel_ratio_over_amplitude(self)
        power, frequency = self.pickup.power.derivative, self.pickup.frequency.derivative
        for by, change in ((0.5 * ratio * power, self.columns @ unit), (frequency, self.derivative @ self.expected)):
            own = np.flatnonzero(by)
            derivatives[:, :, own] += change[:, :, None] * by[own]
        by_power = 0.5 * (self.n - ratio * float(unit @ self.form(self.columns, self.columns) @ self.expected))
        turn = self.form(self.derivative, self.columns)
        by_frequency = 0.5 * self.power * float(np.trace(turn)) - float(self.expected @ turn @ self.expected)
        gradient = by_power * power + by_frequency * frequency
        full = self.n**2 / (4.0 * (1.0 + self.power * self.n))
        missing = max(full - 0.25 * ratio**2 * self.n, 0.0)
        turned = self.columns @ np.array([[-unit[1]], [unit[0]]])
        phase = self.form(turned, derivatives)[0]
        return gradient, missing * np.outer(power, power) - self.mean_resultant_length**2 / self.n * np.outer(
            phase, phase
        )


def _bessel_ratio_over_amplitude(tone: MainsTone) -> float:
    """I1/I0 (a |b|) / a, also for a = 0."""
    a = np.sqrt(tone.power)
    return tone.mean_resultant_length / a if a * tone.magnitude > 1e-6 else 0.5 * tone.magnitude


def mains_tones(
    batch: Batch, system: System, residual: ComplexArray, apply_weight: WeightFunction, free: tuple[RunTransient, ...]
) -> tuple[tuple[MainsTone, ...], tuple[RunTransient, ...]]:
    """Every pickup in every run; the expected tones are taken out of the residual (K, c) and of the free motion."""
    found: list[MainsTone] = []
    motion = {one.lines.start: one for one in free}
    for run, lines in enumerate(batch.parts):
        waveform = batch.waveforms[run]
        if not isinstance(waveform, Waveform):
            continue
        for pickup in system.interference_tones:
            one = motion.get(lines.start)
            tone = _fit_tone(
                batch, run, waveform, pickup, system, residual[lines], LikelihoodForm(lines, apply_weight, one)
            )
            if tone is None:
                continue
            residual[lines] -= tone.columns @ tone.expected
            if one is not None:
                moved = one.amplitudes(tone.form.motion(tone.columns) @ tone.expected)
                motion[lines.start] = replace(one, x=one.x - moved)
            found.append(tone)
    return tuple(found), tuple(motion[one.lines.start] for one in free)


def _fit_tone(
    batch: Batch,
    run: int,
    waveform: Waveform,
    pickup: InterferenceTone,
    system: System,
    residual: ComplexArray,
    form: LikelihoodForm,
) -> MainsTone | None:
    """The pickup in one run; None where no line of it can show it."""
    c = residual.shape[1]
    column, derivative = _tone_columns(batch, run, waveform, float(pickup.frequency.value))
    channel = np.eye(c)[pickup.channel][:, None]
    columns, derivatives = column[:, None, :] * channel, derivative[:, None, :] * channel
    n = 0.5 * float(np.trace(form(columns, columns)))
    if n <= 0.0:
        return None
    b = form(columns, residual[:, :, None])[:, 0]
    tone = MainsTone(pickup, form, columns, derivatives, n, b, np.zeros(2))
    unit = b / max(tone.magnitude, 1e-300)
    return replace(tone, expected=np.sqrt(tone.power) * tone.mean_resultant_length * unit)


def tone_magnitudes(batch: Batch, tone: MainsTone, residual: ComplexArray, frequency: Array) -> tuple[Array, Array]:
    """N and |b| (f,) of a tone at other frequencies [Hz], for the residual (k, c) of its run without the tone found."""
    run = next(i for i, lines in enumerate(batch.parts) if lines == tone.form.lines)
    waveform = batch.waveforms[run]
    assert isinstance(waveform, Waveform)
    with_tone = (residual + tone.columns @ tone.expected).reshape(-1)
    channel = np.eye(residual.shape[1])[tone.pickup.channel][:, None]
    sizes = np.zeros((2, len(frequency)))
    for i, f in enumerate(frequency):
        columns = _tone_columns(batch, run, waveform, float(f))[0][:, None, :] * channel
        weighted = tone.form.weighted(columns)
        sizes[0, i] = np.real(np.sum(weighted.conj() * columns.reshape(weighted.shape)))
        sizes[1, i] = np.linalg.norm(2.0 * np.real(weighted.conj().T @ with_tone))
    return sizes[0], sizes[1]


def _tone_columns(batch: Batch, run: int, waveform: Waveform, f: float) -> tuple[ComplexArray, ComplexArray]:
    """Lines (k, 2) of cos(2 pi f t) and -sin(2 pi f t), and their derivatives by f, behind the anti-alias filter."""
    lines = batch.parts[run]
    window = batch.windows[run]
    if isinstance(waveform, RecordWaveform):
        frequency = waveform.frequency[waveform.bin_index]
        step = waveform.step
        start, count = np.zeros(len(frequency)), np.full(len(frequency), waveform.samples)
    else:
        frequency, step = batch.frequency[batch.index[lines]], waveform.step
        # Where nothing is said of the window, one period stands for all.
        start = np.zeros(len(frequency)) if window is None else window.start
        length = waveform.samples * step if window is None else window.stop - window.start
        count = np.broadcast_to(np.rint(length / step).astype(int), frequency.shape)
    passed = abs(waveform.filter_response[np.argmin(np.abs(waveform.frequency[waveform.bin_index] - f))])
    positive, d_positive = _phasors(f, frequency, start, step, count)
    negative, d_negative = _phasors(-f, frequency, start, step, count)
    value = np.stack([positive + negative, 1j * (positive - negative)], axis=1)
    derivative = np.stack([d_positive - d_negative, 1j * (d_positive + d_negative)], axis=1)
    if isinstance(waveform, RecordWaveform):
        value[-1] = derivative[-1] = 0.0
        value, derivative = waveform.combine_neighbors(value), waveform.combine_neighbors(derivative)
    return passed * value, passed * derivative


def _phasors(
    f: float, frequency: Array, start: Array, step: float, count: NDArray[np.intp]
) -> tuple[ComplexArray, ComplexArray]:
    """Mean (k,) of exp(j 2 pi (f - frequency) i step) over i < count, turned by exp(j 2 pi f start), and its slope."""
    angle = 2 * np.pi * (f - frequency) * step
    angle = angle - 2 * np.pi * np.round(angle / (2 * np.pi))
    half = 0.5 * count * angle
    near = np.abs(half) < SMALL_PHASE
    sine = np.where(near, 1.0, np.sin(0.5 * angle))
    ratio = np.where(near, 1.0 - half**2 / 6.0, np.sin(half) / (count * sine))
    d_ratio = np.where(
        near,
        -angle * count**2 / 12.0,
        (0.5 * count * np.cos(half) * sine - 0.5 * np.sin(half) * np.cos(0.5 * angle)) / (count * sine**2),
    )
    turn = np.exp(2j * np.pi * f * start + 0.5j * (count - 1) * angle)
    value = turn * ratio
    d_angle, d_start = 2 * np.pi * step, 2j * np.pi * start
    derivative = value * (d_start + 0.5j * (count - 1) * d_angle) + turn * d_ratio * d_angle
    return np.asarray(value, complex), np.asarray(derivative, complex)
