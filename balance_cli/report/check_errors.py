"""Errors of reduced hub loads on the check runs: per run, pooled by component, and by harmonic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.report.sources import Source, Sources

Array = NDArray[np.float64]

LOAD_NOISE_FACTOR = 2.0
"""An error up to this factor times the noise floor counts as noise (two standard deviations)."""
ERROR_KINDS = ("load_error", "interaction")
ERROR_TITLES = {
    "load_error": "Hub-load error: % of the load applied",
    "interaction": "Interaction: % of the largest force applied",
}


@dataclass(frozen=True)
class RelativeError:
    """An error relative to the applied loads, and its noise floor."""

    value: float
    noise: float

    @property
    def is_noise(self) -> bool:
        """Whether the error is within the noise."""
        return self.value <= LOAD_NOISE_FACTOR * self.noise


def check_runs(loads: HubLoads) -> dict[str, RunLoads]:
    """The runs with known loads."""
    return {name: run for name, run in loads.runs.items() if run.check is not None}


def run_errors(run: RunLoads, kind: str) -> dict[str, RelativeError]:
    """{component: error} of one check run; `kind` is `load_error` or `interaction`."""
    assert run.check is not None
    values: dict[str, float] = getattr(run.check, kind)
    noise = run.check.load_noise if kind == "load_error" else run.check.interaction_noise
    return {name: RelativeError(value, noise.get(name, float("nan"))) for name, value in values.items()}


def pooled_errors(loads: HubLoads, kind: str) -> dict[str, RelativeError]:
    """{component: rms over the check runs that have it}, in the order of the components."""
    runs = [run_errors(run, kind) for run in check_runs(loads).values()]
    return {
        name: rms_error([errors[name] for errors in runs if name in errors])
        for name in COMPONENTS
        if any(name in errors for errors in runs)
    }


def rms_error(errors: Sequence[RelativeError]) -> RelativeError:
    """Root mean square of the errors, and of their noise floors."""
    values, noise = ([getattr(error, part) for error in errors] for part in ("value", "noise"))
    return RelativeError(float(np.sqrt(np.mean(np.square(values)))), float(np.sqrt(np.mean(np.square(noise)))))


def overall_error(loads: HubLoads, kind: str) -> RelativeError | None:
    """Rms over all components of all check runs; None where there is none."""
    errors = [error for run in check_runs(loads).values() for error in run_errors(run, kind).values()]
    return rms_error(errors) if errors else None


def loads_with_check_runs(sources: Sources) -> tuple[Source[HubLoads], ...]:
    """The loads that include check runs."""
    return tuple(source for source in sources.loads if check_runs(source.content))


def harmonic_errors(loads: HubLoads, component: str) -> Array:
    """Relative error (n,) of a component at harmonics 1 to n, each by itself.

    Rms of reduced minus applied over rms of applied loads, over the check runs in which the component was applied;
    empty where it never was.
    """
    errors, sizes = [], []
    for run in check_runs(loads).values():
        if run.check is not None and component in run.check.load_error:
            m = run.components.index(component)
            applied = run.check.applied[1:, m]
            errors.append(np.abs(run.amplitude[1 : 1 + len(applied), m] - applied) ** 2)
            sizes.append(np.abs(applied) ** 2)
    if not errors:
        return np.zeros(0)
    count = min(map(len, errors))
    error, size = (np.mean([values[:count] for values in parts], axis=0) for parts in (errors, sizes))
    return np.asarray(np.sqrt(error / np.where(size > 0, size, np.nan)))
