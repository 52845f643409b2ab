"""What is wrong with the channels of a run, by their residuals alone: two exchanged, one reversed, a factor.

Wind-on no load is known. But readings from which a mistake is taken leave residuals of noise, and of no other mistake
do they. A mistake is the same at all harmonics, which are therefore taken together. Where no mistake explains what the
residual test rejects, one or two channels may, without which it is passed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel_groups import ALL, channel_groups
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.harmonic_loads import LoadProblem, harmonic_loads
from balance_cli.reduction.response_sources import ResponseSource, circular_real, stacked_real
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.untested_loads import LEAST_MISFIT
from balance_cli.reduction.weighted_least_squares import SolvedLoads, redundant_directions, residual_chi2

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SUSPECT_SHARE = 0.5
"""Share of rejected harmonics from which a channel is looked for: a fault of a channel shows in all of them."""
EXPLAINED_SHARE = 0.2
"""Share of the harmonics that may be rejected without the mistake, or without the channels that are to blame."""
REMAINING_SHARE = 0.05
"""Of the squared residuals that may remain without the mistake, as in the cross-checks of runs with known loads."""
REMAINING_WHERE_REJECTED = 0.2
"""The same where the redundant channels contradict the record anyway: what is sought is the name. Short records contain
transients, too."""
LEAD = 25.0
"""By how much chi-square must be larger with any other mistake: five standard deviations. Where the response misses
more than noise, so many times what it leaves per degree of freedom."""
MOST_ALTERNATIVES = 3
"""Mistakes that are named together where the residuals do not tell them apart: with two channels in each of six cells,
exchanged strain channels look like exchanged piezo channels."""
LARGEST_FACTOR = 1e6
"""Of a channel; a larger one says that its readings are rather left out than corrected."""
EXAMINED = 6
"""Mistakes that are tried by the noise that channels have without them: first that of the record ranks them."""
SIGN_TOLERANCE = 0.2
"""Departure of a factor from -1 that is still taken for a sign."""
PAIR_CANDIDATES = 6
"""Channels whose pairs are left out on trial: those without which the least contradiction remains."""


@dataclass(frozen=True)
class ChannelMistake:
    """What was done to the readings (r,) of all channels, as a matrix (r, r), and chi-square without it.

    `names` are the channels in words; `scaled` (r,) tells those that have one factor, which an exchange does not have.
    """

    matrix: Array
    names: str
    chi2: float
    scaled: NDArray[np.bool_] | None = None

    @property
    def description(self) -> str:
        """The mistake in words."""
        if self.scaled is None:
            return f"{self.names} are exchanged"
        factor, several = float(self.matrix[self.scaled, self.scaled][0]), np.count_nonzero(self.scaled) > 1
        reads, is_reversed = ("read", "are reversed") if several else ("reads", "is reversed")
        if abs(factor + 1.0) < SIGN_TOLERANCE:
            return f"{self.names} {is_reversed}"
        sign = "" if factor > 0.0 else f"{is_reversed} and "
        return f"{self.names} {sign}{reads} {abs(factor):.4g} times what the other channels say"


def explain_residuals(
    problem: LoadProblem, record: RotorRecord, geometry: Geometry, source: ResponseSource, is_rejected: bool
) -> tuple[str, ...]:
    """Return the mistake in the channels that explains all residuals, in words; several that explain them alike.

    `problem` is the `load_problem` of the record; `is_rejected`: whether redundant channels are known to contradict it.
    Empty where nothing explains the residuals, or too much does. Channels that no redundant channel tests are not
    judged.
    """
    live, samples = record.health.live, record.spectra.samples
    degrees = 2.0 * len(problem.T) * (problem.T.shape[1] - problem.T.shape[2])
    if degrees <= 0.0 or source.is_contradicted or not (is_rejected or source.response_error is None):
        return ()
    if not source.channel_combination(record.spectra.frequency_hz[1:2], live).rows_are_channels:
        return ()
    if _channel_noise_chi2(problem, samples) < LEAST_MISFIT * degrees:
        return ()
    (residuals,) = _residuals([problem], samples)
    if residuals.chi2 < LEAST_MISFIT * degrees:
        return ()
    mistakes = [*_exchanges(residuals, live, geometry), *_factors(residuals, live, geometry)]
    likeliest = sorted(mistakes, key=attrgetter("chi2"))[:EXAMINED]
    share = REMAINING_WHERE_REJECTED if is_rejected else REMAINING_SHARE
    near = _explaining(likeliest, problem, samples, share, degrees)
    few = near if len(near) <= MOST_ALTERNATIVES else []
    return tuple(item.description for item in few if _passes_test(_undone(item, problem)))


def _explaining(
    mistakes: Sequence[ChannelMistake], problem: LoadProblem, samples: int, share: float, degrees: float
) -> list[ChannelMistake]:
    """Return the mistakes that leave at most a share of chi-square, hardly more than the one that leaves least.

    Loads that a mistake makes large have large errors of the response. Mistakes are compared by their own errors and by
    those of the best one.
    """
    trials = [mistake for mistake in _examine(mistakes, problem, samples) if np.isfinite(mistake.chi2)]
    if not trials:
        return []
    error = problem.response_covariance(_undone(min(trials, key=attrgetter("chi2")), problem).loads())
    by_same = _examine(trials, problem, samples, error)
    least = [min(pair, key=attrgetter("chi2")) for pair in zip(trials, by_same, strict=True)]
    best = min(least, key=attrgetter("chi2")).chi2
    if best > share * _residuals([problem], samples, error)[0].chi2:
        return []
    return [item for item in least if item.chi2 <= best + LEAD * max(1.0, best / degrees)]


def _channel_noise_chi2(problem: LoadProblem, samples: int) -> float:
    """Return chi-square by the noise of the channels alone, as if the response were exact: more than it is."""
    N = np.linalg.qr(problem.T, mode="complete").Q[:, :, problem.T.shape[2] :]
    residual = np.einsum("hrq,hr->hq", N.conj(), problem.readings)[:, :, None]
    weighted = np.linalg.solve(np.swapaxes(N.conj(), 1, 2) @ problem.weighting @ N, residual)
    return float(0.5 * samples * np.sum((residual.conj() * weighted).real))


@dataclass(frozen=True)
class _Residuals:
    """Readings (h, 2r), and the weights (h, 2r, 2r) of what no load explains of them: chi-square is y' weight y."""

    readings: Array
    weight: Array

    @property
    def chi2(self) -> float:
        """Chi-square of the readings as they are."""
        return float(self.products(self.readings, self.readings))

    def products(self, first: Array, second: Array) -> Array:
        """Return the weighted products (...) of changes (..., h, 2r) of the readings, summed over the harmonics."""
        by_harmonic = second.reshape(-1, *second.shape[-2:]).transpose(1, 2, 0)
        weighted = (self.weight @ by_harmonic).transpose(2, 0, 1).reshape(second.shape)
        return np.asarray(np.sum(first * weighted, axis=(-2, -1)))

    def divisors(self, masks: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Return the inverse factors of channels (s, r) that leave least, chi-square with them, and its growth.

        Each is (s,); chi-square grows by so much where these channels read nothing instead.
        """
        parts = np.tile(masks, 2)[:, None, :] * self.readings
        slope, power = self.products(parts, self.readings), self.products(parts, parts)
        inverse = 1.0 - slope / np.where(power > 0.0, power, np.inf)
        return inverse, self.chi2 - slope * (1.0 - inverse), inverse**2 * power


def _residuals(problems: Sequence[LoadProblem], samples: int, response_error: Array | None = None) -> list[_Residuals]:
    """Return the residuals of problems with one response, by the noise of the channels, without gusts, and by its own.

    `response_error` (h, 2r, 2r) is the covariance of the response, by default that for the loads of each problem.
    """
    readings = np.array([np.concatenate([item.readings.real, item.readings.imag], axis=1) for item in problems])
    if response_error is None:
        loads = np.concatenate([problem.loads() for problem in problems])
        response_error = problems[0].response_covariance(loads).reshape(*readings.shape, -1)
    N = np.swapaxes(redundant_directions(stacked_real(problems[0].T)), 1, 2)
    covariance = circular_real(np.array([item.weighting for item in problems])) * (4.0 / samples) + response_error
    weight = N @ np.linalg.solve(np.swapaxes(N, 1, 2) @ covariance @ N, np.swapaxes(N, 1, 2))
    return [_Residuals(*item) for item in zip(readings, weight, strict=True)]


def _exchanges(residuals: _Residuals, live: tuple[str, ...], geometry: Geometry) -> Iterator[ChannelMistake]:
    """Yield the likeliest exchanges of two channels, and of all channels of two cells with as many."""
    places = places_by_sensor(live, geometry)
    swaps = [([i], [j], f"{live[i]} and {live[j]}") for i, j in combinations(range(len(live)), 2)]
    swaps += [
        (places[a], places[b], f"the channels of {a} and those of {b}")
        for a, b in combinations(places, 2)
        if len(places[a]) == len(places[b]) > 1
    ]
    order = np.tile(np.arange(len(live)), (len(swaps), 1))
    for row, (first, second, _) in zip(order, swaps, strict=True):
        row[[*first, *second]] = [*second, *first]
    both = np.hstack([order, order + len(live)])
    corrected = np.moveaxis(residuals.readings[:, both], 0, 1)
    chi2 = residuals.products(corrected, corrected)
    for k in np.argsort(chi2, kind="stable")[:EXAMINED].tolist():
        yield ChannelMistake(np.eye(len(live))[order[k]], swaps[k][2], float(chi2[k]))


def _factors(residuals: _Residuals, live: tuple[str, ...], geometry: Geometry) -> Iterator[ChannelMistake]:
    """Yield for each channel, sensor and group the factor that leaves least: a reversed channel has -1."""
    places = {name: [place] for place, name in enumerate(live)}
    places |= {f"the channels of {name}": at for name, at in places_by_sensor(live, geometry).items() if len(at) > 1}
    for name, members in channel_groups(geometry).items():
        if name != ALL:
            places[f"all {name} channels"] = [live.index(member) for member in members if member in live]
    masks = np.array([np.isin(np.arange(len(live)), at) for at in places.values()])
    for mask, name, inverse, chi2, _ in zip(masks, places, *residuals.divisors(masks), strict=True):
        if abs(inverse) > 1.0 / LARGEST_FACTOR:
            yield ChannelMistake(np.diag(np.where(mask, 1.0 / inverse, 1.0)), name, float(chi2), mask)


def _examine(
    mistakes: Sequence[ChannelMistake], problem: LoadProblem, samples: int, error: Array | None = None
) -> list[ChannelMistake]:
    """Return the mistakes with factor and chi-square by the noise without them; inf where no loads explain that."""
    try:
        undone = [_undone(mistake, problem) for mistake in mistakes]
        residuals = _residuals(undone, samples, error)
    except np.linalg.LinAlgError:
        if len(mistakes) == 1:
            return [replace(mistakes[0], chi2=np.inf)]
        return [item for mistake in mistakes for item in _examine([mistake], problem, samples, error)]
    return [_judge(mistake, left) for mistake, left in zip(mistakes, residuals, strict=True)]


def _judge(mistake: ChannelMistake, residuals: _Residuals) -> ChannelMistake:
    """Return a mistake with the factor, and chi-square, by the residuals without it."""
    if mistake.scaled is None:
        return replace(mistake, chi2=residuals.chi2)
    (inverse,), (chi2,), (worth,) = residuals.divisors(mistake.scaled[None])
    if chi2 > REMAINING_WHERE_REJECTED * (chi2 + worth):  # left out, the channels contradict hardly more
        return replace(mistake, chi2=np.inf)
    matrix = np.where(np.diag(mistake.scaled), mistake.matrix / inverse, mistake.matrix)
    return replace(mistake, matrix=matrix, chi2=float(chi2))


def _undone(mistake: ChannelMistake, problem: LoadProblem) -> LoadProblem:
    return problem.with_readings(np.asarray(np.linalg.inv(mistake.matrix), float))


def places_by_sensor(live: tuple[str, ...], geometry: Geometry) -> dict[str, list[int]]:
    """Return the places of the channels of each cell or other sensor, those of one kind first, as declared."""
    places: dict[str, list[int]] = {}
    for channel in geometry.channels:
        if channel.name in live and channel.source:
            places.setdefault(channel.source, []).append(live.index(channel.name))
    return places


def _passes_test(problem: LoadProblem) -> bool:
    """Whether hardly any harmonic is rejected beyond what the response is known to miss."""
    solved = problem.solve()
    rejected = solved.misfit
    if problem.known_error is not None:
        loads, equations = solved.loads, solved.equations
        known = problem.known_error(np.concatenate([loads.real, loads.imag], axis=1))
        chi2 = residual_chi2(equations.redundant, equations.readings[:, :, None], equations.covariance + known)[:, 0]
        rejected = chi2 > solved.limit * solved.degrees
    return bool(np.mean(rejected) <= EXPLAINED_SHARE)


def contradicting_channels(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, solution: SolvedLoads, response: ComplexArray
) -> str:
    """Return the one or two channels without which the residual test is passed, in words.

    Empty where the test is passed with all of them, where no channel or pair explains it, and where several do; and
    where the response is known to miss its own data, because then it is to blame.
    """
    if np.mean(solution.misfit) < SUSPECT_SHARE or source.response_error is not None or source.is_contradicted:
        return ""

    def rejection(names: Sequence[str]) -> tuple[float, float]:
        live = tuple(name for name in record.health.live if name not in names)
        return _rejection(replace(record, health=replace(record.health, live=live)), geometry, source, response)

    left = {name: rejection((name,)) for name in record.health.live}
    passed: list[tuple[str, ...]] = [(name,) for name, (share, _) in left.items() if share <= EXPLAINED_SHARE]
    if not passed:
        pairs = combinations(sorted(left, key=lambda name: left[name])[:PAIR_CANDIDATES], 2)
        passed = [pair for pair in pairs if rejection(pair)[0] <= EXPLAINED_SHARE]
    if len(passed) != 1:
        return ""
    them = "it" if len(passed[0]) == 1 else "them"
    return f"{' and '.join(passed[0])} contradict the other channels; without {them} the residual test is passed"


def _rejection(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, response: ComplexArray
) -> tuple[float, float]:
    """Return the share of harmonics that are rejected, and the mean redundancy left; inf where not tested."""
    try:
        solution = harmonic_loads(record, geometry, source, response)
    except UserError:
        return np.inf, np.inf
    if not np.all(solution.degrees > 0):
        return np.inf, np.inf
    return float(np.mean(solution.misfit)), float(np.mean(solution.redundancy_chi2))
