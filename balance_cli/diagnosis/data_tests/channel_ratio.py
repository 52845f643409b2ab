"""Two channels of one cell: is what they read the same, and if not, what does the ratio of the two look like?

At every line z = [y_A / g_A, y_B / g_B] = [1, r] s + noise, g the declared dynamics and s the force of the cell, any
number. s is eliminated like the loads of a fit: e = z_B - r z_A, v = var e,

    chi2 = 2 sum |e|^2 / v,     s = z_A - E[n_A e*] e / v,     half gradient = -2 Re sum (dr s)* e / v,

and 2 Re sum (dr s)* (dr s) / v is the information. ln r is a sum of kinds, each zero where its parameter is. What a
channel's own slow high-pass still rings in a record, of unknown size, is projected out of e and dr s run by run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

STEPS = 12
MIN_STEP_GAIN = 1e-6
# Lines that the first value of a parameter is looked for on, and how many values are tried.
FEW_LINES = 600
START_VALUES = 61


@dataclass(frozen=True)
class DifferenceKind:
    """One way in which two channels differ, by a parameter that is zero where they do not.

    `log_ratio` and its derivative `slope` at s = j w (K,); `one_sided`: the parameter is not negative; `values`
    (first, last): sizes among which a first value is looked for.
    """

    name: str
    log_ratio: Callable[[ComplexArray, float], ComplexArray]
    derivative: Callable[[ComplexArray, float], ComplexArray]
    one_sided: bool
    values: tuple[float, float]

    def start_values(self) -> Array:
        """Values (n,) from which a fit may begin."""
        sizes = np.geomspace(*self.values, START_VALUES)
        return sizes if self.one_sided else np.concatenate([-sizes[::-1], sizes])


GAIN = DifferenceKind("gain", lambda s, a: np.full_like(s, a), lambda s, a: np.ones_like(s), False, (1e-5, 1.0))
DELAY = DifferenceKind("delay", lambda s, t: -s * t, lambda s, t: -s, False, (1e-6, 2e-2))
LOW_PASS_B = DifferenceKind(
    "low-pass B", lambda s, t: -np.log(1 + s * t), lambda s, t: -s / (1 + s * t), True, (1e-6, 1.0)
)
LOW_PASS_A = DifferenceKind(
    "low-pass A", lambda s, t: np.log(1 + s * t), lambda s, t: s / (1 + s * t), True, (1e-6, 1.0)
)
HIGH_PASS_B = DifferenceKind(
    "high-pass B", lambda s, r: -np.log(1 + r / s), lambda s, r: -1 / (s + r), True, (1e-3, 1e3)
)
HIGH_PASS_A = DifferenceKind("high-pass A", lambda s, r: np.log(1 + r / s), lambda s, r: 1 / (s + r), True, (1e-3, 1e3))
DIFFERENCE_KINDS = (GAIN, DELAY, LOW_PASS_B, LOW_PASS_A, HIGH_PASS_B, HIGH_PASS_A)
# Those that differ where the parameter is null: there a delay is a low-pass, and A's filters are B's with another sign.
SCORED_KINDS = (GAIN, DELAY, HIGH_PASS_B)


@dataclass(frozen=True)
class PairSpectrum:
    """Lines of two channels: s = j w (K,), forces (K, 2), their noise (K, 2, 2), `factor` (K,) that frees the inverse

    of a measured variance of its bias; `ringing` (K, 2): what a channel's own motion adds to its lines, up to its size
    in each `run` (K,); `gain_sigma`: how well the ratio of the sensitivities is declared.
    """

    s: ComplexArray
    forces: ComplexArray
    covariance: ComplexArray
    factor: Array
    high_pass_transient: ComplexArray
    run: NDArray[np.intp]
    gain_sigma: float = 0.0

    def decimate(self) -> PairSpectrum:
        """Few of them, over the whole band."""
        n = max(1, len(self.s) // FEW_LINES)
        return replace(
            self,
            s=self.s[::n],
            forces=self.forces[::n],
            covariance=self.covariance[::n],
            factor=self.factor[::n],
            high_pass_transient=self.high_pass_transient[::n],
            run=self.run[::n],
        )


@dataclass(frozen=True)
class RatioFit:
    """What was fitted: kinds with their values and sigma (q,), and chi-square at them."""

    kinds: tuple[DifferenceKind, ...]
    values: Array
    sigma: Array
    chi2: float


def ratio_chi2(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], values: Array) -> float:
    """Chi-square with the prior of the gain, where it has one."""
    r = _ratio(lines, kinds, values)
    e, v, _ = _residual(lines, r)
    e = _project_out_transients(lines, r, lines.factor / v, e[:, None])[:, 0]
    return float(2.0 * np.sum(lines.factor * np.abs(e) ** 2 / v)) + _prior(lines, kinds, values)[0]


def _ratio(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], values: Array) -> ComplexArray:
    log = sum((kind.log_ratio(lines.s, value) for kind, value in zip(kinds, values, strict=True)), 0.0 * lines.s)
    return np.asarray(np.exp(log))


def _residual(lines: PairSpectrum, r: ComplexArray) -> tuple[ComplexArray, Array, ComplexArray]:
    """The difference e (K,), its variance (K,) and E[n_A e*] (K,)."""
    C = lines.covariance
    e = lines.forces[:, 1] - r * lines.forces[:, 0]
    shared = C[:, 0, 1] - r.conj() * C[:, 0, 0].real
    v = np.real(C[:, 1, 1]) - 2.0 * np.real(r * C[:, 0, 1]) + np.abs(r) ** 2 * np.real(C[:, 0, 0])
    return e, np.maximum(v, np.finfo(float).tiny), shared


def _project_out_transients(lines: PairSpectrum, r: ComplexArray, weight: Array, values: ComplexArray) -> ComplexArray:
    """Values (K, q) without what a real number in each run times each channel's ringing explains, weighted."""
    for column in (lines.high_pass_transient[:, 1], r * lines.high_pass_transient[:, 0]):
        if not column.any():
            continue
        size = np.bincount(lines.run, weight * np.abs(column) ** 2)
        common = np.stack(
            [np.bincount(lines.run, weight * np.real(column.conj() * value)) for value in values.T], axis=1
        )
        values = values - column[:, None] * (common / np.maximum(size, 1e-300)[:, None])[lines.run]
    return values


def _prior(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], values: Array) -> tuple[float, Array, Array]:
    """Chi-square of the declared gain, half its gradient (q,) and its information (q,)."""
    known = np.array([kind is GAIN and lines.gain_sigma > 0 for kind in kinds], bool)
    weight = np.where(known, 1.0 / max(lines.gain_sigma, 1e-300) ** 2 if lines.gain_sigma else 0.0, 0.0)
    return float(weight @ values**2), weight * values, weight


def ratio_curvature(
    lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], values: Array
) -> tuple[float, Array, Array]:
    """Chi-square, half its gradient (q,) and its information (q, q)."""
    r = _ratio(lines, kinds, values)
    e, v, shared = _residual(lines, r)
    weight = lines.factor / v
    prior, prior_gradient, prior_information = _prior(lines, kinds, values)
    force = lines.forces[:, 0] - shared / v * e
    D = np.empty((len(r), len(kinds)), complex)
    for i, (kind, value) in enumerate(zip(kinds, values, strict=True)):
        D[:, i] = kind.derivative(lines.s, value) * r * force
    left = _project_out_transients(lines, r, weight, np.concatenate([D, e[:, None]], axis=1))
    D, e = left[:, :-1], left[:, -1]
    gradient = -2.0 * np.real(D.conj().T @ (weight * e)) + prior_gradient
    information = 2.0 * np.real((D.conj() * weight[:, None]).T @ D) + np.diag(prior_information)
    return float(2.0 * np.sum(weight * np.abs(e) ** 2)) + prior, gradient, information


def fit_ratio(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], start: Array) -> RatioFit:
    """Gauss-Newton steps from `start` (q,), halved until they gain."""
    low = np.array([0.0 if kind.one_sided else -np.inf for kind in kinds])
    values = np.maximum(start, low)
    chi2, gradient, information = ratio_curvature(lines, kinds, values)
    for _ in range(STEPS if len(kinds) else 0):
        step = -np.linalg.lstsq(information, gradient, rcond=1e-12)[0]
        if -gradient @ step < MIN_STEP_GAIN:
            break
        share = 1.0
        while share > 1e-3 and ratio_chi2(lines, kinds, np.maximum(values + share * step, low)) >= chi2:
            share *= 0.5
        if share <= 1e-3:
            break
        values = np.maximum(values + share * step, low)
        chi2, gradient, information = ratio_curvature(lines, kinds, values)
    return RatioFit(kinds, values, np.sqrt(np.diag(_inverse(information))), chi2)


def _inverse(information: Array) -> Array:
    return np.asarray(np.linalg.pinv(information)) if information.size else information


def fit_with_kind(lines: PairSpectrum, fit: RatioFit, kind: DifferenceKind) -> RatioFit:
    """The fit with one kind more, begun at the best of many values on few lines."""
    few, kinds = lines.decimate(), (*fit.kinds, kind)
    starts = [np.append(fit.values, value) for value in kind.start_values()]
    return fit_ratio(lines, kinds, min(starts, key=lambda at: ratio_chi2(few, kinds, at)))


def score_gain(lines: PairSpectrum, fit: RatioFit, kind: DifferenceKind) -> float:
    """What a kind would gain in chi-square from its derivative where it is null, the fitted ones projected out."""
    _, g, information = ratio_curvature(lines, (*fit.kinds, kind), np.append(fit.values, 0.0))
    inner = _inverse(information[:-1, :-1])
    s = g[-1] - information[-1, :-1] @ inner @ g[:-1]
    V = information[-1, -1] - information[-1, :-1] @ inner @ information[:-1, -1]
    return float(s**2 / V) if 1e-9 * information[-1, -1] < V else 0.0
