"""What must hold in a run file: attributes of its kind, shapes, names, units, pulses; samples of its loads."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.campaign.recording.run import Array, Run, SampleSource
from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.campaign.rig.components import COMPONENTS, EXCITATIONS, RUN_KINDS, UNIT_OF
from balance_cli.io.errors import UserError

KINDS_WITH_LOADS = ("static", "sweep", "check")
KINDS_WITH_PULSES = ("check", "wind")


@dataclass(frozen=True)
class DatasetLayout:
    """A dataset (n, columns) without its samples.

    `kind` is numpy's of its dtype, `units` are one for all columns or one each, `is_complete` says that every sample
    was
    written.
    """

    shape: tuple[int, ...]
    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    is_complete: bool = True


@dataclass(frozen=True)
class RunFileContents:
    """A run file without its samples; `angles` are those of the dataset `attitude`, columns as its names say."""

    attributes: Mapping[str, Any]
    channels: DatasetLayout | None
    loads: DatasetLayout | None
    pulse_times: Array | None
    attitude: DatasetLayout | None = None
    angles: Array | None = None


def run_from_contents(contents: RunFileContents, source: SampleSource, path: Path) -> Run:
    """The run that sound contents declare."""
    attributes, kind = contents.attributes, contents.attributes["kind"]
    channels = contents.channels
    assert channels is not None
    rate, speed, period = (attributes.get(name) for name in ("sample_rate", "rotor_speed", "period"))
    sweep = kind == "sweep"
    return Run(
        name=attributes["run"],
        rig=attributes["rig"],
        kind=kind,
        channel_names=channels.names,
        samples=channels.shape[0],
        source=source,
        has_loads=contents.loads is not None,
        sample_rate=None if kind == "static" or rate is None else float(rate),
        rotor_speed=0.0 if kind == "static" or speed is None else float(speed),
        excited=tuple(_as_list(attributes["excited"])) if sweep else (),
        excitation=attributes["excitation"] if sweep else None,
        level=tuple(float(level) for level in _as_list(attributes["level"])) if sweep else (),
        period=float(period) if sweep and period is not None else None,
        trim=attributes["trim"] if kind == "static" else None,
        pulse_times=None if contents.pulse_times is None else np.asarray(contents.pulse_times, float),
        attitude=_attitude_angles(contents),
        recorded=_optional_text(attributes.get("recorded")),
        note=_optional_text(attributes.get("note")),
        path=path,
    )


def _attitude_angles(contents: RunFileContents) -> Array | None:
    """Pitch and roll (n, 2) [deg]."""
    if contents.attitude is None or contents.angles is None:
        return None
    return np.asarray(contents.angles[:, [contents.attitude.names.index(name) for name in ANGLES]], float)


def run_file_faults(contents: RunFileContents) -> Iterator[UserError]:
    """All faults of a run file that show without its samples."""
    attributes = contents.attributes
    kind = attributes.get("kind")
    for name in ("run", "rig"):
        yield from _text_fault(attributes, name)
    yield from _channel_faults(contents.channels, 2 if kind != "static" else 1)
    if kind not in RUN_KINDS:
        yield _attribute_fault("kind", kind, f"one of {', '.join(RUN_KINDS)}")
        return
    yield from _kind_faults(kind, attributes)
    yield from _load_faults(kind, contents.loads, contents.channels)
    yield from _pulse_faults(contents, required=kind in KINDS_WITH_PULSES)
    if contents.attitude is not None:
        yield from _attitude_faults(kind, contents)


def load_sample_faults(run: Run) -> Iterator[UserError]:
    """Faults that only the samples of the loads show: not finite; zero where they are said to be excited."""
    if not run.has_loads:
        return
    bad, largest = np.zeros(len(COMPONENTS), int), np.zeros(len(COMPONENTS))
    for block in run.blocks():
        assert block.loads is not None
        finite = np.isfinite(block.loads)
        bad += (~finite).sum(axis=0)
        largest = np.maximum(largest, np.abs(np.where(finite, block.loads, 0.0)).max(axis=0, initial=0.0))
    for name, count, peak in zip(COMPONENTS, bad, largest, strict=True):
        if count:
            fault = f"{count} of {run.samples} samples of the load are not finite"
            yield UserError(fault, place=f"loads, column {name}", remedy="Repeat the run, or cut it before they begin")
        elif name in run.excited and peak == 0.0:
            fault = "all zero (so declared as not measured), though `excited` names it"
            yield UserError(fault, place=f"loads, column {name}", remedy="Correct `excited`, or record this load")


# ---- attributes ------------------------------------------------------------------------------------------------------


def _kind_faults(kind: str, attributes: Mapping[str, Any]) -> Iterator[UserError]:
    if kind == "static":
        yield from _text_fault(attributes, "trim")
        return
    if not _is_number(attributes.get("sample_rate"), above=0.0):
        yield _attribute_fault("sample_rate", attributes.get("sample_rate"), "a number above 0 [Hz]")
    speed = attributes.get("rotor_speed")
    if not (_is_number(speed, above=0.0) or (_is_number(speed) and speed == 0)):
        yield _attribute_fault("rotor_speed", speed, "a number from 0 up [Hz]")
    if kind == "sweep":
        yield from _sweep_faults(attributes)


def _sweep_faults(attributes: Mapping[str, Any]) -> Iterator[UserError]:
    excited, level = (_as_list(attributes.get(name)) for name in ("excited", "level"))
    if not excited or len(set(excited)) < len(excited) or any(name not in COMPONENTS for name in excited):
        yield _attribute_fault("excited", attributes.get("excited"), f"of {', '.join(COMPONENTS)}, each once at most")
    excitation, period = attributes.get("excitation"), attributes.get("period")
    if excitation not in EXCITATIONS:
        yield _attribute_fault("excitation", excitation, f"one of {', '.join(EXCITATIONS)}")
    if len(level) != len(excited) or not all(_is_number(value, above=0.0) for value in level):
        yield _attribute_fault("level", attributes.get("level"), "an rms above 0 for each component excited")
    if (period is not None or excitation == "multisine") and not _is_number(period, above=0.0):
        yield _attribute_fault("period", period, "a time above 0 [s]")


def _text_fault(attributes: Mapping[str, Any], name: str) -> Iterator[UserError]:
    value = attributes.get(name)
    if not (isinstance(value, str) and value.strip()):
        yield _attribute_fault(name, value, "a name")


def _attribute_fault(name: str, value: object, expected: str) -> UserError:
    found = "is missing" if value is None else f"is {value!r}"
    return UserError(f"attribute `{name}` {found}", place=f"attribute {name}", remedy=f"It should be {expected}")


def _as_list(value: Any) -> list[Any]:
    """A scalar or array attribute as a list."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def _is_number(value: object, above: float = -math.inf) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > above


def _optional_text(value: object) -> str | None:
    return None if value is None else str(value)


# ---- datasets --------------------------------------------------------------------------------------------------------


def _channel_faults(table: DatasetLayout | None, least_rows: int) -> Iterator[UserError]:
    yield from _table_faults("channels", table)
    if table is None or len(table.shape) != 2:
        return
    if table.shape[0] < least_rows:
        yield UserError(f"holds {table.shape[0]} samples", place="channels", remedy="Record the run again")
    if set(table.units) != {"V"}:
        fault = f"its unit is {', '.join(table.units) or 'missing'}"
        yield UserError(fault, place="channels, attribute unit", remedy="It should be `V`")


def _table_faults(place: str, table: DatasetLayout | None) -> Iterator[UserError]:
    if table is None:
        yield UserError(f"the dataset `{place}` is missing", place=place, remedy="Add it")
        return
    if len(table.shape) != 2 or table.kind not in "iuf":
        fault = f"has the shape {table.shape}" if table.kind in "iuf" else "does not hold real numbers"
        yield UserError(fault, place=place, remedy="It should be numbers, samples by columns")
        return
    if not table.is_complete:
        yield UserError("not all samples were written", place=place, remedy="The record broke off; record it again")
    if len(table.names) != table.shape[1]:
        fault = f"{len(table.names)} names for {table.shape[1]} columns"
        yield UserError(fault, place=f"{place}, attribute names", remedy="Give one name a column")
    for name in sorted({name for name in table.names if table.names.count(name) > 1 or not name}):
        fault = f"the name `{name}` stands twice" if name else "a name is empty"
        yield UserError(fault, place=f"{place}, attribute names", remedy="Names must differ")


def _load_faults(kind: str, loads: DatasetLayout | None, channels: DatasetLayout | None) -> Iterator[UserError]:
    if kind not in KINDS_WITH_LOADS:
        if loads is not None:
            yield UserError(
                f"a `{kind}` run has no loads", place="loads", remedy="Remove the dataset, or correct `kind`"
            )
        return
    yield from _table_faults("loads", loads)
    if loads is None or len(loads.shape) != 2:
        return
    if set(loads.names) != set(COMPONENTS):
        fault = f"the columns are {', '.join(loads.names) or 'not named'}"
        yield UserError(fault, place="loads, attribute names", remedy=f"They should be {', '.join(COMPONENTS)}")
    elif loads.units != tuple(UNIT_OF[name] for name in loads.names):
        fault = f"the units are {', '.join(loads.units) or 'missing'}"
        yield UserError(fault, place="loads, attribute units", remedy="They should be N for forces, N m for moments")
    if channels is not None and channels.shape[:1] != loads.shape[:1]:
        fault = f"{loads.shape[0]} rows, but {channels.shape[0] if channels.shape else 0} rows of channels"
        yield UserError(fault, place="loads", remedy="Both should have one row a sample")


def _attitude_faults(kind: str, contents: RunFileContents) -> Iterator[UserError]:
    table, channels = contents.attitude, contents.channels
    assert table is not None
    if kind != "static":
        fault = f"a `{kind}` run has no attitude"
        yield UserError(fault, place="attitude", remedy="Remove the dataset, or correct `kind`")
        return
    yield from _table_faults("attitude", table)
    if len(table.shape) != 2 or table.kind not in "iuf":
        return
    if sorted(table.names) != sorted(ANGLES) or table.shape[1] != len(ANGLES):
        fault = f"{table.shape[1]} columns, named {', '.join(table.names) or 'nothing'}"
        yield UserError(fault, place="attitude, attribute names", remedy=f"They should be {' and '.join(ANGLES)}")
    if set(table.units) != {"deg"}:
        fault = f"its unit is {', '.join(table.units) or 'missing'}"
        yield UserError(fault, place="attitude, attribute unit", remedy="It should be `deg`")
    if channels is not None and channels.shape[:1] != table.shape[:1]:
        fault = f"{table.shape[0]} rows, but {channels.shape[0] if channels.shape else 0} rows of channels"
        yield UserError(fault, place="attitude", remedy="Both should have one row a load point")
    yield from _angle_faults(contents.angles)


def _angle_faults(angles: Array | None) -> Iterator[UserError]:
    bad = [] if angles is None else np.flatnonzero(~np.isfinite(angles).all(axis=1)).tolist()
    if bad:
        fault = f"{len(bad)} of its rows are not finite, row {bad[0] + 1} first"
        yield UserError(fault, place="attitude", remedy="Give the attitude of every row, or remove the dataset")


def _pulse_faults(contents: RunFileContents, required: bool) -> Iterator[UserError]:
    place, pulses = "rotor/pulse_times", contents.pulse_times
    if pulses is None:
        if required:
            yield UserError("the dataset is missing", place=place, remedy="Record the 1/rev pulses")
        return
    if pulses.ndim != 1 or pulses.dtype.kind not in "iuf":
        yield UserError("is not one row of numbers", place=place, remedy="Give times in s from the first sample")
        return
    if required and len(pulses) < 2:
        yield UserError(f"holds {len(pulses)} pulses", place=place, remedy="At least one whole revolution is needed")
    bad = np.flatnonzero(~np.isfinite(pulses))
    if len(bad):
        yield UserError(f"pulse {bad[0]} is not finite", place=place, remedy="Correct or remove it")
        return
    yield from _interval_faults(pulses, contents, place, required)


def _interval_faults(pulses: Array, contents: RunFileContents, place: str, required: bool) -> Iterator[UserError]:
    intervals = np.diff(pulses)
    backwards = np.flatnonzero(intervals <= 0)
    if len(backwards):
        fault = f"pulse {backwards[0] + 1} is not later than the one before"
        yield UserError(fault, place=place, remedy="Times must increase")
        return
    rate, channels = contents.attributes.get("sample_rate"), contents.channels
    if required and channels is not None and channels.shape and rate is not None and _is_number(rate, above=0.0):
        inside = (pulses >= 0) & (pulses <= channels.shape[0] / rate)
        if inside.sum() < 2:
            fault = "no whole revolution lies within the record"
            yield UserError(fault, place=place, remedy="Give times in s from the first sample")
