"""Errors on the hold-out runs of a diagnosis: pooled by component, before and after closing."""

from __future__ import annotations

from collections.abc import Iterator

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.result import Diagnosis, HoldOut, RunErrors
from balance_cli.report.check_errors import Error, rms_error

STAGES = ("before", "after")


def run_errors(errors: HoldOut, stage: str, kind: str) -> dict[str, Error]:
    """{component: error beside its noise} of one run; `kind` is `load_error` or `interaction`."""
    part: RunErrors = getattr(errors, stage)
    values, noise = getattr(part, kind), getattr(errors.noise, kind)
    return {name: Error(values[name], noise.get(name, float("nan"))) for name in COMPONENTS if name in values}


def pooled(diagnosis: Diagnosis, stage: str, kind: str) -> dict[str, Error]:
    """{component: rms over the runs that have it}."""
    runs = [run_errors(errors, stage, kind) for errors in diagnosis.hold_out.values()]
    return {name: rms_error(list(found)) for name in COMPONENTS if (found := list(_of(runs, name)))}


def _of(runs: list[dict[str, Error]], name: str) -> Iterator[Error]:
    return (errors[name] for errors in runs if name in errors)


def response_error(errors: HoldOut, stage: str) -> Error:
    """Error of the response of one run."""
    part: RunErrors = getattr(errors, stage)
    return Error(part.frf_error, errors.noise.frf_error)
