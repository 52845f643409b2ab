"""What a run file holds beside its samples, and the run that it declares."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.campaign.recording.point_labels import LabelDataset
from balance_cli.campaign.recording.run import Array, Run, SampleSource
from balance_cli.campaign.rig.attitude import ANGLES


@dataclass(frozen=True)
class DatasetLayout:
    """A dataset (n, columns) without its values.

    `kind` is numpy's code of its type. `units` holds one unit for all columns, or one for each. `is_complete` says
    that every value was written. `declared_bytes` and `stored_bytes` are its size in memory and in the file.
    """

    shape: tuple[int, ...]
    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    is_complete: bool = True
    declared_bytes: int = 0
    stored_bytes: int = 0

    @property
    def is_real(self) -> bool:
        """Whether it holds real numbers."""
        return self.kind in "iuf"


@dataclass(frozen=True)
class RunFileContents:
    """A run file without its samples.

    `pulses` and `attitude` are the layouts of `rotor/pulse_times` and `attitude`, `pulse_times` and `angles` their
    values: None where the layout is not sound. The columns of `angles` are ordered as `attitude.names` says. `series`
    and `point`: the labels of the load points. `excitation`: the layout of the measured voltages of the bridges,
    `channel_excitation` the constant ones.
    """

    attributes: Mapping[str, Any]
    channels: DatasetLayout | None
    loads: DatasetLayout | None
    pulses: DatasetLayout | None = None
    pulse_times: Array | None = None
    attitude: DatasetLayout | None = None
    angles: Array | None = None
    has_load_points: bool = False
    series: LabelDataset | None = None
    point: LabelDataset | None = None
    conditions: Mapping[str, float] = field(default_factory=dict)
    excitation: DatasetLayout | None = None
    channel_excitation: Any = None


def run_from_contents(contents: RunFileContents, source: SampleSource, path: Path) -> Run:
    """Return the run that contents without a fault declare."""
    attributes, kind = contents.attributes, contents.attributes["kind"]
    channels = contents.channels
    assert channels is not None
    rate, speed = attributes.get("sample_rate"), attributes.get("rotor_speed")
    period = stated_period(attributes)
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
        excited=tuple(as_list(attributes["excited"])) if sweep else (),
        excitation=attributes["excitation"] if sweep else None,
        level=tuple(float(level) for level in as_list(attributes["level"])) if sweep else (),
        period=float(period) if sweep and period is not None else None,
        trim=attributes["trim"] if kind == "static" else None,
        pulse_times=_pulses_within(contents.pulse_times),
        attitude=_attitude_angles(contents),
        series_labels=None if contents.series is None else contents.series.labels,
        point_kinds=None if contents.point is None else contents.point.labels,
        recorded=_optional_text(attributes.get("recorded")),
        note=_optional_text(attributes.get("note")),
        path=path,
        conditions=dict(contents.conditions),
    )


def _pulses_within(times: Array | None) -> Array | None:
    """Pulse times [s] from the first sample on: pulses before it, of an earlier trigger, have no samples."""
    if times is None:
        return None
    pulses = np.asarray(times, float)
    return pulses[pulses >= 0.0]


def _attitude_angles(contents: RunFileContents) -> Array | None:
    """Pitch and roll (n, 2) [deg]."""
    if contents.attitude is None or contents.angles is None:
        return None
    return np.asarray(contents.angles[:, [contents.attitude.names.index(name) for name in ANGLES]], float)


def stated_period(attributes: Mapping[str, Any]) -> Any:
    """The attribute `period`; None where it is absent, and where zero or not a number says that there is none."""
    period = attributes.get("period")
    no_period = isinstance(period, int | float) and (period == 0 or math.isnan(period))
    return None if no_period and attributes.get("excitation") != "multisine" else period


def as_list(value: Any) -> list[Any]:
    """Return a scalar or array attribute as a list, empty where there is none."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def _optional_text(value: object) -> str | None:
    return None if value is None else str(value)
