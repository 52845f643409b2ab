"""Hub loads of check and wind runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

from balance_cli.api.inputs import RunLike, to_runs
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_digest
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.errors import UserError
from balance_cli.reduction.mean_loads import ZeroRecord, zero_record
from balance_cli.reduction.model_sources import ModelSource, model_source
from balance_cli.reduction.response_sources import ResponseSource, static_source, transfer_source
from balance_cli.reduction.result import HubLoads, RunLoads, TimeDomainResult
from balance_cli.signals.response.transfer import Transfer
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from balance_cli.steps.reduce_in_time import TimeOptions, reduce_run_in_time

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
    reference = zero_reference(calibration, zeros)
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


def require_same_geometry(geometry: Geometry, calibration: Calibration, file: str = "") -> None:
    """Raise UserError where two geometries differ in more than their effects."""
    rigid, calibrated = (item.model_copy(update={"effects": ()}) for item in (geometry, calibration.geometry))
    if geometry_digest(rigid) != geometry_digest(calibrated):
        raise UserError(
            f"was made from another geometry (`{geometry.name}`) than the calibration (`{calibration.geometry.name}`)",
            file,
            "geometry",
            "Make both from the same geometry file",
        )


def zero_reference(calibration: Calibration, zeros: Sequence[Run]) -> ZeroRecord | None:
    """The wind-off record that mean loads count from, None without one. UserError for several, or another kind."""
    if len(zeros) > 1:
        names = ", ".join(run.name for run in zeros)
        raise UserError(f"more than one zero run: {names}", remedy="Choose one of them")
    if not zeros:
        return None
    if zeros[0].kind != "zero":
        place = str(zeros[0].path or zeros[0].name)
        raise UserError(f"is a {zeros[0].kind} run", place, "attribute `kind`", "Give a wind-off record of kind `zero`")
    wanted = [channel.name for channel in calibration.geometry.channels if channel.measures_dc]
    live = live_channels(zeros[0], calibration.geometry).live
    return zero_record(zeros[0], [name for name in wanted if name in live])


def _reduce_in_time(
    run: Run, calibration: Calibration, source: ResponseSource, zero: ZeroRecord | None, options: TimeOptions
) -> RunLoads:
    """Loads of one run by a Kalman filter or smoother. UserError for a response that is no model."""
    if not isinstance(source, ModelSource):
        remedy = 'Give a model of the physical form, or use method="harmonic"'
        raise UserError("reduction in time needs a model of the physical form", remedy=remedy)
    result = reduce_run_in_time(run, calibration.geometry, calibration, source, zero, options, None)
    left_out = {name: reason for name, reason in result.loads.left_out.items() if name not in result.noise}
    lag = None if options.smooth else options.lag
    how = TimeDomainResult(options.load_model, lag, result.innovations, result.track, result.noise, result.gap_notes)
    return replace(result.loads, in_time=how, left_out=left_out)
