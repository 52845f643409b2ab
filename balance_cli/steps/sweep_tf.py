"""Frequency responses of the sweeps of a campaign, with their covariance.

For a periodic record the ratio of its lines is the response. For other records the default is a local rational model,
which is free of leakage. H1, H2, Hv and the local polynomial method are available for comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.signals.early_taps import prepend_rest
from balance_cli.signals.impact import use_hammer_record
from balance_cli.signals.local.response import local_response
from balance_cli.signals.nyquist_noise import measure_usual_noise
from balance_cli.signals.periodic import PeriodicRecord, has_whole_periods, periodic_record
from balance_cli.signals.response.averaged_spectra import averaged_response
from balance_cli.signals.response.choices import AUTO, AVERAGED_ESTIMATORS, ESTIMATORS, LOCAL_RATIONAL, PERIODIC
from balance_cli.signals.response.periodic_response import joint_response, response_from_one_run
from balance_cli.signals.response.point_forces import PointForce, combine_point_forces
from balance_cli.signals.response.transfer import SteadyPart, Transfer
from balance_cli.signals.run_spectrum import FrequencyResponse
from balance_cli.signals.single_force import SingleForce, single_force

__all__ = ["ESTIMATORS", "add_point_responses", "estimate_responses", "with_contradictions"]

SAME_LEVEL = 0.05
"""Relative difference of two declared levels that are the same set-up: an exciter does not repeat its level exactly."""


def estimate_responses(
    runs: Iterable[Run],
    geometry: Geometry,
    estimator: str = AUTO,
    band: tuple[float, float] = (0.0, np.inf),
    progress: Callable[[Sequence[Run]], Iterable[Run]] = iter,
) -> Transfer:
    """Estimate the responses of all sweeps among the runs, at their lines within `band` [Hz].

    `estimator` is one of ESTIMATORS; `progress` returns the sweeps one by one as they are worked on. Raises UserError
    where no run is a sweep, and where a sweep has no live channel or cannot be used by the estimator. Sweeps that
    contradict each other are in `consistency`.
    """
    if not band[0] < band[1]:
        raise UserError(
            f"the band from {band[0]:g} to {band[1]:g} Hz is empty", "--from, --to", remedy="Correct the band"
        )
    runs = tuple(runs)
    unused = {run.name: f"a {run.kind} run; only sweeps are used" for run in runs if run.kind != "sweep"}
    sweeps = [run for run in runs if run.kind == "sweep"]
    if not sweeps:
        raise UserError("none of the runs is a sweep", remedy="Give at least one run of kind `sweep`")
    live, left_out = _live_channels_by_run(sweeps, geometry)
    measured = [_measure_sweep(run, live[run.name], estimator, band) for run in progress(sweeps)]
    points = [item for item in measured if isinstance(item, PointForce)]
    records = [(run, item) for run, item in zip(sweeps, measured, strict=True) if isinstance(item, PeriodicRecord)]
    at_hub = _periodic_responses(records)
    at_hub += [item for item in measured if isinstance(item, FrequencyResponse)]
    responses, faults = add_point_responses(at_hub, points)
    transfer = Transfer(
        geometry=geometry,
        responses=tuple(responses),
        estimator=estimator,
        steady_parts={run.name: _steady_part(record) for run, record in records},
        channels_left_out=left_out,
        unused_runs=unused | faults,
        usual_noise=measure_usual_noise(runs, geometry.channel_names) or None,
    )
    return with_contradictions(transfer)


def with_contradictions(transfer: Transfer) -> Transfer:
    """Return the responses with what several sweeps say differently of the rig among their findings."""
    if len(transfer.responses) < 2:
        return transfer
    from balance_cli.signals.response.common_modes import contradicting_modes
    from balance_cli.signals.response.repeated_responses import contradicting_responses

    found = (*contradicting_responses(transfer), *contradicting_modes(transfer))
    return replace(transfer, consistency=found or None)


def _measure_sweep(
    run: Run, channel_names: tuple[str, ...], estimator: str, band: tuple[float, float]
) -> PointForce | PeriodicRecord | FrequencyResponse:
    """The response to a force at a point, the lines of a periodic record, or the response of another one."""
    force = single_force(run)
    if force is not None:
        return _point_force(force, channel_names, estimator, band)
    return _measure_hub_loads(run, channel_names, estimator, band)


def _measure_hub_loads(
    run: Run, channel_names: tuple[str, ...], estimator: str, band: tuple[float, float]
) -> PeriodicRecord | FrequencyResponse:
    """The lines of a periodic record, or the response of one that does not repeat or never stops ringing."""
    if _is_periodic(run, estimator):
        record = periodic_record(run, channel_names, band)
        if estimator == PERIODIC or not record.rings:
            return record
    return _nonperiodic_response(run, channel_names, estimator, band)


def _point_force(
    force: SingleForce, channel_names: tuple[str, ...], estimator: str, band: tuple[float, float]
) -> PointForce:
    """The response to a force at a point, by the load to which its multiples refer."""
    measured = _measure_hub_loads(force.run, channel_names, estimator, band)
    response = joint_response([measured]) if isinstance(measured, PeriodicRecord) else measured
    return PointForce(response, force.multiples)


def add_point_responses(
    at_hub: list[FrequencyResponse], forces: Sequence[PointForce]
) -> tuple[list[FrequencyResponse], dict[str, str]]:
    """Add the responses to the hub loads that forces at points span, one for each rotor speed.

    Also returned is why runs give none. Raises UserError where they give none, and there is no response at the hub.
    """
    responses = list(at_hub)
    faults: dict[str, str] = {}
    for speed in dict.fromkeys(force.response.rotor_speed for force in forces):
        members = [force for force in forces if force.response.rotor_speed == speed]
        try:
            combined, used = _combine_forces(members, [item for item in at_hub if item.rotor_speed == speed])
        except UserError as error:
            if not at_hub:
                raise
            faults |= {force.response.run: f"{error.fault}. {error.remedy}" for force in members}
        else:
            responses = [item for item in responses if not any(item is other for other in used)] + [combined]
    return responses, faults


def _combine_forces(
    forces: Sequence[PointForce], at_hub: Sequence[FrequencyResponse]
) -> tuple[FrequencyResponse, list[FrequencyResponse]]:
    """Combine forces at points, with responses to single hub loads where they do not span their loads by themselves.

    The responses to hub loads that were used are returned, too. Raises UserError where these do not help either.
    """
    driven = np.any([force.multiples != 0.0 for force in forces], axis=0)
    single = [item for item in at_hub if len(item.components) == 1 and driven[COMPONENTS.index(item.components[0])]]
    try:
        return combine_point_forces(forces), []
    except UserError:
        if not single:
            raise
    unit = np.eye(len(COMPONENTS))
    hub_forces = [PointForce(item, unit[COMPONENTS.index(item.components[0])]) for item in single]
    return combine_point_forces([*forces, *hub_forces]), single


def _live_channels_by_run(
    sweeps: Sequence[Run], geometry: Geometry
) -> tuple[dict[str, tuple[str, ...]], dict[str, dict[str, str]]]:
    """Live channels of every sweep, and those left out, with the reason."""
    health = {run.name: live_channels(run, geometry) for run in sweeps}
    for run in sweeps:
        if not health[run.name].live:
            raise UserError("no channel can be used", run.file, "channels", "Leave the run out")
    left_out = {name: channels.left_out for name, channels in health.items() if channels.left_out}
    return {name: channels.live for name, channels in health.items()}, left_out


def _is_periodic(run: Run, estimator: str) -> bool:
    """Whether the response of the run is taken from the lines of whole periods."""
    return has_whole_periods(run) if estimator == AUTO else estimator == PERIODIC


def _nonperiodic_response(
    run: Run, channel_names: tuple[str, ...], estimator: str, band: tuple[float, float]
) -> FrequencyResponse:
    if estimator in AVERAGED_ESTIMATORS:
        return averaged_response(run, channel_names, estimator, band)
    run = prepend_rest(use_hammer_record(run))
    return local_response(run, channel_names, LOCAL_RATIONAL if estimator == AUTO else estimator, band)


def _periodic_responses(records: Sequence[tuple[Run, PeriodicRecord]]) -> list[FrequencyResponse]:
    """Responses of periodic runs; those that excite several components are solved together where there are enough."""
    groups: list[list[tuple[Run, PeriodicRecord]]] = []
    for item in records:
        same = [members for members in groups if _can_be_solved_together(item, members[0])]
        if same:
            same[0].append(item)
        else:
            groups.append([item])
    responses = []
    for members in groups:
        inputs = len(members[0][1].spectrum.components)
        if inputs == 1:
            responses += [joint_response([record]) for _, record in members]
        elif len(members) >= inputs:
            responses.append(_with_levels(joint_response([record for _, record in members]), members))
        else:
            responses += [
                _with_levels(response_from_one_run(run, record.spectrum), [(run, record)]) for run, record in members
            ]
    return responses


def _can_be_solved_together(first: tuple[Run, PeriodicRecord], second: tuple[Run, PeriodicRecord]) -> bool:
    """Whether two runs have the same lines and components, and declare the same levels up to `SAME_LEVEL`."""
    keys, levels = [], []
    for run, record in (first, second):
        spectrum = record.spectrum
        keys.append((spectrum.components, spectrum.rotor_speed, spectrum.channel_names, spectrum.frequency.tobytes()))
        levels.append(np.array(run.level if set(run.excited) == set(spectrum.components) else (), float))
    same_levels = levels[0].shape == levels[1].shape and np.allclose(levels[0], levels[1], rtol=SAME_LEVEL, atol=0.0)
    return keys[0] == keys[1] and bool(same_levels)


def _with_levels(response: FrequencyResponse, members: Sequence[tuple[Run, PeriodicRecord]]) -> FrequencyResponse:
    """The response with the level of each component, from the run that declares it (NaN where none does)."""
    declared: dict[str, float] = {}
    for run, _ in members:
        declared.update(zip(run.excited, run.level, strict=False))
    return replace(response, level=tuple(declared.get(name, float("nan")) for name in response.components))


def _steady_part(record: PeriodicRecord) -> SteadyPart:
    return SteadyPart(
        start=record.start,
        stop=record.stop,
        period=record.period,
        periods=record.periods,
        first=int(record.first.min()),
        last=int(record.first.max()),
        steady=record.steady,
    )
