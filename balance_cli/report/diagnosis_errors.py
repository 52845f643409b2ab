"""Errors on the hold-out runs of a diagnosis, pooled by component, before and after updating."""

from __future__ import annotations

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.result import Diagnosis, HoldOut, RunErrors
from balance_cli.report.check_errors import RelativeError, rms_error

STAGES = ("before", "after")


def hold_out_errors_of_run(errors: HoldOut, stage: str, kind: str) -> dict[str, RelativeError]:
    """{component: error with its noise floor} of one run; `kind` is `load_error` or `interaction`."""
    part: RunErrors = getattr(errors, stage)
    values, noise = getattr(part, kind), getattr(errors.noise, kind)
    return {name: RelativeError(values[name], noise.get(name, float("nan"))) for name in COMPONENTS if name in values}


def pooled_hold_out_errors(diagnosis: Diagnosis, stage: str, kind: str) -> dict[str, RelativeError]:
    """{component: rms over the runs that have this component}."""
    runs = [hold_out_errors_of_run(errors, stage, kind) for errors in diagnosis.hold_out.values()]
    return {name: rms_error(errors) for name in COMPONENTS if (errors := _component_errors(runs, name))}


def _component_errors(runs: list[dict[str, RelativeError]], name: str) -> list[RelativeError]:
    return [errors[name] for errors in runs if name in errors]


def response_error(errors: HoldOut, stage: str) -> RelativeError:
    """Error of the response of one run, with its noise floor."""
    part: RunErrors = getattr(errors, stage)
    return RelativeError(part.frf_error, errors.noise.frf_error)
