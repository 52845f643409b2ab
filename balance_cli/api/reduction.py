"""Hub loads of check and wind runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from balance_cli.api.inputs import RunLike, to_runs
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.errors import UserError
from balance_cli.reduction.mean_loads import ZeroRecord
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import ResponseSource, static_source, transfer_source
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.signals.response.transfer import Transfer
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from balance_cli.steps.reduce_in_time import TimeOptions, reduce_run_in_time
from balance_cli.steps.reduction_inputs import loads_with_filter_tests, require_same_geometry, zero_reference

Response = IdentifiedModel | Transfer | Literal["static"]


def reduce(
    runs: RunLike | Iterable[RunLike],
    calibration: Calibration,
    response: Response,
    *,
    zero: RunLike | None = None,
    harmonics: int = 8,
    interpolation: str = "local",
    method: Literal["harmonic", "kalman", "smoother"] = "harmonic",
    load_model: str = "harmonics",
    lag: float = 0.05,
) -> HubLoads:
    """Reduce check and wind runs to hub loads at the rotor harmonics, as `balance reduce` does.

    `response` is an identified model, measured responses, or `"static"` for the static matrix at every harmonic (no
    dynamics removed). A `zero` run among `runs`, or given, is subtracted from the mean loads. `interpolation` is for
    measured responses; `load_model` and `lag` [s] are for the methods in time, which need a model of the physical form.
    Raises UserError where no run is a check or wind run, where calibration and response come from different
    geometries, or where the channels do not determine the loads.

    >>> import balance_cli as bal
    >>> geometry = bal.read_geometry("configs/rts-6.yaml")
    >>> calibration = bal.calibrate("sample_data/static-bare.h5", geometry)
    >>> model = bal.identify([], geometry, method="computed")
    >>> loads = bal.reduce("sample_data/wind-1.h5", calibration, model)
    >>> table = loads.to_frame()
    >>> mean = table[table["harmonic"] == 0].set_index("component")["amplitude"]
    >>> print(f"{mean['Fz']:.0f} N")
    2833 N
    """
    records = to_runs(runs, calibration.geometry)
    zeros = to_runs(zero, calibration.geometry) if zero is not None else [run for run in records if run.kind == "zero"]
    source = response_source(calibration, response, interpolation)
    used = [run for run in records if run.kind in ("check", "wind")]
    if not used:
        raise UserError("no check or wind run among the runs", remedy="Give the runs that are to be reduced")
    reference = zero_reference(zeros, calibration)
    if method == "harmonic":
        options = ReduceOptions(harmonics)
        loads = [reduce_run(run, calibration.geometry, calibration, source, reference, options) for run in used]
    else:
        in_time = TimeOptions(method == "smoother", load_model, lag, harmonics)
        loads = [_reduce_in_time(run, calibration, source, reference, in_time) for run in used]
    return HubLoads(method, source.description, calibration.geometry, {run.run: run for run in loads})


def response_source(calibration: Calibration, response: Response, interpolation: str = "local") -> ResponseSource:
    """The response in the form that a reduction uses. UserError where its geometry is not that of the calibration."""
    if isinstance(response, str):
        return static_source(calibration)
    require_same_geometry(response.geometry, calibration)
    if isinstance(response, IdentifiedModel):
        return model_source(response)
    return transfer_source(response, interpolation)


def _reduce_in_time(
    run: Run, calibration: Calibration, source: ResponseSource, zero: ZeroRecord | None, options: TimeOptions
) -> RunLoads:
    """Loads of one run by a Kalman filter or smoother. UserError for a response that is no model."""
    if source.system is None:
        remedy = 'Give a model of the physical form, or use method="harmonic"'
        raise UserError("reduction in time needs a model of the physical form", remedy=remedy)
    time_reduction = reduce_run_in_time(run, calibration.geometry, calibration, source, zero, options, None)
    return loads_with_filter_tests(time_reduction, options)
