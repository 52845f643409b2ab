"""Which loads of a record are not to be taken as they are, and why: the flags of a reduction by harmonics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.channel_pairs import PairContradiction, contradicted_pairs
from balance_cli.reduction.choices import MOST_HARMONICS
from balance_cli.reduction.flags import (
    FILTER_CONTRADICTED,
    MODEL_CONTRADICTED,
    NOT_STEADY,
    REDUNDANCY,
    UNMODELLED_LINE,
    UNTESTED,
    join_flags,
)
from balance_cli.reduction.harmonic_loads import LoadProblem
from balance_cli.reduction.kalman.innovations import InnovationTests, rms_autocorrelation, slow_power
from balance_cli.reduction.record_lines import lines_of_record
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.rotor_record import RotorRecord, at_constant_speed
from balance_cli.reduction.steadiness import Steadiness, examine_steadiness
from balance_cli.reduction.suspect_channels import contradicting_channels, explain_residuals
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
FEWEST_REJECTED, REJECTED_SHARE = 3, 1.0 / 3.0
"""Harmonics, and share of them, at which the residual test rejects the response, from which it is rejected at all: the
others have less redundancy or more noise. By chance three of eight are one in ten million."""
LEAST_LEAK = 0.3
"""What may leak into a load, over its standard deviation, that flags it: together they are 5 % larger than that. In the
channel where the line is strongest it is so many times the noise, and so it is taken to be in the loads."""
SMALLEST_NIS, LARGEST_NIS = 0.8, 1.25
"""Normalized innovation squared of a filter whose sigma is right to within 12 %."""
LARGEST_AUTOCORRELATION = 0.15
"""Root-mean-square autocorrelation of the innovations, beyond chance, of a filter that follows its record.

A line that adds the share p to their variance makes it p/(1 + p)/sqrt(2), 0.14 at the limit of the NIS. It is up to
0.08 in records of six simulated rigs whose loads are right, probably as their fluctuation has another spectrum than the
load model. Unlike the whiteness statistic it does not grow with the length of the record.
"""
LARGEST_SLOW_POWER = 2.0
"""Spectral density of the innovations of a channel toward zero frequency, over that of white ones, where the filter
follows slow changes: up to 1.4 on records that it follows, 2.9 after a step of a load."""


@dataclass(frozen=True)
class Trust:
    """Findings about the loads (n+1, m) of a record: which are untested, unsteady, or contradicted by the model.

    `reached` (n+1, m) are the loads that one of the `lines` reaches; `confounded` the harmonics beside which another
    rotor has a line; `pairs` the channels of one cell that contradict each other, so that every load is rejected;
    `regressed` is the highest harmonic of the regression, `steadiness_note` says why all loads are unsteady;
    `wrong_channels` is the mistake in the channels that explains what they contradict, `suspect_note` names channels
    without which they contradict nothing.
    """

    untested: Mask
    unsteady: Mask
    contradicted: Mask
    rejected: Mask
    lines: tuple[UnmodelledLine, ...]
    reached: Mask
    confounded: frozenset[int] = frozenset()
    pairs: tuple[PairContradiction, ...] = ()
    regressed: int = 0
    steadiness_note: str = ""
    wrong_channels: str = ""
    suspect_note: str = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """The lines and the channels in words."""
        n = len(self.untested) - 1
        channels = f"{self.wrong_channels}: undone, the residual test is passed" if self.wrong_channels else ""
        lines = (line.explain(n, self.regressed) + _remedy(line) for line in self.lines)
        pairs = (pair.description for pair in self.pairs)
        return (*filter(None, [channels, *lines, *pairs, self.suspect_note, self.steadiness_note]),)

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
        )


def _remedy(line: UnmodelledLine) -> str:
    """What reduces a harmonic of the rotor too; no remedy for a tone, nor beyond what can be asked for."""
    within_reach = line.turns_with_rotor and line.order <= MOST_HARMONICS
    return f"; --harmonics {line.order:.0f} reduces it too" if within_reach else ""


def assess_trust(
    record: RotorRecord,
    geometry: Geometry,
    source: ResponseSource,
    static: TrimCalibration | None,
    response: ComplexArray,
    problem: LoadProblem,
    solution: SolvedLoads,
    sigma: Array,
) -> Trust:
    """Examine the loads of a record; `sigma` (n+1, m) are the standard deviations stated for them.

    `response` is its `harmonic_response`, `problem` what was solved.
    Without a `static` calibration the mean loads are not examined.
    """
    shape, m = sigma.shape, sigma.shape[1]
    untested, contradicted, rejected = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool)
    untested[1:] = (solution.degrees <= 0)[:, None] | (sensor_count(geometry, record.health.live) <= m)
    rejected[1:] = solution.misfit[:, None] | _response_is_rejected(solution)
    contradicted[1:] = source.is_contradicted | _model_error_matters(solution)
    n = shape[0] - 1
    regressed, reached = 0, np.zeros(shape, bool)
    lines, steadiness = _lines_and_steadiness(record, geometry, source, static, response, sigma)
    if not record.fixed_frequency:
        regressed = count_regressed_harmonics(record.run, record.azimuth, n, record.spectra.interval)
        reached[1:] = _reached_loads(lines, record, regressed, solution, sigma[1:])
    pairs = contradicted_pairs(record, geometry, source, response)
    is_rejected = bool(pairs) or bool(rejected[1:].all())
    wrong = ", or ".join(explain_residuals(problem, record, geometry, source, is_rejected))
    examine = is_rejected and not wrong
    suspect = contradicting_channels(record, geometry, source, solution, response) if examine else ""
    rejected |= bool(pairs) or bool(wrong)
    shared = frozenset(line.order for line in record.confounded)
    unsteady = steadiness.unsteady | (bool(record.pulse_doubt) & (np.arange(n + 1) > 0)[:, None])
    tests = unsteady, contradicted, rejected, lines, reached, shared, pairs, regressed
    doubt = "; ".join(filter(None, [record.pulse_doubt, steadiness.note]))
    return Trust(untested, *tests, doubt, wrong, suspect)


def _lines_and_steadiness(
    record: RotorRecord,
    geometry: Geometry,
    source: ResponseSource,
    static: TrimCalibration | None,
    response: ComplexArray,
    sigma: Array,
) -> tuple[tuple[UnmodelledLine, ...], Steadiness]:
    """Return the lines beside the harmonics of a record, and which of its loads (n+1, m) are unsteady.

    Where the speed varies, a harmonic is a band over time, and beside a mode its response has lines beside it and
    changes from window to window though the loads are constant. A record with such findings is examined again without
    that change, over time without the harmonics.
    """
    lines = lines_of_record(record, source)
    steadiness = examine_steadiness(record, geometry, source, static, sigma)
    if all(line.turns_with_rotor for line in lines) and not steadiness.unsteady[1:].any():
        return lines, steadiness
    even = at_constant_speed(record, geometry, source)
    if even is None:
        return lines, steadiness
    constant_response = response if even is not record else None
    steadiness = examine_steadiness(even, geometry, source, static, sigma, constant_response)
    return lines_of_record(even, source, even.residual_spectrum), steadiness


def _reached_loads(
    lines: tuple[UnmodelledLine, ...], record: RotorRecord, regressed: int, solution: SolvedLoads, sigma: Array
) -> Mask:
    """Which loads (n, m) stand beside a line, or may have a part of it that their `sigma` (n, m) does not cover.

    A harmonic of the rotor that the regression contains reaches none: the highest row says that the loads go on above.
    """
    n, m = sigma.shape
    first, last = record.spectra.revolutions
    noise = np.sqrt(np.diagonal(solution.noise_covariance, axis1=1, axis2=2)).reshape(n, 2, m).max(axis=1)
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


def _response_is_rejected(solution: SolvedLoads) -> bool:
    """Return whether the residual test rejects the response at so many harmonics that no other one can be trusted."""
    rejected = int(np.count_nonzero(solution.misfit))
    return rejected >= max(FEWEST_REJECTED, REJECTED_SHARE * len(solution.misfit))


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


def filter_is_contradicted(tests: InnovationTests | None) -> bool:
    """Return whether the innovations of a filter are not of the size that it states, or not white."""
    return tests is not None and (innovations_have_wrong_size(tests) or innovations_are_correlated(tests))


def innovations_have_wrong_size(tests: InnovationTests) -> bool:
    """Return whether the innovations of a filter are larger or smaller than it states."""
    return not SMALLEST_NIS <= tests.nis <= LARGEST_NIS


def innovations_are_correlated(tests: InnovationTests) -> bool:
    """Return whether the innovations of a filter predict each other: it does not follow the record."""
    return rms_autocorrelation(tests) > LARGEST_AUTOCORRELATION or slow_power(tests) > LARGEST_SLOW_POWER


def flag_filter(loads: RunLoads, tests: InnovationTests | None) -> RunLoads:
    """Return the loads, all flagged where the innovations contradict the filter that estimated them."""
    return flag_all(loads, FILTER_CONTRADICTED) if filter_is_contradicted(tests) else loads


def flag_all(loads: RunLoads, flag: str, first_harmonic: int = 0) -> RunLoads:
    """Return the loads with a flag at every row, or at those from a harmonic on."""
    flags = (
        tuple(join_flags((word, flag)) for word in row) if harmonic >= first_harmonic else row
        for harmonic, row in enumerate(loads.flags)
    )
    return replace(loads, flags=tuple(flags))
