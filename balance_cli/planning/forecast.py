"""What a sequence of runs is expected to tell: smallest sizes, sigma of loads and parameters, after each of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import accumulate, islice

import numpy as np
from numpy.typing import NDArray

from balance_cli.model import effects
from balance_cli.planning.detectability import (
    DetectionLevel,
    SmallestSize,
    project,
    smallest_sizes,
)
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.hub_loads import LoadForecast, load_error, parameter_sigma, total_sigma
from balance_cli.planning.information import RunInformation, add_information
from balance_cli.planning.result import DetectableEffect, LoadSigma, ParameterForecast

Array = NDArray[np.float64]

NOT_PREDICTED = "its frequency and phase are unknown, and it belongs to the hall, not to the balance"
"""Why nothing is said of a tone: the score test of its power is not linear in its amplitude."""


@dataclass(frozen=True)
class Stage:
    """What is known after some of the runs: smallest `sizes`, `covariance` (f, f), and `projection` (f, t).

    `sizes` are those of all candidates after the last run; before it, those of the candidates that are then the hardest
    to find of their effects. The last two are those of `ProjectedInformation`, which itself is gigabytes for a thousand
    parameters and 60 runs.
    """

    sizes: tuple[SmallestSize, ...]
    covariance: Array
    projection: Array


def forecast_stages(
    before: RunInformation, runs: Sequence[RunInformation], model: ExtendedModel, detection: DetectionLevel
) -> tuple[tuple[Stage, ...], RunInformation]:
    """What is known before the first run and after each, and the information of all of them."""
    totals = accumulate(runs, lambda total, run: add_information([total, run], model), initial=before)
    last = add_information([before, *runs], model)
    end = _stage(last, model, detection)
    hardest = {_hardest(rows, model).index for rows in _rows_by_effect(end.sizes).values()}
    return (*(_stage(total, model, detection, hardest) for total in islice(totals, len(runs))), end), last


def _stage(
    total: RunInformation, model: ExtendedModel, detection: DetectionLevel, among: Collection[int] | None = None
) -> Stage:
    projected = project(total, model)
    return Stage(smallest_sizes(projected, model, detection, among), projected.covariance, projected.projection)


def _rows_by_effect(sizes: Sequence[SmallestSize]) -> dict[str, list[SmallestSize]]:
    rows: dict[str, list[SmallestSize]] = {}
    for item in sizes:
        rows.setdefault(item.effect, []).append(item)
    return rows


def _hardest(rows: Sequence[SmallestSize], model: ExtendedModel) -> SmallestSize:
    """The parameter of an effect that is hardest to find, of those that are found at all."""
    shown = [item for item in rows if np.isfinite(item.size)]
    return max(shown or rows, key=lambda item: item.size / model.scales[item.index])


def unpredicted_effects(model: ExtendedModel, names: Collection[str] | None = None) -> dict[str, str]:
    """Effects of the library of which the plan says nothing, and why; those of `names` only where some are given."""
    reasons = {
        effect.name: _why_unpredicted(effect, model)
        for effect in effects.EFFECTS
        if names is None or effect.name in names
    }
    return {name: reason for name, reason in reasons.items() if reason}


def _why_unpredicted(effect: effects.Effect, model: ExtendedModel) -> str:
    """Why an effect is not predicted; empty where it is."""
    if any(item.effect.name == effect.name for item in model.candidates):
        return NOT_PREDICTED if effect.search.tone is not None else ""
    if effect.empirical:
        return "it describes what no effect explains, and has no size of its own before it is found"
    if any(item.name == effect.name for item in model.model.geometry.effects):
        return "the model has it already"
    return "it has no place in this rig"


def detectable_effects(
    stages: Sequence[Stage],
    model: ExtendedModel,
    forecast: LoadForecast | None,
    further: Sequence[RunInformation],
) -> tuple[DetectableEffect, ...]:
    """Each effect at the place and parameter where it is hardest to find, before and after each run.

    `further`: other runs, those beyond the hall named by what they are; an effect that no run of the plan shows names
    the one that tells most of it.
    """
    beyond = [(run.run, np.diag(project(run, model).V).copy()) for run in further]
    tables = [stage.sizes for stage in stages]
    unpredicted = {item.effect.name for item in model.candidates if item.effect.search.tone is not None}
    return tuple(
        _detectable_effect(rows, tables, stages, model, forecast, beyond)
        for name, rows in _rows_by_effect(tables[-1]).items()
        if name not in unpredicted
    )


def _detectable_effect(
    rows: Sequence[SmallestSize],
    tables: Sequence[Sequence[SmallestSize]],
    stages: Sequence[Stage],
    model: ExtendedModel,
    forecast: LoadForecast | None,
    beyond: Sequence[tuple[str, Array]],
) -> DetectableEffect:
    hardest = _hardest(rows, model)
    easiest = min(rows, key=lambda item: item.size / model.scales[item.index])
    at_hardest = [next(item for item in table if item.index == hardest.index) for table in tables]
    errors = [
        None if forecast is None else load_error(forecast, model, stage.projection, item)
        for stage, item in zip(stages, at_hardest, strict=True)
    ]
    shares = tuple(
        None if error is None or forecast is None else float(np.max(error / forecast.reference)) for error in errors
    )
    last = errors[-1]
    of_components = None if last is None or forecast is None else dict(zip(forecast.components, last, strict=True))
    missing = tuple(f"{item.label}: {item.parameter}" for item in rows if not np.isfinite(item.size))
    return DetectableEffect(
        effect=hardest.effect,
        label=hardest.label,
        parameter=hardest.parameter,
        unit=hardest.unit,
        sizes=tuple(item.value for item in at_hardest),
        easiest=(easiest.label, easiest.value),
        load_error=None if of_components is None else {key: float(value) for key, value in of_components.items()},
        share=shares[-1],
        shares=shares,
        missing=missing,
        shown_by=_revealing_measurement(next(item for item in rows if not np.isfinite(item.size)), model, beyond)
        if missing
        else "",
    )


def _revealing_measurement(item: SmallestSize, model: ExtendedModel, beyond: Sequence[tuple[str, Array]]) -> str:
    """The measurement that would show an effect which the sweeps of a plan do not.

    Of the runs beyond the hall (name, diagonal (t,) of V) it is the one with the most information on it.
    """
    best, what = max(((float(diagonal[item.index]), name) for name, diagonal in beyond), default=(0.0, ""))
    if best > 0:
        return what
    effect = next(each.effect for each in model.candidates if each.effect.name == item.effect)
    if effect.needs_spin:
        return "a sweep with the rotor turning (`rotor_speeds` in the hall file)"
    tested = np.concatenate(model.indices.tested)[item.index]
    if model.system.equations.weight_cross_axis.derivative[tested].any():
        return "a static run (`--points` plans its load points): calibration weights act there alone"
    return effect.separated_by[0].lower() + effect.separated_by[1:].rstrip(".")


def load_sigma(stages: Sequence[Stage], model: ExtendedModel, forecast: LoadForecast | None) -> LoadSigma | None:
    """The sigma of the hub loads before and after the runs; None without a forecast."""
    if forecast is None:
        return None
    sigma = np.array([total_sigma(forecast, model, stage.covariance) for stage in stages])
    logs = [np.mean(np.log(np.maximum(parameter_sigma(forecast, model, s.covariance), 1e-300))) for s in stages]
    return LoadSigma(
        components=forecast.components,
        frequency=forecast.frequency,
        reference=forecast.reference,
        before=sigma[0],
        after=sigma[-1],
        noise=forecast.noise,
        after_run=sigma[1:],
        by_run=np.exp(np.array(logs[1:]) - logs[0]),
    )


def parameter_forecasts(first: Stage, last: Stage, model: ExtendedModel) -> tuple[ParameterForecast, ...]:
    """The sigma of every fitted parameter before and after the runs."""
    parameters = model.model.parameters
    free = np.flatnonzero(parameters.free)[model.indices.fitted]
    before, after = (np.sqrt(np.maximum(np.diag(stage.covariance), 0.0)) for stage in (first, last))
    return tuple(
        ParameterForecast(
            name=parameters.names[i],
            unit=parameters.units[i],
            value=float(model.theta[i]),
            declared_sigma=float(parameters.sigma[i]),
            before=float(before[k]),
            after=float(after[k]),
        )
        for k, i in enumerate(free)
    )
