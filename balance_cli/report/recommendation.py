"""The loads that the page recommends for each run, and the reason, from flags and from errors on check runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from balance_cli.reduction.flags import UNTESTED
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.run_verdict import CONTRADICTIONS, DO_NOT_USE, run_verdict, untested_loads
from balance_cli.report.check_errors import check_runs, overall_error
from balance_cli.report.load_figures import wind_runs
from balance_cli.report.number_format import capitalize_first, format_percent, join_names
from balance_cli.report.source_roles import PREFERRED_LOADS, SourceRole
from balance_cli.report.sources import Source

CLEARLY_WORSE = 1.5
"""Ratio of errors on the check runs from which a method counts as worse than another; the sampling error of an rms
over some twenty amplitudes is about 15 %."""
NEVER_BEFORE_MEASURED = (SourceRole.STATIC, SourceRole.COMPUTED)
"""Responses that no dynamic measurement supports; they are recommended only where nothing else is given."""
MOST_NAMED = 4
"""Runs that a sentence names one by one."""


@dataclass(frozen=True)
class Recommendation:
    """The loads that are recommended for some runs; `runs` {name: loads of this source}."""

    source: Source[HubLoads]
    runs: dict[str, RunLoads]


def rank_methods(sources: Sequence[Source[HubLoads]]) -> list[Source[HubLoads]]:
    """Sort loads, the best first.

    Responses that were measured or fitted come before those that were not; then those with the fewest runs that must
    not be used, those not clearly worse on the check runs, the better model, harmonics before filters, and those with
    the fewest contradicted rows.
    """
    errors = [_check_error(source) for source in sources]
    least = min((error for error in errors if error is not None), default=None)

    def order(source: Source[HubLoads]) -> tuple[float, ...]:
        runs = source.content.runs.values()
        error = _check_error(source)
        return (
            source.role in NEVER_BEFORE_MEASURED,
            sum(run_verdict(run).word == DO_NOT_USE for run in runs),
            least is not None and (error is None or error > CLEARLY_WORSE * least),
            PREFERRED_LOADS.index(source.role) if source.role in PREFERRED_LOADS else len(PREFERRED_LOADS),
            source.content.method != "harmonic",
            sum(map(contradicted_rows, runs)),
        )

    return sorted(sources, key=order)


def recommend(sources: Sequence[Source[HubLoads]]) -> list[Recommendation]:
    """Return the recommended loads of each wind-on run (of each run, where there is no wind-on run)."""
    any_wind = any(wind_runs(source.content) for source in sources)
    ranked = rank_methods(sources)
    runs_of = {source.label: wind_runs(source.content) if any_wind else source.content.runs for source in ranked}
    assigned: set[str] = set()
    result = []
    for source in ranked:
        new_runs = {name: run for name, run in runs_of[source.label].items() if name not in assigned}
        if new_runs:
            result.append(Recommendation(source, new_runs))
            assigned |= set(new_runs)
    return result


def reason_sentence(recommendation: Recommendation, sources: Sequence[Source[HubLoads]]) -> str:
    """Say which method is recommended and why: errors on check runs, residual test, what it was compared with."""
    source = recommendation.source
    reasons = [*_check_reason(source, sources), *_residual_test_reason(recommendation)]
    others = [other for other in sources if other is not source]
    if source.role in NEVER_BEFORE_MEASURED:
        reasons.append("no loads by a measured or fitted response were given")
    unusable = all(run_verdict(run).word == DO_NOT_USE for run in recommendation.runs.values())
    words = "Do not use these loads, the best that were given" if unusable else "Recommended loads"
    if not others:
        words = "Do not use these loads, the only ones given" if unusable else "The only loads given"
    words += f": by the {source.label}"
    if recommendation.runs and others:
        words += f", of {len(others) + 1} methods compared"
    return f"{words}. {capitalize_first('; '.join(reasons))}." if reasons else f"{words}."


def contradicted_rows(run: RunLoads) -> int:
    """Return the number of rows whose flags say that something measured contradicts the load."""
    return sum(any(word in flags for word in CONTRADICTIONS) for row in run.flags for flags in row)


def tested_harmonics(run: RunLoads) -> int:
    """Return how many harmonics have a residual test of the mechanics, not of the channels alone."""
    untested = np.array([all(UNTESTED in flags for flags in row) for row in run.flags])
    return int(np.count_nonzero(np.isfinite(run.redundancy) & ~untested))


def _check_error(source: Source[HubLoads]) -> float | None:
    error = overall_error(source.content, "load_error")
    return None if error is None else error.value


def _check_reason(source: Source[HubLoads], sources: Sequence[Source[HubLoads]]) -> list[str]:
    error = overall_error(source.content, "load_error")
    if error is None:
        return ["its loads were not compared with known ones: no check run was reduced with it"]
    values = [value for other in sources if (value := _check_error(other)) is not None]
    place = ""
    if len(values) > 1:
        place = ", the smallest" if error.value <= min(values) else f"; the smallest is {format_percent(min(values))} %"
    names = join_names(list(check_runs(source.content)))
    floor = f" (noise floor {format_percent(error.noise)} %)" if np.isfinite(error.noise) else ""
    return [f"its error on known loads ({names}) is {format_percent(error.value)} %{floor}{place}"]


def _residual_test_reason(recommendation: Recommendation) -> list[str]:
    runs = recommendation.runs.values()
    tested, rows = sum(map(tested_harmonics, runs)), sum(len(run.redundancy) for run in runs)
    failing = sum(int(np.count_nonzero(run.redundancy > run.redundancy_limit)) for run in runs)
    if not tested and not failing:
        return ["its harmonics are not tested, because no sensor is redundant"]
    left = f", {rows - tested} {'is' if rows - tested == 1 else 'are'} not tested" if tested < rows else ""
    loads = list(dict.fromkeys(load for run in runs for load in untested_loads(run)))
    left += f"; no redundant sensor tests {join_names(loads)}" if loads else ""
    names = list(recommendation.runs)
    where = f" in {join_names(names) if len(names) <= MOST_NAMED else f'these {len(names)} runs'}"
    if not failing:
        return [f"all {tested} of its tested harmonics{where} pass the residual test{left}"]
    return [f"{failing} of its {tested} tested harmonics{where} fail the residual test{left}"]
