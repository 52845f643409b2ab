"""Hub loads of check and wind runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Literal

from balance_cli.api.arguments import Range, check_arguments
from balance_cli.api.inputs import RunLike, to_runs
from balance_cli.calibration.load_method import choose_load_method
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.gaps import describe_gaps
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
from balance_cli.diagnosis.consistency.severity import known_anyway
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.errors import UserError
from balance_cli.reduction.assumed_filter import flag_assumed_filter
from balance_cli.reduction.choices import MOST_HARMONICS, LoadModel
from balance_cli.reduction.measured_response import TransferSource, transfer_source
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_description import text_with_rotor
from balance_cli.reduction.response_sources import ResponseSource, static_source
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals.nyquist_noise import UsualNoise
from balance_cli.signals.response.choices import Interpolation
from balance_cli.signals.response.transfer import Transfer
from balance_cli.steps.contradicted_loads import compare_loads, compare_static_response, flag_contradicted_runs
from balance_cli.steps.cross_checks import cross_check, earlier_warnings
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from balance_cli.steps.reduce_in_time import TimeOptions, reduce_run_in_time
from balance_cli.steps.reduction_inputs import (
    compared_zero,
    default_harmonics,
    fewer_harmonics_warning,
    harmonics_within_band,
    loads_with_filter_tests,
    require_same_geometry,
)

Response = IdentifiedModel | Transfer | Literal["static"]


@check_arguments
def reduce(
    runs: RunLike | Iterable[RunLike],
    calibration: Calibration | None,
    response: Response,
    *,
    zero: RunLike | None = None,
    harmonics: Annotated[int, Range(1, MOST_HARMONICS)] | None = None,
    rotor: Annotated[int, Range(1)] = 1,
    interpolation: Interpolation = "local",
    method: Literal["harmonic", "kalman", "smoother"] = "harmonic",
    load_model: LoadModel = "harmonics",
    lag: Annotated[float, Range(0.0)] = 0.05,
    mean_loads: Literal["iterative", "non-iterative"] | None = None,
) -> HubLoads:
    """Reduce check and wind runs to hub loads at the rotor harmonics, as `balance reduce` does.

    Without a `calibration` (None) the mean loads are not measured. `harmonics` is by default a multiple of the blades,
    less where the band of a run ends below it, of `rotor` 1, 2 and so on (method `harmonic`); the lines of further
    rotors are taken out.
    `response` is an identified model, measured responses, or `"static"` for the static matrix at every harmonic (no
    dynamics removed). A `zero` run among `runs`, or given, is subtracted from the mean loads. `interpolation` is for
    measured responses; `load_model` and `lag` [s] are for the methods in time, which need a model of the physical form.
    `mean_loads` chooses the method of mean loads; by default it is the non-iterative one where the calibration has it.
    What the runs contradict of each other, of calibration, response or geometry stands in `warnings` of the result, and
    flags the loads that it makes doubtful; sweeps and static runs among `runs` are compared only.
    Raises UserError where no run is a check or wind run, where calibration and response come from different
    geometries, where the channels do not determine the loads, and for the contradictions that `balance reduce` refuses.

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
    geometry = calibration.geometry if calibration is not None else _geometry_of(response)
    calibration = None if calibration is None else choose_load_method(calibration, mean_loads, "mean_loads")
    records = to_runs(runs, geometry)
    zeros = to_runs(zero, geometry) if zero is not None else [run for run in records if run.kind == "zero"]
    source = response_source(calibration, response, interpolation)
    at_rest = compare_static_response(calibration, source, geometry if isinstance(response, str) else response.geometry)
    findings = (*at_rest, *cross_check(geometry, records, known_anyway, _noise_of_sweeps(response)))
    used = [run for run in records if run.kind in ("check", "wind")]
    if not used:
        raise UserError("no check or wind run among the runs", remedy="Give the runs that are to be reduced")
    reference, loaded = (None, "") if calibration is None else _zero(zeros, calibration, used)
    if method != "harmonic" and rotor != 1:
        raise UserError("does not go with a method in time", "rotor", remedy="Use method `harmonic`")
    in_time = TimeOptions(method == "smoother", load_model, lag)
    options = ReduceOptions(rotor=rotor) if method == "harmonic" else in_time
    counts = _harmonics(used, geometry, source, rotor, harmonics)
    loads = [
        _reduce_run(run, geometry, calibration, source, reference, replace(options, harmonics=counts[run.name]))
        for run in used
    ]
    flagged = flag_contradicted_runs(_flag_filters(loads, used, geometry, response), findings)
    reduced, compared = compare_loads(flagged, calibration)
    earlier = earlier_warnings(calibration, None if isinstance(response, str) else response)
    said = (*earlier, *_fewer(counts, geometry, harmonics), *filter(None, [loaded]), *compared)
    warnings = sorted({*said, *_warnings(findings, records, loads, source)})
    return HubLoads(method, text_with_rotor(source.description, rotor), geometry, reduced, tuple(warnings) or None)


def _zero(zeros: Sequence[Run], calibration: Calibration, used: Sequence[Run]) -> tuple[ZeroRecord | None, str]:
    """Return the zero of the mean loads, and a warning where that which was given is none."""
    shown = min(used, key=lambda run: (run.kind != "wind", run.name))
    return compared_zero(zeros, calibration, shown)


def _reduce_run(
    run: Run,
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None,
    options: ReduceOptions | TimeOptions,
) -> RunLoads:
    """Loads of one run by the method of the options. An error that names no file is that of the run."""
    try:
        if isinstance(options, TimeOptions):
            return _reduce_in_time(run, geometry, calibration, source, zero, options)
        try:
            return reduce_run(run, geometry, calibration, source, zero, options)
        except UserError as error:
            from balance_cli.steps.reduce_sound_part import reduce_sound_part

            return reduce_sound_part(error, run, geometry, calibration, source, zero, options)
    except UserError as error:
        raise error.with_file_of(run.name, run.file) from error


def _harmonics(
    runs: Sequence[Run], geometry: Geometry, source: ResponseSource, rotor: int, given: int | None
) -> dict[str, int]:
    """Return the harmonics of each run by name: those given, or those of the default that it permits."""
    wanted = default_harmonics(geometry)
    return {run.name: given or harmonics_within_band(run, source, wanted, rotor) for run in runs}


def _fewer(counts: dict[str, int], geometry: Geometry, given: int | None) -> Iterator[str]:
    """Yield a warning for each run with fewer harmonics than are the default."""
    wanted = default_harmonics(geometry)
    if given is None:
        yield from (fewer_harmonics_warning(name, n, wanted) for name, n in counts.items() if n < wanted)


def _warnings(
    findings: Sequence[ConsistencyFinding], records: Sequence[Run], loads: Sequence[RunLoads], source: ResponseSource
) -> Iterator[str]:
    """Yield what is to be known of the runs: findings, gaps that were bridged, channels left out."""
    if isinstance(source, TransferSource):
        for name, reason in source.channels_left_out.items():
            yield f"channel {name} left out of the harmonic loads: {reason}"
    yield from (finding.sentence for finding in findings)
    yield from (f"{run.name}: {describe_gaps(run)}" for run in records if describe_gaps(run))
    for run in loads:
        yield from (f"{run.run}: channel {channel} left out: {reason}" for channel, reason in run.left_out.items())


def _flag_filters(
    loads: Sequence[RunLoads], runs: Sequence[Run], geometry: Geometry, response: Response
) -> dict[str, RunLoads]:
    """Return the loads by run, flagged where the sample rate does not go with the declared filter."""
    rates = [item.sample_rate for item in _noise_of_sweeps(response)]
    return {
        run.name: flag_assumed_filter(of_run, run, geometry, rates) for of_run, run in zip(loads, runs, strict=True)
    }


def _noise_of_sweeps(response: Response) -> tuple[UsualNoise, ...]:
    """Return the noise that the sweeps of a response had in common, as far as it is known."""
    return () if isinstance(response, str) else response.usual_noise or ()


def _geometry_of(response: Response) -> Geometry:
    """Return the geometry of a model or measured responses. UserError for the static matrix, which has none."""
    if isinstance(response, str):
        raise UserError("the static matrix is that of a calibration", remedy="Give a calibration, or a model")
    return response.geometry


def response_source(calibration: Calibration | None, response: Response, interpolation: str) -> ResponseSource:
    """The response in the form that a reduction uses. UserError where its geometry is not that of the calibration."""
    if isinstance(response, str):
        if calibration is None:
            raise UserError("the static matrix is that of a calibration", remedy="Give a calibration, or a model")
        return static_source(calibration)
    if calibration is not None:
        require_same_geometry(response.geometry, calibration)
    if isinstance(response, IdentifiedModel):
        return model_source(response)
    return transfer_source(response, interpolation)


def _reduce_in_time(
    run: Run,
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None,
    options: TimeOptions,
) -> RunLoads:
    """Loads of one run by a Kalman filter or smoother. UserError for a response that is no model."""
    if source.system is None:
        remedy = 'Give a model of the physical form, or use method="harmonic"'
        raise UserError("reduction in time needs a model of the physical form", remedy=remedy)
    time_reduction = reduce_run_in_time(run, geometry, calibration, source, zero, options, None)
    return loads_with_filter_tests(time_reduction, options)
