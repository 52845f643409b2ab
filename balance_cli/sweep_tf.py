"""Frequency responses of the sweeps of a campaign, with their covariance.

Which estimator: periodic records need none but the ratio of their lines; others get a local rational model, which does
not leak. H1, H2, Hv and the local polynomial method are there for comparison.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from balance_cli.channel_health import live_channels
from balance_cli.components import COMPONENTS
from balance_cli.errors import UserError
from balance_cli.geometry import Geometry
from balance_cli.runs import Run
from balance_cli.signals.averaged import ESTIMATORS as AVERAGED
from balance_cli.signals.averaged import averaged_response
from balance_cli.signals.line_response import joint_response, response_across_lines
from balance_cli.signals.lines import Response
from balance_cli.signals.local_response import local_response
from balance_cli.signals.periodic import PeriodicRecord, periodic_record, repeats

ESTIMATORS = ("auto", "periodic", "lrm", "lpm", *AVERAGED)


@dataclass(frozen=True)
class SteadyPart:
    """Part of a periodic run that was used: `start` to `stop` [s] at every line; `period` [s]; `periods` in the record;

    `first` and `last`: earliest and latest steady period of a line (0 is the first); `steady`: by test.
    """

    start: float
    stop: float
    period: float
    periods: int
    first: int
    last: int
    steady: bool


@dataclass(frozen=True)
class Transfer:
    """Measured responses of a rig, one per run and level (or one for runs that were solved together).

    `estimator` is what was asked for; each response names its own. `steady` {run: part used}; `channels_left_out`
    {run: {channel: why}}; `unused` {run: why}.
    """

    geometry: Geometry
    responses: tuple[Response, ...]
    estimator: str = "auto"
    steady: dict[str, SteadyPart] = field(default_factory=dict)
    channels_left_out: dict[str, dict[str, str]] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)


def estimate_responses(
    runs: Iterable[Run], geometry: Geometry, estimator: str = "auto", band: tuple[float, float] = (0.0, np.inf)
) -> Transfer:
    """Responses of all sweeps among the runs by one of ESTIMATORS, at their lines within `band` [Hz].

    UserError: no sweep at all, a sweep with no live channel, or one that the estimator cannot use.
    """
    if not band[0] < band[1]:
        raise UserError(f"there is nothing between {band[0]:g} and {band[1]:g} Hz", "--from, --to")
    given = tuple(runs)
    sweeps = [run for run in given if run.kind == "sweep"]
    if not sweeps:
        raise UserError("none of the runs is a sweep", remedy="Give at least one run of kind `sweep`")
    live, left_out = _live(sweeps, geometry)
    periodic = [run for run in sweeps if _is_periodic(run, estimator)]
    records = [(run, periodic_record(run, live[run.name], band)) for run in periodic]
    rest = [run for run in sweeps if run not in periodic]
    return Transfer(
        geometry=geometry,
        responses=(*_periodic_responses(records), *(_other(run, live[run.name], estimator, band) for run in rest)),
        estimator=estimator,
        steady={run.name: _steady_part(record) for run, record in records},
        channels_left_out=left_out,
        unused={run.name: f"a {run.kind} run; only sweeps are used" for run in given if run.kind != "sweep"},
    )


def combined(transfer: Transfer, component: str, level: str = "highest") -> Response:
    """The response to one component alone, of its `highest` or `lowest` level; of several, the one of least sigma.

    UserError where no sweep excited that component.
    """
    having = [one_component(response, component) for response in transfer.responses if component in response.components]
    if not having:
        raise UserError(f"there is no measured response to {component}", remedy="Include a sweep that excites it")
    levels = [response.level[0] for response in having]
    wanted = max(levels) if level == "highest" else min(levels)
    return min((r for r in having if np.isclose(r.level[0], wanted)), key=lambda r: float(np.median(relative_sigma(r))))


def one_component(response: Response, component: str) -> Response:
    """The column of one component; its level is nan where the run did not declare it excited."""
    j = response.components.index(component)
    return replace(
        response,
        components=(component,),
        response=response.response[:, :, j : j + 1],
        load_covariance=response.load_covariance[:, j : j + 1, j : j + 1],
        coherence=response.coherence[:, :, j : j + 1],
        level=(response.level[j] if len(response.level) == len(response.components) else float("nan"),),
    )


def relative_sigma(response: Response) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Standard deviation over amplitude (k,) of a one-component response, in the channel where it is least."""
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    variance = channels * response.load_covariance[:, :1, 0].real
    amplitude = np.maximum(np.abs(response.response[:, :, 0]), 1e-300)
    return np.asarray(np.min(np.sqrt(variance) / amplitude, axis=1))


def least_coherence(transfer: Transfer) -> dict[str, float]:
    """{component: least over all lines and runs of the multiple coherence of the best-responding channel}."""
    return {
        name: min(
            float(np.min(np.max(r.multiple_coherence, axis=1))) for r in transfer.responses if name in r.components
        )
        for name in components_of(transfer)
    }


def components_of(transfer: Transfer) -> tuple[str, ...]:
    """Components that some response has, in the usual order."""
    found = {name for response in transfer.responses for name in response.components}
    return tuple(name for name in COMPONENTS if name in found)


def _live(sweeps: Sequence[Run], geometry: Geometry) -> tuple[dict[str, tuple[str, ...]], dict[str, dict[str, str]]]:
    """Live channels of every sweep, and those left out with the reason."""
    health = {run.name: live_channels(run, geometry) for run in sweeps}
    for run in sweeps:
        if not health[run.name].live:
            raise UserError("no channel is left", str(run.path or run.name), "channels", "Mend or leave out this run")
    left_out = {name: each.left_out for name, each in health.items() if each.left_out}
    return {name: each.live for name, each in health.items()}, left_out


def _is_periodic(run: Run, estimator: str) -> bool:
    """Whether the lines of whole periods are to be used."""
    return repeats(run) if estimator == "auto" else estimator == "periodic"


def _other(run: Run, channel_names: tuple[str, ...], estimator: str, band: tuple[float, float]) -> Response:
    if estimator in AVERAGED:
        return averaged_response(run, channel_names, estimator, band)
    return local_response(run, channel_names, "lrm" if estimator == "auto" else estimator, band)


def _periodic_responses(records: Sequence[tuple[Run, PeriodicRecord]]) -> list[Response]:
    """Runs that excite several components are solved together where there are enough of them, else one by one."""
    groups: dict[tuple[object, ...], list[tuple[Run, PeriodicRecord]]] = {}
    for run, record in records:
        groups.setdefault(_group_key(run, record), []).append((run, record))
    responses = []
    for members in groups.values():
        inputs = len(members[0][1].lines.components)
        if inputs == 1:
            responses += [joint_response([record]) for _, record in members]
        elif len(members) >= inputs:
            responses.append(_with_levels(joint_response([record for _, record in members]), members))
        else:
            responses += [
                _with_levels(response_across_lines(run, record.lines), [(run, record)]) for run, record in members
            ]
    return responses


def _group_key(run: Run, record: PeriodicRecord) -> tuple[object, ...]:
    """What runs must share to be solved together."""
    lines = record.lines
    level = run.level if set(run.excited) == set(lines.components) else ()
    return (lines.components, level, lines.rotor_speed, lines.channel_names, lines.frequency.tobytes())


def _with_levels(response: Response, members: Sequence[tuple[Run, PeriodicRecord]]) -> Response:
    """The response with the level of each component, from the run that declares it (nan where none does)."""
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
