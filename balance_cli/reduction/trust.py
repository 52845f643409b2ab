"""Which loads of a record are not to be taken as they are, and why: the flags of a reduction by harmonics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.channel_pairs import PairContradiction, contradicted_pairs
from balance_cli.reduction.choices import MOST_HARMONICS
from balance_cli.reduction.flags import (
    MODEL_CONTRADICTED,
    NOT_STEADY,
    REDUNDANCY,
    UNMODELLED_LINE,
    UNRESOLVED,
    UNTESTED,
    join_flags,
)
from balance_cli.reduction.harmonic_loads import LoadProblem
from balance_cli.reduction.measured_response import unresolved_loads, unresolved_note
from balance_cli.reduction.record_lines import lines_of_record
from balance_cli.reduction.response_sources import ResponseSource, circular_real
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.rotor_record import RotorRecord, at_constant_speed
from balance_cli.reduction.steadiness import Steadiness, examine_steadiness
from balance_cli.reduction.suspect_channels import contradicting_channels, explain_residuals
from balance_cli.reduction.untested_loads import harmonics_to_reject, row_sensors, untested_harmonics
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.signals.rotor.harmonics import count_regressed_harmonics
from balance_cli.signals.rotor.unmodelled_lines import UnmodelledLine

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]

MODEL_ERROR_SHARE = 0.1
"""Standard deviation of a load by the known error of the response, as a share of the load, that flags it.

A hub load known to 10 % does not serve for a comparison of rotors; below, sigma tells enough.
"""
PASSES_TEST = "the residual test is passed"
"""Evidence for a mistake in the channels, where redundant ones show it."""
IS_SMOOTH = "the loads of turbulence then have a smooth spectrum"
"""The same where as many sensors as loads leave no other."""
LEAST_LEAK = 0.3
"""What may leak into a load, over its standard deviation, that flags it: together they are 5 % larger than that. In the
channel where the line is strongest it is so many times the noise, and so it is taken to be in the loads."""


@dataclass(frozen=True)
class Trust:
    """Findings about the loads (n+1, m) of a record: untested, unsteady, contradicted by the model or not resolved.

    `reached` (n+1, m) are the loads that one of the `lines` reaches; `confounded` the harmonics beside which another
    rotor has a line; `pairs` the channels of one cell that contradict each other, so that every load is rejected;
    `regressed` is the highest harmonic of the regression, `steadiness_note` says why all loads are unsteady;
    `wrong_channels` is the mistake in the channels that explains what they contradict, with the `evidence` for it;
    `suspect_note` names channels without which they contradict nothing; `mean_change` (m,) and
    `harmonic_error` (n, m) are those of `Steadiness`.
    """

    untested: Mask
    unsteady: Mask
    contradicted: Mask
    rejected: Mask
    unresolved: Mask
    lines: tuple[UnmodelledLine, ...]
    reached: Mask
    confounded: frozenset[int] = frozenset()
    pairs: tuple[PairContradiction, ...] = ()
    regressed: int = 0
    steadiness_note: str = ""
    wrong_channels: str = ""
    evidence: str = PASSES_TEST
    suspect_note: str = ""
    mean_change: Array | None = None
    harmonic_error: Array | None = None
    passing_note: str = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """The lines and the channels in words."""
        n = len(self.untested) - 1
        channels = f"{self.wrong_channels}: undone, {self.evidence}" if self.wrong_channels else ""
        lines = (line.explain(n, self.regressed) + _remedy(line) for line in self.lines)
        pairs = (pair.description for pair in self.pairs)
        said = (self.suspect_note, self.steadiness_note, self.passing_note, unresolved_note(self.unresolved[1:]))
        return (*filter(None, [channels, *lines, *pairs, *said]),)

    def flags(self, given: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], ...]:
        """Return the flags (n+1, m) of the findings added to those given."""
        return tuple(
            tuple(join_flags((word, *self._words(h, j))) for j, word in enumerate(row)) for h, row in enumerate(given)
        )

    def _words(self, h: int, j: int) -> tuple[str, ...]:
        return (
            UNTESTED if self.untested[h, j] else "",
            REDUNDANCY if self.rejected[h, j] else "",
            NOT_STEADY if self.unsteady[h, j] else "",
            UNMODELLED_LINE if self.reached[h, j] or h in self.confounded else "",
            MODEL_CONTRADICTED if self.contradicted[h, j] else "",
            UNRESOLVED if self.unresolved[h, j] else "",
        )


def _remedy(line: UnmodelledLine) -> str:
    """What reduces a harmonic of the rotor too; no remedy for a tone, nor beyond what can be asked for."""
    within_reach = line.turns_with_rotor and line.order <= MOST_HARMONICS
    return f"; --harmonics {line.order:.0f} reduces it too" if within_reach else ""


@dataclass(frozen=True)
class ReducedRecord:
    """A record and how its loads were reduced: `sigma` (n+1, m) are the standard deviations stated for them.

    `response` is the `harmonic_response` of the record, `solution` that of the `problem`; `static` the matrix of the
    mean loads, which are not examined without one.
    """

    record: RotorRecord
    geometry: Geometry
    source: ResponseSource
    static: TrimCalibration | None
    response: ComplexArray
    problem: LoadProblem
    solution: SolvedLoads
    sigma: Array


@dataclass(frozen=True)
class NonperiodicContent:
    """What a record contains that its harmonics do not: lines beside them, and steps and drifts of the loads."""

    lines: tuple[UnmodelledLine, ...]
    steadiness: Steadiness


def assess_trust(reduced: ReducedRecord) -> Trust:
    """Examine the loads of a record."""
    record, geometry, source = reduced.record, reduced.geometry, reduced.source
    content = _nonperiodic_content(reduced)
    regressed = 0
    if not record.fixed_frequency:
        n = len(reduced.sigma) - 1
        regressed = count_regressed_harmonics(record.run, record.azimuth, n, record.spectra.interval)
    rejected = _rejected_loads(reduced.solution)
    pairs = contradicted_pairs(record, geometry, source, reduced.response)
    is_rejected = bool(pairs) or bool(rejected.all())
    mistakes = explain_residuals(reduced.problem, record, geometry, source, is_rejected)
    by_turbulence, suspect = tuple[str, ...](), ""
    if not is_rejected and not _has_redundant_sensor(reduced):
        from balance_cli.reduction.turbulence_evidence import mistakes_by_turbulence  # few balances need it

        by_turbulence = mistakes_by_turbulence(record, geometry, source)
    if is_rejected and not mistakes:
        suspect = contradicting_channels(record, geometry, source, reduced.solution, reduced.response)
    at = record.spectra.frequency_hz[1:], record.components, record.health.live
    return Trust(
        untested=_untested_loads(reduced),
        unsteady=content.steadiness.unsteady | _below_mean(np.full_like(rejected, bool(record.pulse_doubt))),
        contradicted=_below_mean(source.is_contradicted | _model_error_matters(reduced.solution)) | bool(by_turbulence),
        rejected=_below_mean(rejected) | bool(pairs) | bool(mistakes),
        unresolved=_below_mean(unresolved_loads(source, reduced.solution, *at, reduced.problem.scale)),
        lines=content.lines,
        reached=_below_mean(_reached_loads(content.lines, reduced, regressed)),
        confounded=frozenset(line.order for line in record.confounded),
        pairs=pairs,
        regressed=regressed,
        steadiness_note="; ".join(filter(None, [record.pulse_doubt, content.steadiness.note])),
        wrong_channels=", or ".join(mistakes or by_turbulence),
        evidence=IS_SMOOTH if by_turbulence else PASSES_TEST,
        suspect_note=suspect,
        mean_change=content.steadiness.mean_change,
        harmonic_error=content.steadiness.harmonic_error,
        passing_note=content.steadiness.passing,
    )


def _below_mean(mask: Mask) -> Mask:
    """Return the mask (n+1, m) of all rows for one (n, m) of harmonics, without the mean loads."""
    return np.vstack([np.zeros((1, mask.shape[1]), bool), mask])


def _nonperiodic_content(reduced: ReducedRecord) -> NonperiodicContent:
    """Return the lines beside the harmonics of a record, and which of its loads (n+1, m) are unsteady.

    Where the speed varies, a harmonic is a band over time, and beside a mode its response has lines beside it and
    changes from window to window though the loads are constant. A record with such findings is examined again without
    that change, over time without the harmonics.
    """
    record, geometry, source = reduced.record, reduced.geometry, reduced.source
    lines, reported = lines_of_record(record, source), reduced.solution.loads
    steadiness = examine_steadiness(record, geometry, source, reduced.static, reduced.sigma, reported)
    is_found = not all(line.turns_with_rotor for line in lines) or bool(steadiness.unsteady[1:].any())
    error = steadiness.harmonic_error
    if not is_found and (error is None or not error.any()):
        return NonperiodicContent(lines, steadiness)
    even = at_constant_speed(record, geometry, source)
    if even is None or (even is record and not is_found):
        return NonperiodicContent(lines, steadiness)
    constant_response = reduced.response if even is not record else None
    return NonperiodicContent(
        lines_of_record(even, source, even.residual_spectrum),
        examine_steadiness(even, geometry, source, reduced.static, reduced.sigma, reported, constant_response),
    )


def _untested_loads(reduced: ReducedRecord) -> Mask:
    """Return the loads (n+1, m) that no redundant sensor tests; the mean loads are for the static calibration."""
    untested = (reduced.solution.degrees <= 0) | (not _has_redundant_sensor(reduced))
    return _below_mean(untested[:, None] | _rest_on_one_sensor(reduced))


def _has_redundant_sensor(reduced: ReducedRecord) -> bool:
    """Whether there are more sensors than loads."""
    return sensor_count(reduced.geometry, reduced.record.health.live) > len(reduced.record.components)


def _rejected_loads(solution: SolvedLoads) -> Mask:
    """Return the loads (n, m) of the harmonics that the residual test rejects."""
    rejected = solution.misfit | _response_is_rejected(solution)
    return np.repeat(rejected[:, None], solution.loads.shape[1], axis=1)


def _reached_loads(lines: tuple[UnmodelledLine, ...], reduced: ReducedRecord, regressed: int) -> Mask:
    """Return which loads (n, m) are beside a line, or may contain a part of it that their sigma does not cover.

    A harmonic of the rotor that the regression contains reaches none: the highest row says that the loads go on above.
    """
    record, sigma = reduced.record, reduced.sigma[1:]
    n, m = sigma.shape
    first, last = record.spectra.revolutions
    noise = np.sqrt(np.diagonal(reduced.solution.noise_covariance, axis1=1, axis2=2)).reshape(n, 2, m).max(axis=1)
    reached = np.zeros((n, m), bool)
    for line in lines:
        if line.turns_with_rotor and line.order <= regressed:
            reached[n - 1] = True
            continue
        # Of a tone at a distance, in periods over the record, a regression by harmonics keeps a share below 1/(pi d).
        periods = np.maximum(np.abs(line.order - np.arange(1, n + 1)) * (last - first), 1.0 / np.pi)
        (column,) = record.spectra.columns((line.channel,))
        sigma_channel = np.sqrt(record.spectra.covariance[1:, column, column].real)
        leak = line.amplitude / (np.pi * periods * sigma_channel)
        reached |= leak[:, None] * noise > LEAST_LEAK * sigma
    return reached


def sensor_count(geometry: Geometry, live: tuple[str, ...]) -> int:
    """Return how many cells, sums of cells, torque meters and accelerometers the channels measure.

    Two channels of one source test each other, not the mechanics of the balance: they count once.
    """
    channels = [channel for channel in geometry.channels if channel.name in live]
    return len({channel.source for channel in channels})


def _rest_on_one_sensor(reduced: ReducedRecord) -> Mask:
    """Return which loads (n, m) rest on one sensor."""
    record, solution, m = reduced.record, reduced.solution, reduced.sigma.shape[1]
    rows = reduced.source.channel_combination(record.spectra.frequency_hz[1:2], record.health.live)
    names = row_sensors(record.health.live, rows.rows, reduced.geometry, rows.rows_are_channels)
    variance = np.diagonal(solution.inflated_covariance, axis1=1, axis2=2)
    sigma = np.sqrt(np.maximum(variance[:, :m], variance[:, m:]))
    covariance, problem = None, reduced.problem
    if rows.rows_are_channels and reduced.source.response_error is None and not reduced.source.is_contradicted:
        loads = np.concatenate([solution.loads.real, solution.loads.imag], axis=1)
        covariance = circular_real(problem.weighting) * (4.0 / record.spectra.samples)
        covariance = covariance + problem.response_covariance(loads)
    by_response = problem.response_covariance if rows.rows_are_channels else None
    return untested_harmonics(
        solution.equations, names, solution.degrees, solution.limit, sigma, covariance, by_response
    )


def _response_is_rejected(solution: SolvedLoads) -> bool:
    """Return whether the residual test rejects the response at so many harmonics that no other one can be trusted."""
    rejected = int(np.count_nonzero(solution.misfit))
    return rejected >= harmonics_to_reject(len(solution.misfit))


def _model_error_matters(solution: SolvedLoads) -> Mask:
    """Return where (n, m) the known error of the response exceeds a share of the load and the noise."""
    m = solution.loads.shape[1]
    known, noise = (
        np.diagonal(covariance, axis1=1, axis2=2)[:, :m] + np.diagonal(covariance, axis1=1, axis2=2)[:, m:]
        for covariance in (solution.model_covariance, solution.noise_covariance)
    )
    return np.asarray((known > (MODEL_ERROR_SHARE * np.abs(solution.loads)) ** 2) & (known > noise))


def nearest_trim(calibration: Calibration, loads: RunLoads) -> TrimCalibration:
    """Return the trim whose static matrix belongs to the mean loads of a run."""
    if loads.trim in calibration.trims:
        return calibration.trims[loads.trim]
    return calibration.nearest_trim(dict(zip(loads.components, loads.amplitude[0].real.tolist(), strict=True)))
