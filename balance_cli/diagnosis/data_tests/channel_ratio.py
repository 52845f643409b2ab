"""The ratio of two channels of one cell: whether it is one, and what makes it differ.

At every line z = [y_A / g_A, y_B / g_B] = [1, r] s + noise, g being the declared dynamics and s the unknown force of
the cell. s is eliminated like the loads of a fit: with e = z_B - r z_A and v = var e,

    chi2 = 2 sum |e|^2 / v,     s = z_A - E[n_A e*] e / v,     half gradient = -2 Re sum (dr s)* e / v,

and 2 Re sum (dr s)* (dr s) / v is the information. ln r is a sum of kinds of difference, each zero where its parameter
is. The transient of a channel's own slow high-pass, of unknown size in each run, is projected out of e and dr s.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.data_test_settings import ChannelPairSettings
from balance_cli.model.effects import EFFECTS, Effect
from balance_cli.model.effects.search_hints import ChannelRatio

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class DifferenceKind:
    """One way in which two channels differ: an effect in the second channel (B), or in the first one (A)."""

    effect: Effect
    ratio: ChannelRatio
    in_first: bool = False

    @property
    def sign(self) -> float:
        """Sign with which the effect's logarithm enters ln r."""
        return -1.0 if self.in_first else 1.0

    def log_ratio(self, s: ComplexArray, value: float) -> ComplexArray:
        """Logarithm of r (K,) at s = j w."""
        return np.asarray(self.sign * self.ratio.log_ratio(s, value))

    def derivative(self, s: ComplexArray, value: float) -> ComplexArray:
        """Derivative of ln r (K,) with respect to the parameter."""
        return np.asarray(self.sign * self.ratio.derivative(s, value))

    def start_values(self, count: int, s: ComplexArray) -> Array:
        """Values (n,) from which a fit of lines at s = j w may begin, `count` of each sign."""
        sizes = np.geomspace(*self.ratio.sizes, count) * np.median(np.abs(s)) ** self.ratio.rate_exponent
        return sizes if self.ratio.one_sided else np.concatenate([-sizes[::-1], sizes])


def _difference_kinds() -> Iterator[DifferenceKind]:
    """The kinds whose parameter has either sign, then the one-sided ones, which are in the second or the first channel.

    A parameter of either sign covers both channels.
    """
    ratios = [(effect, effect.search.channel_ratio) for effect in EFFECTS]
    known = [(effect, ratio) for effect, ratio in ratios if ratio is not None]
    yield from (DifferenceKind(effect, ratio) for effect, ratio in known if not ratio.one_sided)
    for effect, ratio in known:
        if ratio.one_sided:
            yield DifferenceKind(effect, ratio)
            yield DifferenceKind(effect, ratio, in_first=True)


def _distinct_at_null(kinds: tuple[DifferenceKind, ...]) -> Iterator[DifferenceKind]:
    """The kinds whose derivatives at the null differ: there a low-pass is a delay, and A's filters are B's negative."""
    s = 2j * np.pi * np.array([1.0, 10.0])
    derivatives: list[ComplexArray] = []
    for kind in kinds:
        derivative = kind.derivative(s, 0.0)
        if not any(np.allclose(derivative, sign * earlier) for earlier in derivatives for sign in (1.0, -1.0)):
            derivatives.append(derivative)
            yield kind


DIFFERENCE_KINDS = tuple(_difference_kinds())
SCORED_KINDS = tuple(_distinct_at_null(DIFFERENCE_KINDS))
"""The kinds of which a score test tests the null."""
TOLERATED_KINDS = tuple(kind for kind in DIFFERENCE_KINDS if kind.ratio.sensitivity)
"""The kinds that the declared tolerance of the sensitivities covers."""


@dataclass(frozen=True)
class PairSpectrum:
    """Spectral lines of two channels, as forces of their cell.

    `s` = j w (K,); `forces` (K, 2) and their noise covariance (K, 2, 2); `factor` (K,) removes the bias of the inverse
    of a measured variance; `high_pass_transient` (K, 2): the lines of each channel's own transient, up to its size in
    each `run` (K,); `gain_sigma`: standard deviation of the ratio of the declared sensitivities.
    """

    s: ComplexArray
    forces: ComplexArray
    covariance: ComplexArray
    factor: Array
    high_pass_transient: ComplexArray
    run: NDArray[np.intp]
    gain_sigma: float = 0.0

    def decimate(self, count: int) -> PairSpectrum:
        """About `count` of the lines, over the whole band."""
        n = max(1, len(self.s) // count)
        return replace(
            self,
            s=self.s[::n],
            forces=self.forces[::n],
            covariance=self.covariance[::n],
            factor=self.factor[::n],
            high_pass_transient=self.high_pass_transient[::n],
            run=self.run[::n],
        )

    def select_run(self, number: int) -> PairSpectrum:
        """The lines of one run."""
        keep = self.run == number
        names = ("s", "forces", "covariance", "factor", "high_pass_transient", "run")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})


@dataclass(frozen=True)
class RatioFit:
    """A fit: the kinds with their values and standard deviations (q,), and chi-square."""

    kinds: tuple[DifferenceKind, ...]
    values: Array
    sigma: Array
    chi2: float


def ratio_chi2(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], values: Array) -> float:
    """Chi-square with the prior of the ratio of the sensitivities."""
    r = _ratio(lines, kinds, values)
    e, v, _ = _residual(lines, r)
    e = _project_out_transients(lines, r, lines.factor / v, e[:, None])[:, 0]
    return float(2.0 * np.sum(lines.factor * np.abs(e) ** 2 / v)) + _prior(lines, kinds, values)[0]


def _ratio(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], values: Array) -> ComplexArray:
    log = sum((kind.log_ratio(lines.s, value) for kind, value in zip(kinds, values, strict=True)), 0.0 * lines.s)
    return np.asarray(np.exp(log))


def remove_ratio(lines: PairSpectrum, fit: RatioFit) -> PairSpectrum:
    """The lines with the fitted ratio taken out, so that their channels are equal but for what the fit leaves."""
    factor = np.stack([_ratio(lines, fit.kinds, fit.values), np.ones(len(lines.s))], axis=1)
    return replace(
        lines,
        forces=lines.forces * factor,
        covariance=lines.covariance * factor[:, :, None] * factor[:, None, :].conj(),
        high_pass_transient=lines.high_pass_transient * factor,
        gain_sigma=0.0,
    )


def _residual(lines: PairSpectrum, r: ComplexArray) -> tuple[ComplexArray, Array, ComplexArray]:
    """The difference e (K,), its variance (K,) and E[n_A e*] (K,)."""
    C = lines.covariance
    e = lines.forces[:, 1] - r * lines.forces[:, 0]
    shared = C[:, 0, 1] - r.conj() * C[:, 0, 0].real
    v = np.real(C[:, 1, 1]) - 2.0 * np.real(r * C[:, 0, 1]) + np.abs(r) ** 2 * np.real(C[:, 0, 0])
    return e, np.maximum(v, np.finfo(float).tiny), shared


def _project_out_transients(lines: PairSpectrum, r: ComplexArray, weight: Array, values: ComplexArray) -> ComplexArray:
    """Values (K, q) with the transients of both channels projected out, a real factor for each channel and run."""
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
    """Chi-square of the declared sensitivities, half its gradient (q,) and its information (q,)."""
    known = np.array([kind in TOLERATED_KINDS and lines.gain_sigma > 0 for kind in kinds], bool)
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
    projected = _project_out_transients(lines, r, weight, np.concatenate([D, e[:, None]], axis=1))
    D, e = projected[:, :-1], projected[:, -1]
    gradient = -2.0 * np.real(D.conj().T @ (weight * e)) + prior_gradient
    information = 2.0 * np.real((D.conj() * weight[:, None]).T @ D) + np.diag(prior_information)
    return float(2.0 * np.sum(weight * np.abs(e) ** 2)) + prior, gradient, information


def fit_ratio(
    lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], start: Array, settings: ChannelPairSettings
) -> RatioFit:
    """The fit by Gauss-Newton steps from `start` (q,), halved until they lower chi-square."""
    low = np.array([0.0 if kind.ratio.one_sided else -np.inf for kind in kinds])
    values = np.maximum(start, low)
    chi2, gradient, information = ratio_curvature(lines, kinds, values)
    for _ in range(settings.steps if len(kinds) else 0):
        step = -np.linalg.lstsq(information, gradient, rcond=1e-12)[0]
        if -gradient @ step < settings.min_step_gain:
            break
        share = 1.0
        while (
            share > settings.min_step_fraction
            and ratio_chi2(lines, kinds, np.maximum(values + share * step, low)) >= chi2
        ):
            share *= 0.5
        if share <= settings.min_step_fraction:
            break
        values = np.maximum(values + share * step, low)
        chi2, gradient, information = ratio_curvature(lines, kinds, values)
    return RatioFit(kinds, values, np.sqrt(np.diag(_inverse(information))), chi2)


def _inverse(information: Array) -> Array:
    return np.asarray(np.linalg.pinv(information)) if information.size else information


def fit_with_kind(lines: PairSpectrum, fit: RatioFit, kind: DifferenceKind, settings: ChannelPairSettings) -> RatioFit:
    """The fit with one kind more, started at the value that is best on few lines."""
    few, kinds = lines.decimate(settings.start_lines), (*fit.kinds, kind)
    starts = kind.start_values(settings.start_values, lines.s)
    best = starts[int(np.argmin(_chi2_of_starts(few, kinds, fit.values, starts)))]
    return fit_ratio(lines, kinds, np.append(fit.values, best), settings)


def _chi2_of_starts(lines: PairSpectrum, kinds: tuple[DifferenceKind, ...], fitted: Array, starts: Array) -> Array:
    """`ratio_chi2` (n,) at each of n values of the last kind, beside the `fitted` values of the others."""
    r = _ratio(lines, kinds[:-1], fitted) * np.exp([kinds[-1].log_ratio(lines.s, value) for value in starts])
    e, v, _ = _residual(lines, r)
    weight = lines.factor / v
    of_run = np.equal(lines.run[:, None], np.arange(lines.run.max(initial=0) + 1)).astype(float)
    for column in (lines.high_pass_transient[:, 1], r * lines.high_pass_transient[:, 0]):
        if column.any():
            size = (weight * np.abs(column) ** 2) @ of_run
            common = (weight * np.real(column.conj() * e)) @ of_run
            e = e - column * (common / np.maximum(size, 1e-300))[:, lines.run]
    prior = [_prior(lines, kinds, np.append(fitted, value))[0] for value in starts]
    return np.asarray(2.0 * np.sum(weight * np.abs(e) ** 2, axis=1) + prior)


def score_gain(lines: PairSpectrum, fit: RatioFit, kind: DifferenceKind, min_information_share: float) -> float:
    """The score statistic of a kind at its null: the gain in chi-square that its derivative predicts.

    The fitted kinds are projected out. Zero where they leave no more than `min_information_share`.
    """
    _, g, information = ratio_curvature(lines, (*fit.kinds, kind), np.append(fit.values, 0.0))
    inner = _inverse(information[:-1, :-1])
    s = g[-1] - information[-1, :-1] @ inner @ g[:-1]
    V = information[-1, -1] - information[-1, :-1] @ inner @ information[:-1, -1]
    return float(s**2 / V) if min_information_share * information[-1, -1] < V else 0.0
