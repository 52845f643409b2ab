"""A plan as a YAML file, as JSON keys for scripts, and as text for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from balance_cli.io.result_view import plural

if TYPE_CHECKING:
    from balance_cli.planning.candidate_runs import CandidateRun
    from balance_cli.planning.confusion import ConfusedPair
    from balance_cli.planning.result import DetectableEffect, LoadSigma, PlannedCampaign

MOST_LISTED = 10
"""Confused pairs and ranked runs that the text lists; the JSON has all."""
RUN_KEYS = (
    *("run", "kind", "excited", "level", "excitation", "band", "period", "periods", "sample_rate", "rotor_speed"),
    *("power", "steady", "point", "contact", "trim", "trim_loads", "largest", "steps"),
)
"""Settings of a run in the summary."""
MOST_REPEATED = 2
"""Equal sweeps in a row without a remark: one repetition tells whether the rig is still the same."""
WEAK_LINE = 0.5
"""Amplitude of the weakest line over that of the strongest below which the text has a remark on measured responses."""
SAVED_DIGITS = 6
"""Significant digits of a forecast in the plan."""


# ---- file ------------------------------------------------------------------------------------------------------------


def plan_file_text(planned: PlannedCampaign) -> str:
    """The plan as `balance simulate --plan` reads it, with its noise, its forecast and a head of comments."""
    import yaml

    from balance_cli.cli.summary import to_json_value
    from balance_cli.io.formats import PLAN_FORMAT
    from balance_cli.planning.stored_forecast import FORECAST_KEYS

    runs = [item.plan.model_dump(mode="json", exclude_none=True) for item in planned.chosen]
    head = f"# Plan for {planned.rig}: {len(runs)} runs in {planned.minutes:.1f} minutes\n"
    head += f"# noise {planned.noise_source}\n"
    summary = plan_summary(planned)
    content = {
        "format": PLAN_FORMAT,
        "rig": planned.rig,
        "noise": planned.noise.model_dump(mode="json", exclude_none=True),
        "runs": runs,
        "forecast": _rounded(to_json_value({key: summary[key] for key in FORECAST_KEYS})),
    }
    return head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)


def _rounded(value: Any) -> Any:
    """A JSON value with as many digits in its numbers as a forecast deserves."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.{SAVED_DIGITS}g}") if isinstance(value, float) else value


# ---- summary ---------------------------------------------------------------------------------------------------------


def plan_summary(planned: PlannedCampaign) -> dict[str, Any]:
    """Return the JSON keys of docs/json.md."""
    return {
        "minutes": planned.minutes,
        "complete": planned.complete,
        "made": planned.made,
        "noise": planned.noise_source,
        "level": planned.detection.level,
        "power": planned.detection.power,
        "runs": [_run_summary(item) for item in planned.chosen],
        "levels": [asdict(limit) for limit in planned.limits],
        "effects": [_effect_summary(item) for item in planned.effects],
        "not_predicted": [{"name": name, "why": why} for name, why in planned.unpredicted.items()],
        "confusion": [asdict(pair) for pair in planned.confusion],
        "ranking": [asdict(row) for row in planned.ranking],
        "loads": None if planned.loads is None else _load_summary(planned.loads),
        "parameters": {
            item.name: {"value": item.value, "unit": item.unit, "declared": item.declared_sigma}
            | {"before": item.before, "after": item.after}
            for item in planned.parameters
        },
    }


def _run_summary(item: CandidateRun) -> dict[str, Any]:
    settings = item.plan.model_dump(mode="json", exclude_none=True)
    return {**{key: value for key, value in settings.items() if key in RUN_KEYS}, "minutes": item.minutes}


def _effect_summary(item: DetectableEffect) -> dict[str, Any]:
    return {
        "name": item.effect,
        "hardest": item.label,
        "parameter": item.parameter,
        "unit": item.unit,
        "before": _finite(item.sizes[0]),
        "after": [_finite(size) for size in item.sizes[1:]],
        "easiest": {"place": item.easiest[0], "size": _finite(item.easiest[1])},
        "load_error": item.load_error,
        "load_share": item.share,
        "load_shares": item.shares,
        "not_shown": item.missing,
        "shown_by": item.shown_by,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _load_summary(loads: LoadSigma) -> dict[str, Any]:
    return {
        "frequency_hz": loads.frequency,
        "reference": dict(zip(loads.components, loads.reference, strict=True)),
        "sigma_before": dict(zip(loads.components, loads.before.T, strict=True)),
        "sigma_after": dict(zip(loads.components, loads.after.T, strict=True)),
        "sigma_after_run": dict(zip(loads.components, loads.after_run.transpose(2, 0, 1), strict=True)),
        "sigma_noise": dict(zip(loads.components, loads.noise.T, strict=True)),
        "parameter_part_after_run": loads.by_run,
    }


# ---- text ------------------------------------------------------------------------------------------------------------


def plan_text(planned: PlannedCampaign) -> Iterator[str]:
    """Yield the lines of the console summary."""
    yield f"{plural(len(planned.chosen), 'run')} in {planned.minutes:.1f} minutes; noise {planned.noise_source}"
    if not planned.complete:
        yield "the time limit came first: not all runs of the hall were tried, or the forecast has fewer rehearsals"
    if planned.made:
        yield f"already made: {', '.join(planned.made)}"
    shaped = any(item.plan.kind == "sweep" and item.plan.power for item in planned.chosen)
    remark = (
        " with lines of equal power (those of the runs below have power, and levels, of their own)" if shaped else ""
    )
    yield f"Largest level of each component{remark}:"
    for limit in planned.limits:
        yield f"   {limit.component}  {limit.level:10.4g} rms, limited by the {limit.reason}"
    yield from _runs_text(planned)
    yield from _effects_text(planned)
    yield from _load_text(planned)
    yield from _confusion_text(planned)


def _runs_text(planned: PlannedCampaign) -> Iterator[str]:
    from balance_cli.planning.run_words import condition_words, excitation_words, level_words, record_words

    yield "Runs, in this order:"
    for first, last in _equal_runs(planned):
        count = last - first + 1
        for i in range(first, last + 1) if count <= MOST_REPEATED else (last,):
            plan = planned.chosen[i].plan
            part = "" if planned.loads is None else f"  parameters' part of load sigma x {planned.loads.by_run[i]:.3g}"
            words = (
                f"{excitation_words(plan):<10} {level_words(plan):>12} {condition_words(plan)} {record_words(plan):>9}"
            )
            yield f"   {plan.run:<28} {words}{part}"
        if count > MOST_REPEATED and plan.kind == "sweep":
            name = planned.chosen[first].plan.run
            yield f"      {name} to {plan.run} are {count} times the same run: with {count * plan.periods} among"
            yield "      the `periods` of the hall file they can be one record"
    yield from _missing_sweeps_text(planned)
    yield from _weak_lines_text(planned)


def _equal_runs(planned: PlannedCampaign) -> Iterator[tuple[int, int]]:
    """First and last index of consecutive sweeps that differ in their names alone; other runs are single."""
    from itertools import groupby

    run_plans = [item.plan for item in planned.chosen]
    plans = [plan.model_dump_json(exclude={"run"} if plan.kind == "sweep" else None) for plan in run_plans]
    for _, group in groupby(range(len(plans)), plans.__getitem__):
        indices = list(group)
        yield indices[0], indices[-1]


def _missing_sweeps_text(planned: PlannedCampaign) -> Iterator[str]:
    """A remark on the components that could be swept, but are not; runs already made may have them."""
    swept = {name for item in planned.chosen if item.plan.kind == "sweep" for name in item.plan.excited}
    missing = [limit.component for limit in planned.limits if limit.component not in swept]
    if missing and not planned.made:
        yield f"   No sweep of {', '.join(missing)}: for a model (`identify`) other runs show more in this time."
        yield "   A measured response (`sweep-tf`, `reduce --transfer`) needs a sweep of each component"


def _weak_lines_text(planned: PlannedCampaign) -> Iterator[str]:
    """A remark on measured responses, where the lines of a multisine have far less power than others."""
    powers = [
        [part for _, part in item.plan.power]
        for item in planned.chosen
        if item.plan.kind == "sweep" and item.plan.power
    ]
    weakest = min((math.sqrt(min(power) / max(power)) for power in powers), default=1.0)
    if weakest < WEAK_LINE:
        yield f"   The weakest lines have {100 * weakest:.2g} % of the strongest amplitude. `identify` weights them,"
        yield "   but in `sweep-tf` their coherence is lower: to reduce by measured response,"
        yield "   plan with `spectrum: flat` in the hall file"


def _effects_text(planned: PlannedCampaign) -> Iterator[str]:
    level, power = planned.detection.level, planned.detection.power
    yield f"Smallest size that is found ({100 * power:.0f} % of the time; {100 * level:.2g} % false alarms in all):"
    yield f"   {'effect, hardest place':<44} {'now':>10} {'after':>10} {'unit':<9} load error"
    for item in planned.effects:
        name = f"{item.label} {item.parameter}"
        share = "" if item.share is None else f"{100 * item.share:9.2g} %"
        yield f"   {name:<44} {_size(item.sizes[0]):>10} {_size(item.sizes[-1]):>10} {item.unit:<9} {share}"
        if item.missing and not math.isfinite(item.sizes[-1]):
            yield f"      no run of this plan shows it; what would: {item.shown_by}"
    for name, why in planned.unpredicted.items():
        yield f"   {name}: not predicted: {why}"


def _size(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) and value else "-"


def _load_text(planned: PlannedCampaign) -> Iterator[str]:
    from balance_cli.campaign.rig.components import UNIT_OF

    loads = planned.loads
    if loads is None:
        yield "Hub loads: no rotor in the geometry, or too few channels; their sigma is not predicted"
        return
    yield "Sigma of the hub loads in % of the reference load (now / after / noise of the record alone), worst harmonic:"
    for i, name in enumerate(loads.components):
        parts = [100.0 * part[:, i] / loads.reference[i] for part in (loads.before, loads.after, loads.noise)]
        worst = int(parts[1].argmax())
        numbers = " / ".join(f"{part[worst]:.3g}" for part in parts)
        yield f"   {name}  {numbers}  at harmonic {worst + 1}, reference {loads.reference[i]:.4g} {UNIT_OF[name]}"


def _confusion_text(planned: PlannedCampaign) -> Iterator[str]:
    if not planned.confusion:
        return
    yield "Effects that the runs cannot distinguish (cosine between the changes that they cause):"
    for pair in planned.confusion[:MOST_LISTED]:
        remedy = _remedy(pair)
        more = f" (and {pair.places - 1} other places)" if pair.places > 1 else ""
        yield f"   {pair.cosine:.4f}  {pair.first} and {pair.second}{more}; {remedy}"


def _remedy(pair: ConfusedPair) -> str:
    """What separates two effects: a run of the hall, another kind of run, or other evidence."""
    if pair.run:
        return f"best separated by {pair.run}: {pair.cosine_with_run:.4f}"
    if pair.further:
        return f"no run of this hall separates them, best {pair.further}: {pair.cosine_with_further:.4f}"
    return f"no run separates them at this size. {pair.otherwise}"
