"""Transients in the lines of records that began at rest, eliminated like the true loads.

A window of N samples, whole periods of the line, from t_f to t_e contains of a motion Re v exp(s t)

    Z(w) = (v/N) (exp(s t_f) - exp(s t_e)) / (1 - exp((s - jw) h)),        Y = Z(w) + conj Z(-w),

h being the step between samples. The complex amplitudes a (m,) of the modes at t = 0 are unknown in every run: as 2m
real numbers x they enter Y = C x linearly. The start of a high-pass filter is one of them, with real s and v: its
imaginary amplitude is in no line, and stays zero. The lines do not determine what has decayed by t_f; there a prior
holds the amplitude within a multiple of the rms of the channels: 0 = Q x with unit variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch, BatchRun
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.response_jacobian import mask_or_full_slice
from balance_cli.model.transient_modes import TransientModes, divided_differences
from balance_cli.signals.waveform_types import AnalysisWindow

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
WeightFunction = Callable[[slice, ComplexArray], ComplexArray]

# A transient from rest begins as minus the forced motion, of the size of the channels' rms; single modes, which partly
# cancel, may be larger.
MAX_AMPLITUDE_RATIO = 10.0
# Decay of a mode before the first line, as a logarithm, beyond which it is left out: exp(-18.4) = 1e-8.
MAX_DECAY = 18.4
# Growth of a mode over the record, as a logarithm, beyond which the parameters are rejected: exp(50) = 5e21.
MAX_GROWTH = 50.0
# Least rms of a channel relative to the largest, so that a computed signal of zero has a finite prior.
MIN_SIGNAL_RATIO = 1e-9


@dataclass(frozen=True)
class RunTransient:
    """The transient of one run in its `lines`: window, modes `free`, columns C (K, c, 2m) and `weighted` P C.

    `prior_weight` (c,) [1/V] is one over the largest transient of each channel, `bound` Q (c, 2m) that times the motion
    at t = 0; `normal` (2m, 2m) = 2 Re C* P C + Re Q* Q; `x` (2m,) is the estimate.
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
    def chi2(self) -> float:
        """Chi-square |Q x|^2 of the prior."""
        return float(np.sum(np.abs(self.bound @ self.x) ** 2))

    def amplitudes(self, right: Array) -> Array:
        """Amplitudes (2m, ...) from the right-hand side of their normal equations."""
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
        free = shared.transient_modes(batch.spin, max_frequency, fastest_decay, derivatives)
        frequency = batch.frequency[batch.lines.index[lines]]
        if not len(free.s):
            continue
        columns, prior_weight = transient_columns(free, window, frequency), _prior_weight(batch, run.lines)
        weighted = apply_weight(lines, columns)
        fits.append(_fit_transient(lines, window, frequency, free, columns, weighted, prior_weight, residual[lines]))
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
    m2 = columns.shape[2]
    bound = prior_weight[:, None] * np.concatenate([free.volts, 1j * free.volts], axis=1)
    flat = weighted.reshape(-1, m2).conj().T
    normal = 2.0 * np.real(flat @ columns.reshape(-1, m2)) + np.real(bound.conj().T @ bound)
    x = _solve_scaled(normal, 2.0 * np.real(flat @ residual.reshape(-1)))
    return RunTransient(lines, window, frequency, free, columns, weighted, prior_weight, bound, normal, x)


def _prior_weight(batch: Batch, lines: slice) -> Array:
    """One over the largest transient (c,) [1/V] that is expected in each live channel."""
    rms = np.sqrt(0.5 * np.sum(np.abs(batch.lines.channels[lines]) ** 2, axis=0))
    c = len(rms)
    is_live = np.real(np.diagonal(batch.lines.precision[lines.start]))[:c] > 0
    return np.where(is_live, 1.0 / (MAX_AMPLITUDE_RATIO * np.maximum(rms, MIN_SIGNAL_RATIO * rms.max())), 0.0)


def _solve_scaled(normal: Array, right: Array) -> Array:
    """Solve with a symmetric matrix whose columns differ much in size and may be dependent, or zero (unread modes)."""
    diagonal = np.diag(normal)
    size = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    scaled = normal * np.outer(size, size) + 1e-13 * np.eye(len(size))
    factor = size if right.ndim == 1 else size[:, None]
    return np.asarray(factor * np.linalg.solve(scaled, factor * right))


def transient_columns(free: TransientModes, window: AnalysisWindow, frequency: Array) -> ComplexArray:
    """C (K, c, 2m): the lines of the transient per unit of the real, then of the imaginary parts of a."""
    starts, index = np.unique(window.start, return_inverse=True)
    decay = _window_decay(free.s, starts, window)[0][index]
    each = [(decay * _resolvent(free.s, w, window))[:, None, :] * free.volts for w in _both_signs(frequency)]
    return _real_columns(each[0], each[1].conj())


def transient_derivatives(fit: RunTransient) -> ComplexArray:
    """Derivatives (K, c, p) of C x by the parameters."""
    free = fit.free
    p, c, m = free.volts_derivative.shape
    parts = [_transient_with_change(free, fit.window, w, _to_complex(fit.x)) for w in _both_signs(fit.frequency)]
    motion, change = (np.concatenate([plus, minus.conj()], axis=1) for plus, minus in zip(*parts, strict=True))
    read = np.concatenate([free.volts_derivative, free.volts_derivative.conj()], axis=2)
    derivatives = np.asarray((motion @ read.transpose(2, 1, 0).reshape(2 * m, c * p)).reshape(-1, c, p), complex)
    # Most parameters of a score test change how the motion is read and not the motion itself.
    moving = mask_or_full_slice(np.any(free.s_derivative, axis=(1, 2)))
    moved = np.concatenate([free.s_derivative[moving], free.s_derivative[moving].conj()], axis=1)
    inner = np.matmul(change.swapaxes(0, 1), moved.transpose(1, 2, 0)).swapaxes(0, 1)
    derivatives[:, :, moving] += np.concatenate([free.volts, free.volts.conj()], axis=1) @ inner
    return derivatives


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

    `gradient` (p,) is added to half the gradient. With `bound` B (c, p), `cross` X (2m, p) and `normal` N (2m, 2m) the
    information gains Re B* B - X' N^-1 X.
    """

    gradient: Array
    bound: ComplexArray
    cross: Array
    normal: Array

    def information(self, rows: Index | slice, columns: Index | slice) -> Array:
        """The part (rows, columns) of what is added to the information."""
        of_bound = np.real(self.bound[:, rows].conj().T @ self.bound[:, columns])
        return np.asarray(of_bound - self.cross[:, rows].T @ _solve_scaled(self.normal, self.cross[:, columns]))

    def diagonal(self) -> Array:
        """The diagonal (p,) of what is added to the information."""
        amplitudes = _solve_scaled(self.normal, self.cross)
        return np.asarray(np.sum(np.abs(self.bound) ** 2, axis=0) - np.sum(self.cross * amplitudes, axis=0))


def eliminate_transient(fit: RunTransient, derivatives: ComplexArray) -> TransientTerms:
    """The terms of a run's transient in the gradient and information of derivatives (K, c, p)."""
    p = derivatives.shape[2]
    d_bound = fit.prior_weight[:, None] * (fit.free.volts_derivative @ _to_complex(fit.x)).T
    gradient = np.real(d_bound.conj().T @ (fit.bound @ fit.x))
    weighted = fit.weighted.reshape(-1, len(fit.x)).conj().T
    cross = 2.0 * np.real(weighted @ derivatives.reshape(-1, p)) + np.real(fit.bound.conj().T @ d_bound)
    return TransientTerms(gradient, d_bound, cross, fit.normal)


def _both_signs(frequency: Array) -> Sequence[Array]:
    w = 2 * np.pi * frequency
    return w, -w


def _to_complex(x: Array) -> ComplexArray:
    m = len(x) // 2
    return np.asarray(x[:m] + 1j * x[m:])


def _real_columns(positive: ComplexArray, negative: ComplexArray) -> ComplexArray:
    """Columns of real and imaginary parts, where the latter enter with their conjugates in `negative`."""
    return np.concatenate([positive + negative, 1j * (positive - negative)], axis=-1)


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
    return np.asarray(1.0 / (1.0 - np.exp((s - 1j * w[:, None]) * window.step)), complex)
