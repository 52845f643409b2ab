"""Transients in the lines of records that began at rest, eliminated like the true loads.

A window of N samples, whole periods of the line, from t_f to t_e contains of a motion Re v exp(s t)

    Z(w) = (v/N) (exp(s t_f) - exp(s t_e)) / (1 - exp((s - jw) h)),        Y = Z(w) + conj Z(-w),

h being the step between samples. The amplitudes a (m,) of the modes at t = 0 are unknown in every run: as real numbers
x, the real parts of all and the imaginary parts of those that oscillate, they enter Y = C x linearly. The start of a
high-pass filter has real s, v and a. The lines do not determine what has decayed by t_f; there a prior holds the
amplitude within a multiple of the rms of the channels: 0 = Q x with unit variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch, BatchRun
from balance_cli.estimation.inner_products import MANY_PARAMETERS, real_inner_product
from balance_cli.estimation.recorded_loads import attached_exciters
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.estimation.transient_prior import prior_weight
from balance_cli.model.response_jacobian import Selection, mask_or_full_slice
from balance_cli.model.transient_modes import TransientModes, divided_differences
from balance_cli.signals.waveform_types import AnalysisWindow

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
WeightFunction = Callable[[slice, ComplexArray], ComplexArray]

# Decay of a mode before the first line, as a logarithm, beyond which it is left out: exp(-18.4) = 1e-8.
MAX_DECAY = 18.4
# Growth of a mode over the record, as a logarithm, beyond which the parameters are rejected: exp(50) = 5e21.
MAX_GROWTH = 50.0


@dataclass(frozen=True)
class RunTransient:
    """The transient of one run in its `lines`: window, modes `free`, columns C (K, c, q) and `weighted` P C.

    `prior_weight` (c,) [1/V] is one over the largest transient of each channel, `bound` Q (c, q) that times the motion
    at t = 0; `normal` (q, q) = 2 Re C* P C + Re Q* Q; `x` (q,) is the estimate.
    """

    lines: slice
    window: AnalysisWindow
    frequency: Array
    free: TransientModes
    columns: ComplexArray
    weighted: ComplexArray
    prior_weight: Array
    bound: ComplexArray
    normal: Array
    x: Array

    @property
    def amplitudes(self) -> ComplexArray:
        """Amplitudes a (m,) of the modes at t = 0."""
        a = self.x[: len(self.free.s)].astype(complex)
        a[: self.free.oscillating] += 1j * self.x[len(a) :]
        return a

    @property
    def chi2(self) -> float:
        """Chi-square |Q x|^2 of the prior."""
        return float(np.sum(np.abs(self.bound @ self.x) ** 2))

    def solve(self, right: Array) -> Array:
        """The solution x (q, ...) of the normal equations for another right-hand side."""
        return _solve_scaled(self.normal, right)

    @property
    def effective_parameters(self) -> float:
        """Number of amplitudes that the lines determine; those that no live channel reads do not count."""
        prior_weight = np.real(self.bound.conj().T @ self.bound)
        read = np.count_nonzero(np.diag(self.normal) > 0)
        return float(read - np.trace(_solve_scaled(self.normal, prior_weight)))


def fit_transients(
    batch: Batch,
    shared: SharedSolutions,
    residual: ComplexArray,
    apply_weight: WeightFunction,
    derivatives: bool,
) -> tuple[RunTransient, ...]:
    """Fit the transient of every run of the batch that has one to the residual Y - T U (K, c).

    `apply_weight` multiplies columns (k, c, q) at the given lines by P, the precision with the true loads eliminated.
    """
    fits: list[RunTransient] = []
    for run in batch.runs:
        part = _lines_with_transient(batch, run)
        if part is None:
            continue
        lines, window, max_frequency = part
        fastest_decay = MAX_DECAY / max(float(window.start.min()), window.step)
        attached = attached_exciters(batch)[lines.start]
        free = shared.transient_modes(batch.spin, max_frequency, fastest_decay, derivatives, attached)
        frequency = batch.frequency[batch.lines.index[lines]]
        if not len(free.s):
            continue
        columns, weight = transient_columns(free, window, frequency), prior_weight(batch, run.lines)
        weighted = apply_weight(lines, columns)
        fits.append(_fit_transient(lines, window, frequency, free, columns, weighted, weight, residual[lines]))
    return tuple(fits)


def _lines_with_transient(batch: Batch, run: BatchRun) -> tuple[slice, AnalysisWindow, float] | None:
    """The lines of a run that contain its transient, their window, and the highest frequency of its modes [Hz].

    Local models have removed the transient from the lines of a record that does not repeat, but not from its mean,
    which still contains the starts of high-pass filters.
    """
    lines, window, waveform = run.lines, run.window, run.waveform
    if window is not None:
        return lines, window, 0.5 / window.step
    mean_window = None if waveform is None else waveform.mean_window
    if mean_window is None or batch.frequency[batch.lines.index[lines.stop - 1]] > 0:
        return None
    return slice(lines.stop - 1, lines.stop), mean_window, 0.0


def _fit_transient(
    lines: slice,
    window: AnalysisWindow,
    frequency: Array,
    free: TransientModes,
    columns: ComplexArray,
    weighted: ComplexArray,
    prior_weight: Array,
    residual: ComplexArray,
) -> RunTransient:
    bound = prior_weight[:, None] * np.concatenate([free.volts, 1j * free.volts[:, : free.oscillating]], axis=1)
    normal = 2.0 * real_inner_product(weighted, columns) + np.real(bound.conj().T @ bound)
    x = _solve_scaled(normal, 2.0 * real_inner_product(weighted, residual[:, :, None])[:, 0])
    return RunTransient(lines, window, frequency, free, columns, weighted, prior_weight, bound, normal, x)


def _solve_scaled(normal: Array, right: Array) -> Array:
    """Solve with a symmetric matrix whose columns differ much in size and may be dependent, or zero (unread modes)."""
    diagonal = np.diag(normal)
    size = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    scaled = normal * np.outer(size, size) + 1e-13 * np.eye(len(size))
    factor = size if right.ndim == 1 else size[:, None]
    return np.asarray(factor * np.linalg.solve(scaled, factor * right))


def transient_columns(free: TransientModes, window: AnalysisWindow, frequency: Array) -> ComplexArray:
    """C (K, c, q): the lines of the transient per unit of the real parts of a, then of its imaginary parts.

    A mode with volts v has A v a + B conj(v a), with A = Z(w) / v and B = conj(Z(-w) / v).
    """
    starts, index = np.unique(window.start, return_inverse=True)
    # One factor per column, not per mode: loops over few modes cost more than the numbers that they repeat.
    modes = np.concatenate([np.arange(len(free.s)), np.arange(free.oscillating)])
    unit = np.where(np.arange(len(modes)) < len(free.s), 1.0, 1j)
    decay = _window_decay(free.s, starts, window)[0][index]
    A, B = ((decay * _resolvent(free.s, w, window))[:, modes] for w in _both_signs(frequency))
    volts = unit * free.volts[:, modes]
    columns = A[:, None, :] * volts
    columns += B.conj()[:, None, :] * volts.conj()
    return columns


def add_transient_derivatives(fit: RunTransient, derivatives: ComplexArray) -> None:
    """Add the derivatives of C x by the parameters to `derivatives` (K, c, p), in place."""
    amplitudes, m = fit.amplitudes, fit.free.oscillating
    for part, a in ((fit.free.select(slice(m)), amplitudes[:m]), (fit.free.select(slice(m, None)), amplitudes[m:])):
        # Most parameters of a score test change how the motion is read, not the motion itself, and no filter.
        moved, read = (np.any(each, axis=(1, 2)) for each in (part.s_derivative, part.volts_derivative))
        if not np.any(moved | read):
            continue
        parts = [_transient_with_change(part, fit.window, w, a) for w in _both_signs(fit.frequency)]
        motion, change = (np.concatenate([plus, minus.conj()], axis=1) for plus, minus in zip(*parts, strict=True))
        if read.any():
            _add_reading_derivatives(derivatives, part.volts_derivative, mask_or_full_slice(read), motion)
        if moved.any():
            _add_motion_derivatives(derivatives, part, mask_or_full_slice(moved), change)


def _add_reading_derivatives(
    derivatives: ComplexArray, volts_derivative: ComplexArray, own: Selection, motion: ComplexArray
) -> None:
    """Add those by what the channels read of a motion and its conjugate (K, 2m), in place."""
    if len(volts_derivative) >= MANY_PARAMETERS:
        for channel in range(volts_derivative.shape[1]):
            shown = volts_derivative[:, channel].any(axis=1)
            read = np.concatenate([volts_derivative[shown, channel], volts_derivative[shown, channel].conj()], axis=1)
            derivatives[:, channel, shown] += motion @ read.T
        return
    read = np.concatenate([volts_derivative[own], volts_derivative[own].conj()], axis=2)
    p, c, m2 = read.shape
    derivatives[:, :, own] += (motion @ read.transpose(2, 1, 0).reshape(m2, c * p)).reshape(-1, c, p)


def _add_motion_derivatives(
    derivatives: ComplexArray, part: TransientModes, own: Selection, change: ComplexArray
) -> None:
    """Add those by the matrix S, with the factors `change` (K, 2m, m) of the motion and its conjugate, in place."""
    moved = np.concatenate([part.s_derivative[own], part.s_derivative[own].conj()], axis=1)
    inner = np.matmul(change.swapaxes(0, 1), moved.transpose(1, 2, 0)).swapaxes(0, 1)
    derivatives[:, :, own] += np.concatenate([part.volts, part.volts.conj()], axis=1) @ inner


def _transient_with_change(
    free: TransientModes, window: AnalysisWindow, w: Array, a: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """R(S) E(S) a (K, m), and the factors `change` (K, m, m) of its derivative, the sum over j of change times dS_ij.

    R is a resolvent, (1 - Z)^-1 of Z = exp((S - jw) h), so that dR = R dZ R: no differences at every line.
    """
    s, h = free.s, window.step
    starts, index = np.unique(window.start, return_inverse=True)
    E, dE = _window_decay(s, starts, window)
    R, stepped = _resolvent(s, w, window), np.asarray(np.exp(s * h), complex)
    motion = R * (E * a)[index]
    dZ = np.exp(-1j * w * h)[:, None, None] * divided_differences(stepped, np.asarray(h * stepped, complex), s)
    change = R[:, :, None] * (dZ * motion[:, None, :] + (divided_differences(E, dE, s) * a)[index])
    return np.asarray(motion, complex), np.asarray(change, complex)


@dataclass(frozen=True)
class TransientTerms:
    """Terms of gradient and information that follow from the elimination of a run's transient.

    `gradient` (p,) is added to half the gradient. With `bound` B (c, p), `cross` X (q, p) and `normal` N (q, q) the
    information gains Re B* B - X' N^-1 X.
    """

    gradient: Array
    bound: ComplexArray
    cross: Array
    normal: Array

    def information(self, rows: Index | slice, columns: Index | slice) -> Array:
        """The part (rows, columns) of what is added to the information."""
        of_bound = np.real(self.bound[:, rows].conj().T @ self.bound[:, columns])
        return np.asarray(of_bound - self.cross[:, rows].T @ self._amplitudes[:, columns])

    def diagonal(self) -> Array:
        """The diagonal (p,) of what is added to the information."""
        return np.asarray(np.sum(np.abs(self.bound) ** 2, axis=0) - np.sum(self.cross * self._amplitudes, axis=0))

    @cached_property
    def _amplitudes(self) -> Array:
        """N^-1 X (q, p), which several parts of the information need."""
        return _solve_scaled(self.normal, self.cross)


def eliminate_transient(fit: RunTransient, derivatives: ComplexArray) -> TransientTerms:
    """The terms of a run's transient in the gradient and information of derivatives (K, c, p)."""
    d_bound = fit.prior_weight[:, None] * (fit.free.volts_derivative @ fit.amplitudes).T
    gradient = np.real(d_bound.conj().T @ (fit.bound @ fit.x))
    cross = 2.0 * real_inner_product(fit.weighted, derivatives) + np.real(fit.bound.conj().T @ d_bound)
    return TransientTerms(gradient, d_bound, cross, fit.normal)


def _both_signs(frequency: Array) -> Sequence[Array]:
    w = 2 * np.pi * frequency
    return w, -w


def _window_decay(s: ComplexArray, starts: Array, window: AnalysisWindow) -> tuple[ComplexArray, ComplexArray]:
    """E (f, m) = (exp(s t_f) - exp(s t_e)) / N for each start, and dE/ds.

    Raises LinAlgError for a motion that grows without bound: no recorded rig does.
    """
    t_f, t_e = starts[:, None], window.stop
    if np.any(s.real * t_e > MAX_GROWTH):
        raise np.linalg.LinAlgError("the transient grows without bound")
    share = window.step / (t_e - t_f)
    first, last = np.exp(s * t_f), np.exp(s * t_e)
    E, dE = share * (first - last), share * (t_f * first - t_e * last)
    return np.asarray(E, complex), np.asarray(dE, complex)


def _resolvent(s: ComplexArray, w: Array, window: AnalysisWindow) -> ComplexArray:
    """R (K, m) = 1 / (1 - exp((s - jw) h))."""
    return np.asarray(1.0 / (1.0 - np.exp(-1j * w * window.step)[:, None] * np.exp(s * window.step)), complex)
