"""Whether a calibration and the response of a reduction describe the same rig: C0 against the response at rest.

Both say what a channel that measures constant loads reads for a unit of each hub load. Rigs A to E of the tests, drawn
from their tolerances, with models of sweeps alone: they differ by at most 0.44 % of the range of a channel and 4.0
standard deviations (20 trims).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.diagnosis.consistency.findings import FAULT, STATIC_RESPONSE, WARNING, ConsistencyFinding
from balance_cli.diagnosis.consistency.units import FORCE_UNITS, MOMENT_UNITS, VOLT_UNITS, suggest_units
from balance_cli.io.percent import percent_text
from balance_cli.model.balance import balance_model
from balance_cli.reduction.measured_response import TransferSource
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.steps.measured_static_response import measured_static_response

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LARGEST_SHARE = 0.02
"""Of the range of a channel: a difference below it is left to sigma. Trims of one rig, creep and temperature make up to
1 % between the statics of one day and the sweeps of another; 3 %, an amplifier that was exchanged, is found."""
LARGEST_SIGMAS = 5.0
"""One in two million by chance, for some hundred elements of C0 whose standard errors rest on few rows."""
GROSS_FACTOR = 2.0
"""Factor that no effect of a rig has on what a load mainly reads: units, polarity, another balance."""
MAIN_SHARE = 0.5
"""Share of the range of a channel under the calibrated loads from which an element is one of its main ones."""
EXACT_SHARE = 1e-9
"""Of the largest element: standard deviation of one that is exact, so that its square has a value."""
LEFT_SHARE = 0.1
"""Of the weighted squared differences of a load: what a factor on it may leave of them, to explain them."""
SAME_FACTOR = 0.1
"""Spread of the logarithm of factors that are one: tolerances of a rig and noise stay below it."""


@dataclass(frozen=True)
class StaticComparison:
    """C0 of a trim and the response at rest (r, k) of the same channels and loads [V/N, V/(N m)].

    `sigma` (r, k) is the standard deviation of their difference, `slack` (r, k) what the response at rest may be off
    by besides. `full` (r, k): the element that would read the range of the channel.
    """

    trim: TrimCalibration
    channels: tuple[str, ...]
    C0: Array
    response: Array
    sigma: Array
    slack: Array
    full: Array

    @property
    def significant(self) -> Mask:
        """Where they differ beyond chance."""
        return np.abs(self.C0 - self.response) > LARGEST_SIGMAS * self.sigma + self.slack

    @property
    def differs(self) -> Mask:
        """Where they differ beyond chance and by a share of the range that matters."""
        return self.significant & (np.abs(self.C0 - self.response) > LARGEST_SHARE * self.full + self.slack)

    @property
    def main(self) -> Mask:
        """The elements by which the channels mainly read, of either."""
        return np.maximum(np.abs(self.C0), np.abs(self.response)) >= MAIN_SHARE * self.full

    @property
    def factor(self) -> Array:
        """C0 over the response at rest, infinite where that is zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.response == 0.0, np.inf, self.C0 / self.response)

    @property
    def differs_grossly(self) -> Mask:
        """Where main elements differ by more than any effect explains."""
        within = (self.factor >= 1.0 / GROSS_FACTOR) & (self.factor <= GROSS_FACTOR)
        return self.differs & self.main & ~within

    @property
    def load_factors(self) -> Array:
        """Readings per unit of each load (k,) over those of the response, 1 where that does not differ beyond chance.

        A load that is small beside the others of its channels changes little of their range, and yet all of itself. The
        errors of the elements may have one cause: that of the factor is taken as if they had.
        """
        least = EXACT_SHARE * float(np.max(np.abs(self.response), initial=0.0))
        weight = 1.0 / np.maximum(self.sigma, max(least, np.finfo(float).tiny))
        C0, response, slack = self.C0 * weight, self.response * weight, self.slack * weight
        size = np.maximum(np.sum(response**2, axis=0), np.finfo(float).tiny)
        factor = np.sum(C0 * response, axis=0) / size
        error = np.sum(np.abs(response), axis=0) / size
        limit = np.maximum(LARGEST_SHARE, LARGEST_SIGMAS * error) + np.sum(np.abs(response) * slack, axis=0) / size
        left = np.sum((C0 - factor * response) ** 2, axis=0)
        explains = left < LEFT_SHARE * np.sum((C0 - response) ** 2, axis=0)
        return np.where(explains & (np.abs(factor - 1.0) > limit), factor, 1.0)


def static_findings(
    calibration: Calibration | None, source: ResponseSource, geometry: Geometry
) -> tuple[ConsistencyFinding, ...]:
    """Return what contradicts in a calibration and the response that runs are reduced by, one finding for each trim.

    `geometry` is that of the response, with its effects. Nothing without a calibration, and for responses that do not
    tell their static part: that of the paper's form, the static matrix itself, and measured responses that begin near
    the lowest mode. Faults come first.
    """
    if calibration is None:
        return ()
    findings = [_finding(item, _is_nonlinear(geometry)) for item in _comparisons(calibration, source)]
    return tuple(sorted(filter(None, findings), key=lambda finding: not finding.is_fault))


def _is_nonlinear(geometry: Geometry) -> bool:
    """Whether the response at rest depends on the load; only gross differences count then."""
    if not geometry.effects or missing_mechanics(geometry):
        return False
    return balance_model(geometry).system(derivatives=False).equations.nonlinear_terms > 0


def _comparisons(calibration: Calibration, source: ResponseSource) -> Iterator[StaticComparison]:
    """Yield the comparison of each trim with a response that is known at rest."""
    rest: tuple[tuple[str, ...], Array, Array, Array] | None = None
    if source.system is not None:
        value, sigma = _model_at_rest(source)
        rest = (source.system.channel_names, value, sigma, np.zeros_like(value))
    elif isinstance(source, TransferSource):
        measured = measured_static_response(source, calibration.geometry)
        rest = None if measured is None else (source.channel_names, *measured)
    for trim in calibration.trims.values() if rest is not None else ():
        assert rest is not None
        comparison = _compare(trim, source, *rest)
        comparison = comparison if calibration.errors_known else _compare_loads(comparison)
        if comparison.channels:
            yield comparison


def _model_at_rest(source: ResponseSource) -> tuple[Array, Array]:
    """Return the response (c, 6) of a model at rest with its standard deviation, its misfit included."""
    rest = np.zeros(1)
    value = source.at(rest, 0.0)[0].real
    variance = np.zeros_like(value)
    for j in range(len(COMPONENTS)):
        unit = np.eye(len(COMPONENTS), dtype=complex)[j : j + 1]
        variance[:, j] = np.diag(source.covariance(rest, 0.0, unit)[0])[: len(value)]
        if source.response_error is not None:  # known from the lowest band on
            missed = source.response_error.covariance(source.response_error.frequency[:1], unit)[0]
            variance[:, j] += np.diag(missed).real
    return value, np.sqrt(variance)


def _compare(
    trim: TrimCalibration, source: ResponseSource, names: tuple[str, ...], value: Array, sigma: Array, slack: Array
) -> StaticComparison:
    """Return the comparison for the channels of a trim that a response has and no diagnosis has left out."""
    usable = [
        name
        for name in trim.channel_names
        if name in names and name not in source.untrusted_channels and np.any(value[names.index(name)])
    ]
    own = [trim.channel_names.index(name) for name in usable]
    other = np.ix_([names.index(name) for name in usable], [COMPONENTS.index(name) for name in trim.components])
    C0, largest = trim.C0[own], np.where(trim.calibrated_range > 0.0, trim.calibrated_range, np.inf)
    reading = np.max(np.where(np.isfinite(largest), np.abs(C0) * largest, 0.0), axis=1, initial=0.0)
    error = np.hypot(sigma[other], np.nan_to_num(trim.C0_sigma[own]))
    return StaticComparison(
        trim, tuple(usable), C0, value[other], error, slack[other], reading[:, None] / largest[None, :]
    )


def _compare_loads(comparison: StaticComparison) -> StaticComparison:
    """Return the comparison of a matrix that states loads of readings alone, T0 (k, r).

    With more channels than loads, it leaves open what these read: readings R f of the response count as loads T0 R f,
    so that R (T0 R)^-1 are those of a unit of them.
    """
    T0, response = comparison.trim.T0, comparison.response
    if T0.shape[1] == T0.shape[0] or comparison.channels != comparison.trim.channel_names:
        return comparison
    loads = T0 @ response
    is_regular = np.linalg.matrix_rank(loads) == len(loads)
    return replace(comparison, C0=response @ np.linalg.inv(loads)) if is_regular else comparison


def _finding(comparison: StaticComparison, is_nonlinear: bool) -> ConsistencyFinding | None:
    """Return the finding of a comparison, None where it is within its limits."""
    is_gross = bool(comparison.differs_grossly.any())
    differing = comparison.differs_grossly if is_gross else comparison.differs
    if is_nonlinear and not is_gross:
        return None
    if not differing.any():
        return _load_finding(comparison)
    rows, columns = np.nonzero(differing)
    channels = tuple(comparison.channels[i] for i in dict.fromkeys(rows.tolist()))
    components = tuple(name for j, name in enumerate(comparison.trim.components) if j in columns)
    return ConsistencyFinding(
        kind=STATIC_RESPONSE,
        severity=FAULT if is_gross else WARNING,
        text=f"{_describe(comparison, differing)} ({_cause(comparison, differing, is_gross)})",
        runs=comparison.trim.runs,
        channels=channels,
        components=components,
        factor=_common_factor(comparison.factor[differing]),
        trims=(comparison.trim.trim,),
    )


def _load_finding(comparison: StaticComparison) -> ConsistencyFinding | None:
    """Return which loads of a trim have another size than those of the response; None where none has."""
    factors = comparison.load_factors
    wrong = np.flatnonzero(factors != 1.0)
    if not len(wrong):
        return None
    names = tuple(comparison.trim.components[j] for j in wrong)
    shown = ", ".join(f"{name} {1.0 / factors[j]:.4g}" for name, j in zip(names, wrong, strict=True))
    label = f"trim `{comparison.trim.trim}`: " if comparison.trim.trim else ""
    text = f"{label}loads of the calibration over those of the response at rest: {shown} (another lever or weight?)"
    factor = _common_factor(factors[wrong])
    trims = (comparison.trim.trim,)
    return ConsistencyFinding(
        STATIC_RESPONSE, WARNING, text, comparison.trim.runs, components=names, factor=factor, trims=trims
    )


def _describe(comparison: StaticComparison, differing: Mask) -> str:
    """Return trim, and channel and component of the largest difference."""
    share = np.where(differing, np.abs(comparison.C0 - comparison.response) / comparison.full, 0.0)
    i, j = np.unravel_index(np.argmax(share), share.shape)
    channel, component = comparison.channels[i], comparison.trim.components[j]
    ratio = comparison.factor[i, j]
    by = f", {ratio:.3g} times" if np.isfinite(ratio) and comparison.main[i, j] else ""
    others = int(differing.sum()) - 1
    more = f", and {others} more of its elements" if others else ""
    label = f"trim `{comparison.trim.trim}`: " if comparison.trim.trim else ""
    return (
        f"{label}calibration and response at rest differ by {percent_text(share[i, j], 3)} % of the range of "
        f"`{channel}` under {component}{by}{more}"
    )


def _common_factor(factors: Array) -> float | None:
    """Return the factor of all elements, None where they have none in common."""
    if not len(factors) or not np.all(np.isfinite(factors)) or np.any(factors == 0.0):
        return None
    logs = np.log(np.abs(factors))
    same = np.ptp(logs) < 2 * SAME_FACTOR and len(set(np.sign(factors))) == 1
    return float(np.sign(factors[0]) * np.exp(np.median(logs))) if same else None


def _cause(comparison: StaticComparison, differing: Mask, is_gross: bool) -> str:
    """Return what explains the differences most simply: loads, channels, or another rig."""
    if not is_gross:
        return "was an amplifier, a load cell or the rig changed between them, or does the model lack an effect?"
    rows, columns = np.atleast_1d(differing.any(axis=1)), np.atleast_1d(differing.any(axis=0))
    by_load = _factors(comparison, differing, columns[None, :])
    by_channel = _factors(comparison, differing, rows[:, None])
    causes = {}
    if by_load:
        causes[_load_cause(comparison.trim.components, by_load)] = len(by_load)
    if by_channel:
        shown = ", ".join(f"`{comparison.channels[i]}` {factor:.3g} times" for i, factor in by_channel.items())
        causes[f"gain or polarity of {shown} that of the response"] = len(by_channel)
    simplest = [cause for cause, size in causes.items() if size == min(causes.values())]
    return "; or ".join(simplest) or "is the calibration that of another balance, or the response that of another rig?"


def _factors(comparison: StaticComparison, differing: Mask, lines: Mask) -> dict[int, float]:
    """Return the factor of each row (`lines` (r, 1)) or column (1, k); empty unless each has one throughout."""
    if np.any(comparison.main & lines & ~differing):
        return {}
    factor, wrong = comparison.factor, differing
    if lines.shape[0] == 1:
        factor, wrong = factor.T, wrong.T
    common = {int(i): _common_factor(factor[i, wrong[i]]) for i in np.flatnonzero(lines)}
    return {} if None in common.values() else {i: value for i, value in common.items() if value is not None}


def _load_cause(components: tuple[str, ...], by_load: dict[int, float]) -> str:
    """Return what explains that the readings for these loads are this factor larger than the response says."""
    common = _common_factor(np.array(list(by_load.values())))
    if common is None:
        return "; ".join(_load_cause(components, {j: factor}) for j, factor in by_load.items())
    names = [components[j] for j in by_load]
    if common < 0:
        return f"{', '.join(names)} of the calibration and of the response have opposite signs"
    units = FORCE_UNITS if names[0].startswith("F") else MOMENT_UNITS
    loads, volts = suggest_units(1.0 / common, units), suggest_units(common, VOLT_UNITS)
    text = f"{', '.join(names)} of the calibration {1 / common:.3g} times those of the response"
    return text + (f", {loads}" if loads else "") + (f" Or the channels: {volts}" if volts else "")
