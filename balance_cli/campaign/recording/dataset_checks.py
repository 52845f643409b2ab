"""Checks of the datasets of a run file: first their layouts, then the few values that are read with them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.campaign.recording.attribute_checks import is_positive
from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE, Array
from balance_cli.campaign.recording.run_schema import DatasetLayout, RunFileContents
from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.io.errors import UserError
from balance_cli.io.units import parse_unit

KINDS_WITH_LOADS = ("static", "sweep", "check")
KINDS_WITH_PULSES = ("check", "wind")
PULSE_DATASET = "rotor/pulse_times"

MOST_PULSES = 10_000_000
"""1/rev pulses of a run: more than two days at 50 revolutions a second, and 80 MB."""
LARGEST_ANGLE = 360.0
"""Degrees."""
COMPRESSION_TESTED = 2**28
"""Bytes of samples from which their compression is tested; fewer are read in no time."""
LARGEST_COMPRESSION = 200.0
"""Ratio of declared to stored bytes. One bit of noise a sample, in numbers of 64, allows 64; constants give 1000."""


def channel_faults(layout: DatasetLayout | None, least_rows: int) -> Iterator[UserError]:
    """Yield the faults of the dataset `channels`."""
    yield from _table_faults("channels", layout)
    if layout is None or len(layout.shape) != 2:
        return
    if layout.shape[0] < least_rows:
        yield UserError(f"holds {layout.shape[0]} samples", place="channels", remedy="Record the run again")
    size = layout.declared_bytes
    if layout.is_complete and size >= COMPRESSION_TESTED and size > LARGEST_COMPRESSION * layout.stored_bytes:
        fault = f"{layout.shape[0]} rows in {layout.stored_bytes} bytes: nearly all samples have the same value"
        yield UserError(fault, place="channels", remedy="Write the samples that were recorded, and no others")


def load_faults(kind: str, loads: DatasetLayout | None, channels: DatasetLayout | None) -> Iterator[UserError]:
    """Yield the faults of the dataset `loads`."""
    if kind not in KINDS_WITH_LOADS:
        if loads is not None:
            fault, remedy = f"a `{kind}` run has no loads", "Remove the dataset, or correct `kind`"
            yield UserError(fault, place="loads", remedy=remedy)
        return
    yield from _table_faults("loads", loads)
    if loads is None or len(loads.shape) != 2:
        return
    if set(loads.names) != set(COMPONENTS):
        fault = f"the columns are {', '.join(loads.names) or 'not named'}"
        yield UserError(fault, place="loads, attribute names", remedy=f"They should be {', '.join(COMPONENTS)}")
    elif len(loads.units) != len(loads.names) or not all(map(_is_unit_of, loads.units, loads.names)):
        fault = f"the units are {', '.join(loads.units) or 'missing'}"
        yield UserError(fault, place="loads, attribute units", remedy="They should be N for forces, N m for moments")
    yield from _row_count_fault("loads", loads, channels, "Both should have one row for each sample")


def _is_unit_of(text: str, component: str) -> bool:
    """Whether a text is the unit of a load component, in any spelling (`N m`, `Nm`, `N*m`)."""
    if text == UNIT_OF[component]:
        return True
    try:
        return parse_unit(text, UNIT_OF[component]).factor == 1.0
    except UserError:
        return False


def attitude_faults(kind: str, contents: RunFileContents) -> Iterator[UserError]:
    """Yield the faults of the dataset `attitude`, which is optional in a static run."""
    layout = contents.attitude
    if layout is None:
        return
    if kind != "static":
        fault, remedy = f"a `{kind}` run has no attitude", "Remove the dataset, or correct `kind`"
        yield UserError(fault, place="attitude", remedy=remedy)
        return
    yield from _table_faults("attitude", layout)
    if len(layout.shape) != 2 or not layout.is_real:
        return
    if sorted(layout.names) != sorted(ANGLES) or layout.shape[1] != len(ANGLES):
        fault = f"{layout.shape[1]} columns, named {', '.join(layout.names) or 'nothing'}"
        yield UserError(fault, place="attitude, attribute names", remedy=f"They should be {' and '.join(ANGLES)}")
    if set(layout.units) != {"deg"}:
        fault = f"its unit is {', '.join(layout.units) or 'missing'}"
        yield UserError(fault, place="attitude, attribute unit", remedy="It should be `deg`")
    yield from _row_count_fault("attitude", layout, contents.channels, "Both should have one row for each load point")
    yield from _angle_faults(contents.angles)


def pulse_faults(kind: str, contents: RunFileContents) -> Iterator[UserError]:
    """Yield the faults of the dataset `rotor/pulse_times`, which a record at rest need not have."""
    required = kind in KINDS_WITH_PULSES and contents.attributes.get("rotor_speed") != 0
    if contents.pulses is None:
        if required:
            remedy = "Record the 1/rev pulses. Where no rotor turns, or its pulses are lost, set `rotor_speed` to 0"
            yield UserError("the dataset is missing", place=PULSE_DATASET, remedy=remedy)
        return
    layout_fault = next(_pulse_layout_faults(contents.pulses, required), None)
    if layout_fault is not None:
        yield layout_fault
    elif contents.pulse_times is not None:
        yield from _pulse_time_faults(contents.pulse_times, contents, required)


def is_loadable(layout: DatasetLayout | None, most_rows: int) -> bool:
    """Whether the values of a small dataset can be read: real numbers, all of them written, and not too many."""
    if layout is None or not layout.is_real or not layout.is_complete:
        return False
    return layout.shape[:1] <= (most_rows,) and all(size <= len(ANGLES) for size in layout.shape[1:])


def _table_faults(place: str, layout: DatasetLayout | None) -> Iterator[UserError]:
    """Yield the faults that any dataset of rows and named columns can have."""
    if layout is None:
        yield UserError(f"the dataset `{place}` is missing", place=place, remedy="Add it")
        return
    if len(layout.shape) != 2 or not layout.is_real:
        fault = f"has the shape {layout.shape}" if layout.is_real else "does not hold real numbers"
        yield UserError(fault, place=place, remedy="It should be numbers, samples by columns")
        return
    if layout.shape[1] == 0:
        yield UserError("has no columns", place=place, remedy="Give one column for each name")
    if not layout.is_complete:
        yield UserError("not all samples were written", place=place, remedy="The record broke off; record it again")
    if len(layout.names) != layout.shape[1]:
        fault = f"{len(layout.names)} names for {layout.shape[1]} columns"
        yield UserError(fault, place=f"{place}, attribute names", remedy="Give one name for each column")
    for name in sorted({name for name in layout.names if layout.names.count(name) > 1 or not name}):
        fault = f"the name `{name}` is used twice" if name else "a name is empty"
        yield UserError(fault, place=f"{place}, attribute names", remedy="Names must differ")


def _row_count_fault(
    place: str, layout: DatasetLayout, channels: DatasetLayout | None, remedy: str
) -> Iterator[UserError]:
    if channels is not None and channels.shape[:1] != layout.shape[:1]:
        fault = f"{layout.shape[0]} rows, but {channels.shape[0] if channels.shape else 0} rows of channels"
        yield UserError(fault, place=place, remedy=remedy)


def _angle_faults(angles: Array | None) -> Iterator[UserError]:
    if angles is None:
        return
    bad = np.flatnonzero(~(np.abs(angles) <= LARGEST_ANGLE).all(axis=1)).tolist()
    if bad:
        fault = f"{len(bad)} of its rows are not finite or exceed {LARGEST_ANGLE:g} deg, row {bad[0] + 1} first"
        yield UserError(fault, place="attitude", remedy="Give the attitude of every row, or remove the dataset")


def _pulse_layout_faults(layout: DatasetLayout, required: bool) -> Iterator[UserError]:
    remedy = "Give times in s from the first sample"
    if len(layout.shape) != 1 or not layout.is_real:
        yield UserError("is not a one-dimensional array of numbers", place=PULSE_DATASET, remedy=remedy)
        return
    count = layout.shape[0]
    if not layout.is_complete:
        fault = f"declares {count} pulses, but not all of them were written"
        yield UserError(fault, place=PULSE_DATASET, remedy="The record broke off; record it again")
    if count > MOST_PULSES:
        fault = f"holds {count} pulses, more than {MOST_PULSES}"
        yield UserError(fault, place=PULSE_DATASET, remedy="Give one pulse for each revolution")
    if required and count < 2:
        fault = f"holds {count} pulses"
        yield UserError(fault, place=PULSE_DATASET, remedy="At least one whole revolution is needed")


def _pulse_time_faults(pulses: Array, contents: RunFileContents, required: bool) -> Iterator[UserError]:
    bad = np.flatnonzero(~(np.abs(pulses) <= LARGEST_MAGNITUDE))
    if len(bad):
        fault = f"pulse {bad[0]} is not finite, or beyond {LARGEST_MAGNITUDE:g} s"
        yield UserError(fault, place=PULSE_DATASET, remedy="Correct or remove it")
        return
    backwards = np.flatnonzero(np.diff(pulses) <= 0)
    if len(backwards):
        fault = f"pulse {backwards[0] + 1} is not later than the one before"
        yield UserError(fault, place=PULSE_DATASET, remedy="Times must increase")
        return
    rate, channels = contents.attributes.get("sample_rate"), contents.channels
    if required and channels is not None and channels.shape and is_positive(rate):
        inside = pulses[(pulses >= 0) & (pulses <= channels.shape[0] / rate)]
        if len(inside) < 2:
            fault = "no whole revolution lies within the record"
            yield UserError(fault, place=PULSE_DATASET, remedy="Give times in s from the first sample")
        elif 2 * (len(inside) - 1) > (inside[-1] - inside[0]) * rate:
            shortest = (inside[-1] - inside[0]) / (len(inside) - 1)
            fault = f"a pulse comes every {shortest:.3g} s: a revolution needs more than two samples at {rate:g} Hz"
            yield UserError(fault, place=PULSE_DATASET, remedy="Give one pulse for each revolution, in s")
