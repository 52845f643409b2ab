"""Summary and text output of `balance reduce`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from balance_cli.cli.load_text import load_lines, trust_line
from balance_cli.cli.summary import SummaryOfEach
from balance_cli.io.result_view import plural
from balance_cli.io.run_messages import RunMessage, message_lines, name_runs
from balance_cli.reduction.choices import FREQUENCIES
from balance_cli.reduction.run_verdict import DO_NOT_USE, USE, WITH_CARE, run_verdict

if TYPE_CHECKING:
    from balance_cli.reduction.result import HubLoads, RunLoads, TimeDomainResult

MOST_IN_FULL = 20
"""Runs whose loads are shown: some ten lines each, as many as one reads."""
VERDICTS = (DO_NOT_USE, WITH_CARE, USE)


def summary(loads: HubLoads) -> dict[str, Any]:
    """Return the summary of all runs (docs/json.md)."""
    return {
        "method": loads.method,
        "response": loads.response,
        "runs": SummaryOfEach(loads.runs, _run_summary),
    }


def _run_summary(run: RunLoads) -> dict[str, Any]:
    verdict = run_verdict(run)
    summary = {
        "redundancy": dict(enumerate(run.redundancy)),
        "redundancy_limit": dict(enumerate(run.redundancy_limit)),
        "condition": dict(enumerate(run.condition)),
        "unnoticed_errors": _unnoticed_errors(run),
        "undeclared_mass": _undeclared_mass(run),
        "channels_left_out": run.left_out,
        "interval_s": run.interval,
        "trim": run.trim,
        "mean_load_method": run.mean_method,
        "flags": run.flag_counts,
        "verdict": verdict.word,
        "reasons": verdict.reasons,
        "notes": run.notes,
        "wrong_channels": run.wrong_channels,
    }
    if run.check is not None:
        of_rows = ("applied", "added_variance")
        summary |= {key: value for key, value in asdict(run.check).items() if key not in of_rows}
        summary["wrong_channels"] = run.check.wrong_channels or run.wrong_channels
    if run.in_time is not None:
        summary |= _in_time_summary(run.in_time)
    return summary


def _unnoticed_errors(run: RunLoads) -> dict[str, dict[int, dict[str, Any]]] | None:
    """Return {component: {harmonic: sensor and change of the load}}; None where sensors are not tested."""
    errors = run.unnoticed
    if errors is None:
        return None
    return {
        component: {
            n + 1: {"sensor": errors.sensors[sensor], "change": float(change)}
            for n, (sensor, change) in enumerate(zip(errors.sensor[:, j], errors.change[:, j], strict=True))
        }
        for j, component in enumerate(run.components)
    }


def _undeclared_mass(run: RunLoads) -> dict[str, Any] | None:
    """Return the mass and {component: {harmonic: place and change of the load}}; None where masses are not known."""
    added = run.undeclared_mass
    if added is None:
        return None
    changes = {
        component: {
            n + 1: {"place": added.places[place], "change": float(change)}
            for n, (place, change) in enumerate(zip(added.place[:, j], added.change[:, j], strict=True))
        }
        for j, component in enumerate(run.components)
    }
    return {"mass_kg": added.mass, "changes": changes}


def _in_time_summary(filter_result: TimeDomainResult) -> dict[str, Any]:
    """Return the keys of a run reduced in time; without tests of the innovations their keys are null."""
    tests = filter_result.innovations
    return {
        "load_model": filter_result.load_model,
        "loads_as": filter_result.load_model,  # former name, for one release
        "lag_s": filter_result.lag,
        "nis": tests.nis if tests else None,
        "nis_sigma": tests.nis_sigma if tests else None,
        "whiteness": tests.whiteness if tests else None,
        "whiteness_sigma": tests.whiteness_sigma if tests else None,
        "rms_autocorrelation": tests.rms_autocorrelation if tests else None,
        "slow_power": tests.slow_power if tests else None,
        "channels": tests.channels if tests else {},
        "noise_v": filter_result.noise,
        "gap_notes": filter_result.gap_notes,
        "bridged": filter_result.gap_notes,  # former name, for one release
    }


def reduction_text(loads: HubLoads) -> Iterator[str]:
    """Yield one line per run; below it its loads and their trust, then errors of check runs and notes.

    Of more than MOST_IN_FULL runs only the verdicts are shown.
    """
    yield f"{plural(len(loads.runs), 'run')} reduced, {loads.response}"
    if loads.geometry.acquisition.filter is None:
        yield "no `acquisition.filter` is declared: harmonics keep the gain and delay of a filter that the recorder has"
    if len(loads.runs) > MOST_IN_FULL:
        yield from _verdict_lines(loads.runs.values())
        return
    for name, run in loads.runs.items():
        yield f"{name}, {run.interval[0]:.2f} to {run.interval[1]:.2f} s: {_residual_test_text(run)}"
        if run.in_time is not None:
            yield f"   {_innovation_tests_text(run.in_time)}"
        yield from load_lines(run, loads.geometry, loads.method == FREQUENCIES)
        yield trust_line(run)
        if run.check is not None:
            yield f"   error of the applied loads: {_percent(run.check.load_error)}"
            yield f"   interaction in the other loads: {_percent(run.check.interaction)}"
        if run.mean_method:
            yield f"   mean loads: {run.mean_loads_by}"
        for note in run.notes:
            yield f"   {note}"
        for note in filter(None, (run.unnoticed_note, run.undeclared_mass_note)):
            yield f"   {note}"


def _verdict_lines(runs: Iterable[RunLoads]) -> Iterator[str]:
    """Yield the verdicts, each with its runs and their reasons."""
    reasons: dict[str, dict[str, tuple[str, ...]]] = {}
    for run in runs:
        verdict = run_verdict(run)
        reasons.setdefault(verdict.word, {})[run.run] = verdict.reasons
    for word in sorted(reasons, key=VERDICTS.index):
        yield f"{word}: {name_runs(reasons[word])}"
        messages = (RunMessage(run, f"{run}: {reason}") for run, texts in reasons[word].items() for reason in texts)
        yield from (f"   {line}" for line in message_lines(messages))
    yield "   notes and flags of each run are in the loads and in the summary of --json"


def _residual_test_text(run: RunLoads) -> str:
    worst = max(range(1, len(run.redundancy)), key=lambda n: run.redundancy[n])
    if math.isnan(run.redundancy[worst]):
        return "no redundant channels test the response"
    return (
        f"chi2/dof of the residual test up to {run.redundancy[worst]:.3g} "
        f"(harmonic {worst}, limit {run.redundancy_limit[worst]:.2f})"
    )


def _innovation_tests_text(filter_result: TimeDomainResult) -> str:
    tests = filter_result.innovations
    if tests is None:
        return "innovations not tested: no part of the record has all channels"
    from balance_cli.reduction.kalman.innovations import (
        LARGEST_AUTOCORRELATION,
        LARGEST_NIS,
        LARGEST_SLOW_POWER,
    )

    verdict = "; they contradict the filter" if tests.contradict_filter else ""
    return (
        f"innovations: NIS {tests.nis:.3f} ({tests.least_nis:g} to {LARGEST_NIS:g} is consistent), "
        f"rms autocorrelation {tests.rms_autocorrelation:.3f} (at most {LARGEST_AUTOCORRELATION:g}), "
        f"slow power {tests.slow_power:.2f} (at most {LARGEST_SLOW_POWER:g}){verdict}"
    )


def _percent(errors: dict[str, float]) -> str:
    return ", ".join(f"{name} {100 * value:.2f} %" for name, value in errors.items()) or "none"
