"""Mains interference: a tone whose phase is unknown in every run.

A tone a cos(2 pi f t + phi) adds a C (cos phi, sin phi)' to the lines of a run. With B the bilinear form of the
likelihood (transients eliminated), b = B(C, r) and B(C, C) = n I, chi-square averaged over all phases is

    chi2(r) + a^2 n - 2 ln I0(a |b|)

(Rice's distribution; Helstrom, Statistical Theory of Signal Detection, 1968, chapter V). Its derivatives by all other
parameters are those at the expected tone, m = a I1/I0(a |b|) b/|b| in place of a (cos phi, sin phi). As a function of
a^2 it is regular at zero, where the gradient has zero mean, as a score must.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.inner_products import real_inner_product
from balance_cli.estimation.tone_columns import tone_columns
from balance_cli.estimation.transients import RunTransient
from balance_cli.model.mechanics.equations import InterferenceTone
from balance_cli.model.system import System
from balance_cli.signals.waveform_types import BinSampling, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
WeightFunction = Callable[[slice, ComplexArray], ComplexArray]

# A lower limit of |b| that only prevents 0/0: amplitudes in volts over their noise are far above it.
TINY = 1e-300
# Below this a |b| the ratio I1/I0(a |b|) / a is |b| / 2 to 1e-13 (the next term, relative, is (a |b|)^2 / 8).
SMALL_ARGUMENT = 1e-6


@dataclass(frozen=True)
class LikelihoodForm:
    """The bilinear form B of the likelihood over the lines of one run, with its transient eliminated."""

    lines: slice
    apply_weight: WeightFunction
    transient: RunTransient | None

    def __call__(self, left: ComplexArray, right: ComplexArray) -> Array:
        """B (q, s) of columns (k, c, q) and (k, c, s)."""
        return np.asarray(2.0 * np.real(self.weighted(left).conj().T @ right.reshape(-1, right.shape[2])))

    def weighted(self, left: ComplexArray) -> ComplexArray:
        """The left factor of the form for columns (k, c, q): (k c, q)."""
        weighted = self.apply_weight(self.lines, left).reshape(-1, left.shape[2])
        if self.transient is None:
            return weighted
        # Solved for the left factor, which has few columns; the right one may hold the derivatives by all parameters.
        transient_columns = self.transient.weighted.reshape(len(weighted), -1)
        return np.asarray(weighted - transient_columns @ self.transient.solve(self.transient_products(left)))

    def transient_products(self, columns: ComplexArray) -> Array:
        """Weighted inner products (2m, q) of the transient's columns with columns (k, c, q)."""
        assert self.transient is not None
        return 2.0 * real_inner_product(self.transient.weighted, columns)


@dataclass(frozen=True)
class ToneTerms:
    """Terms of t tones that their derivatives do not give: half the `gradient` (p,), and information of rank two each.

    The information is `missing` (t,) times the square of the derivative of the `power` (t, p), less that of the `phase`
    (t, p). Kept as vectors: (p, p) for each tone in each run would be most of the memory of a score test.
    """

    gradient: Array
    missing: Array
    power: Array
    phase: Array

    def information(self, rows: Index | slice, columns: Index | slice) -> Array:
        """The part (rows, columns) of what is added to the information."""
        of_power = self.power[:, rows].T @ (self.missing[:, None] * self.power[:, columns])
        return np.asarray(of_power - self.phase[:, rows].T @ self.phase[:, columns])

    def diagonal(self) -> Array:
        """The diagonal (p,) of what is added to the information."""
        return np.asarray(self.missing @ self.power**2 - np.sum(self.phase**2, axis=0))


def join_tones(terms: Sequence[ToneTerms]) -> ToneTerms:
    """The terms of several tones in one, so that one product serves all of them."""
    missing, power, phase = (
        np.concatenate([getattr(term, name) for term in terms]) for name in ("missing", "power", "phase")
    )
    return ToneTerms(np.sum([term.gradient for term in terms], axis=0), missing, power, phase)


@dataclass(frozen=True)
class MainsTone:
    """One interference tone in one run.

    `columns` C and `derivative` dC/df (k, c, 2), `n` and `b` (2,) of the likelihood, and the expected tone (2,) [V].
    """

    interference: InterferenceTone
    form: LikelihoodForm
    columns: ComplexArray
    derivative: ComplexArray
    n: float
    b: Array
    expected: Array

    @property
    def power(self) -> float:
        """a^2 [V2]."""
        return float(self.interference.power.value)

    @property
    def magnitude(self) -> float:
        """|b|."""
        return float(np.hypot(*self.b))

    @property
    def mean_resultant_length(self) -> float:
        """I1/I0 (a |b|): how well the phase is known, from 0 to 1."""
        from scipy.special import i0e, i1e

        x = np.sqrt(self.power) * self.magnitude
        return float(i1e(x) / i0e(x))

    @property
    def chi2(self) -> float:
        """Chi-square averaged over the phase, less chi-square at the expected tone."""
        from scipy.special import i0e

        x, m = np.sqrt(self.power) * self.magnitude, self.expected
        averaged = self.power * self.n - 2.0 * (x + np.log(i0e(x)))
        return float(averaged + 2.0 * m @ self.b - m @ self.form(self.columns, self.columns) @ m)

    def curvature(self, derivatives: ComplexArray) -> ToneTerms:
        """Add the tone's own derivatives to `derivatives` (k, c, p), in place.

        Returns the terms of half the gradient (p,) and of the information (p, p) that these derivatives do not give.
        The phase is eliminated from the information as far as it is known.
        """
        unit, ratio = self._direction(), _bessel_ratio_over_amplitude(self)
        power, frequency = self.interference.power.derivative, self.interference.frequency.derivative
        self._add_derivatives(derivatives, 0.5 * ratio * power)
        full = self.n**2 / (4.0 * (1.0 + self.power * self.n))
        missing = np.array([max(full - 0.25 * ratio**2 * self.n, 0.0)])
        if self.power == 0.0:  # nothing is expected, and nothing known of the phase
            return ToneTerms(0.5 * self.n * power, missing, power[None], np.zeros((1, len(power))))
        by_power = 0.5 * (self.n - ratio * float(unit @ self.form(self.columns, self.columns) @ self.expected))
        turn = self.form(self.derivative, self.columns)
        by_frequency = 0.5 * self.power * float(np.trace(turn)) - float(self.expected @ turn @ self.expected)
        quadrature = self.columns @ np.array([[-unit[1]], [unit[0]]])
        # The columns are orthogonal and of equal size but for the eliminated transient. By their own size the
        # information stays positive.
        size = max(self.n, float(self.form(quadrature, quadrature)[0, 0]))
        phase = self.mean_resultant_length / np.sqrt(size) * self.form(quadrature, derivatives)[0]
        return ToneTerms(by_power * power + by_frequency * frequency, missing, power[None], phase[None])

    def _direction(self) -> Array:
        """Unit vector b / |b| (2,) of the most probable phase."""
        return np.asarray(self.b / max(self.magnitude, TINY))

    def _add_derivatives(self, derivatives: ComplexArray, by_power: Array) -> None:
        """Add to `derivatives` (k, c, p) those by power, with factors `by_power` (p,), and by frequency."""
        changes = (
            (by_power, self.columns @ self._direction()),
            (self.interference.frequency.derivative, self.derivative @ self.expected),
        )
        for factor, change in changes:
            own = np.flatnonzero(factor)
            derivatives[:, :, own] += change[:, :, None] * factor[own]


def _bessel_ratio_over_amplitude(tone: MainsTone) -> float:
    """I1/I0(a |b|) / a, also for a = 0."""
    a = np.sqrt(tone.power)
    return tone.mean_resultant_length / a if a * tone.magnitude > SMALL_ARGUMENT else 0.5 * tone.magnitude


def mains_tones(
    batch: Batch,
    system: System,
    residual: ComplexArray,
    apply_weight: WeightFunction,
    transients: tuple[RunTransient, ...],
) -> tuple[tuple[MainsTone, ...], tuple[RunTransient, ...]]:
    """Fit every interference tone in every run with a time axis.

    Returns the tones, and the transients with the tones taken out. The expected tones are subtracted from `residual`
    (K, c) in place.
    """
    tones: list[MainsTone] = []
    by_start = {transient.lines.start: transient for transient in transients}
    for run, lines in enumerate(batch.parts):
        sampled = _sampled_waveform(batch, run)
        if sampled is None:
            continue
        columns_of = cache(partial(tone_columns, *sampled))  # each channel may have a tone of the same frequency
        for interference in system.equations.interference_tones:
            transient = by_start.get(lines.start)
            form = LikelihoodForm(lines, apply_weight, transient)
            tone = _fit_tone(columns_of(float(interference.frequency.value)), interference, residual[lines], form)
            if tone is None:
                continue
            tones.append(tone)
            if tone.power == 0.0:  # nothing is expected
                continue
            residual[lines] -= tone.columns @ tone.expected
            if transient is not None:
                correction = transient.solve(form.transient_products(tone.columns) @ tone.expected)
                by_start[lines.start] = replace(transient, x=transient.x - correction)
    return tuple(tones), tuple(by_start[transient.lines.start] for transient in transients)


def _sampled_waveform(batch: Batch, run: int) -> tuple[Waveform, BinSampling] | None:
    """The waveform of a run with the sampling of its bins; None where there is no waveform or no time axis."""
    waveform = batch.runs[run].waveform
    if waveform is None:
        return None
    sampling = waveform.bin_sampling(batch.frequency[batch.lines.index[batch.parts[run]]], batch.runs[run].window)
    return None if sampling is None else (waveform, sampling)


def _fit_tone(
    lines_and_derivatives: tuple[ComplexArray, ComplexArray],
    interference: InterferenceTone,
    residual: ComplexArray,
    form: LikelihoodForm,
) -> MainsTone | None:
    """The tone in one run with residual (k, c), from its lines (k, 2) in its channel and their derivatives by f.

    None where no line is sensitive to it.
    """
    column, derivative = lines_and_derivatives
    channel = np.eye(residual.shape[1])[interference.channel][:, None]
    columns, derivatives = column[:, None, :] * channel, derivative[:, None, :] * channel
    weighted = form.weighted(columns)
    n = float(np.sum(np.real(weighted.conj() * columns.reshape(weighted.shape))))
    if n <= 0.0:
        return None
    b = 2.0 * np.real(weighted.conj().T @ residual.reshape(-1))
    fit = MainsTone(interference, form, columns, derivatives, n, b, np.zeros(2))
    unit = b / max(fit.magnitude, TINY)
    return replace(fit, expected=np.sqrt(fit.power) * fit.mean_resultant_length * unit)


def tone_magnitudes(batch: Batch, tone: MainsTone, residual: ComplexArray, frequency: Array) -> tuple[Array, Array]:
    """Evaluate n and |b| (f,) of a tone at other frequencies [Hz].

    `residual` (k, c) is that of the run without the fitted tone, which is added again.
    """
    run = next(i for i, lines in enumerate(batch.parts) if lines == tone.form.lines)
    sampled = _sampled_waveform(batch, run)
    assert sampled is not None
    with_tone = (residual + tone.columns @ tone.expected).reshape(-1)
    channel = np.eye(residual.shape[1])[tone.interference.channel][:, None]
    n, magnitude = np.zeros(len(frequency)), np.zeros(len(frequency))
    for i, f in enumerate(frequency):
        columns = tone_columns(*sampled, float(f))[0][:, None, :] * channel
        weighted = tone.form.weighted(columns)
        n[i] = np.real(np.sum(weighted.conj() * columns.reshape(weighted.shape)))
        magnitude[i] = np.linalg.norm(2.0 * np.real(weighted.conj().T @ with_tone))
    return n, magnitude


def tone_noise_spread(batch: Batch, tone: MainsTone) -> float:
    """Return the variance of b over n, which is one where the noise of the lines is independent.

    Lines of a record that does not repeat share the bins of their window. What is a line in a single bin is then in all
    of them, and noise in this bin looks like a tone that many lines agree on.
    """
    run = next(i for i, lines in enumerate(batch.parts) if lines == tone.form.lines)
    waveform = batch.runs[run].waveform
    assert waveform is not None
    channel = tone.interference.channel
    column = tone.columns[:, channel, 0]
    weighted = tone.form.weighted(tone.columns[:, :, :1]).reshape(tone.columns.shape[:2])[:, channel]
    power = np.maximum(np.real(weighted.conj() * column), 0.0)
    return waveform.noise_spread(np.sqrt(power) * column / np.maximum(np.abs(column), TINY))
