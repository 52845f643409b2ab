"""Units of the readings in a run file: volts, numbers, or ratios to the excitation of their bridges.

A file states one unit for all channels or one for each. It may hold the excitation of the bridges beside readings in
volts, constant (attribute of `channels`) or measured (dataset); these readings are ratios then. Readings are converted
to their base units, `V`, `V/V` and `1`, wherever samples are read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.run_schema import DatasetLayout, RunFileContents, as_list
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.io.units import NUMBER, RATIO, VOLTAGE, parse_unit

Array = NDArray[np.float64]

EXCITATION = "bridge_excitation"
"""Dataset (n,) or (n, k), or attribute of `channels`: voltage of the bridges."""
READING_UNITS = (VOLTAGE, RATIO, NUMBER)


@dataclass(frozen=True)
class ReadingConversion:
    """Stored readings times `factor` (c,) are in V, V/V or 1, where the excitation does not divide them.

    `constant` (c,) [V]: excitation that does not change, NaN where there is none. `column` (c,): column of the dataset
    of measured excitations, -1 where there is none; `volts`: V for one unit of that dataset.
    """

    factor: Array
    constant: Array
    column: NDArray[np.intp]
    volts: float = 1.0

    def convert(self, channels: Array, excitation: Array | None) -> Array:
        """Readings (m, c) in base units; NaN, a missing sample, where the measured excitation is not positive."""
        converted = channels * (self.factor / np.where(np.isfinite(self.constant), self.constant, 1.0))
        measured = self.column >= 0
        if excitation is not None and measured.any():
            supply = self.volts * excitation.reshape(len(channels), -1)[:, self.column[measured]]
            converted[:, measured] /= np.where(supply > 0.0, supply, np.nan)
        return np.asarray(converted)


def reading_units(contents: RunFileContents) -> dict[str, str]:
    """Base unit of each channel that is not read in V, of contents without a fault."""
    assert contents.channels is not None
    divided = set(_supplied_channels(contents))
    units = _stated_units(contents.channels)
    bases = {
        name: RATIO if name in divided else parse_unit(unit, *READING_UNITS).dimension for name, unit in units.items()
    }
    return {name: base for name, base in bases.items() if base != VOLTAGE}


def reading_conversion(contents: RunFileContents) -> ReadingConversion | None:
    """How readings become base units, of contents without a fault; None where they are stored in them."""
    assert contents.channels is not None
    names = contents.channels.names
    units = _stated_units(contents.channels)
    factor = np.array([parse_unit(units[name], *READING_UNITS).factor for name in names])
    supplied = _supplied_channels(contents)
    if not supplied and np.all(factor == 1.0):
        return None
    constant, column = np.full(len(names), np.nan), np.full(len(names), -1, np.intp)
    layout, volts = contents.excitation, 1.0
    if layout is None:
        values = dict(zip(names, _constant_excitations(contents), strict=True))
        constant = np.array([values[name] if name in supplied else np.nan for name in names])
    else:
        of_name = {name: layout.names.index(name) if layout.names else 0 for name in supplied}
        column = np.array([of_name.get(name, -1) for name in names], np.intp)
        volts = parse_unit(layout.units[0], VOLTAGE).factor
    return ReadingConversion(factor, constant, column, volts)


def reading_unit_faults(contents: RunFileContents) -> Iterator[UserError]:
    """Yield the faults of the units of the readings, and of the excitation of the bridges."""
    layout = contents.channels
    if layout is None or len(layout.shape) != 2 or len(layout.names) != layout.shape[1]:
        return
    fault = next(_unit_faults(layout), None) or next(_scale_faults(contents), None)
    if fault is not None:
        yield fault
        return
    if contents.excitation is not None and contents.channel_excitation is not None:
        remedy = f"Keep the dataset `{EXCITATION}` where it was measured, else the attribute"
        yield UserError("is given as dataset and as attribute of `channels`", place=EXCITATION, remedy=remedy)
    elif contents.excitation is not None:
        yield from _measured_faults(layout, contents.excitation)
    elif contents.channel_excitation is not None:
        yield from _constant_faults(layout, contents)


def reading_unit_mismatches(run: Run, geometry: Geometry) -> Iterator[UserError]:
    """Yield the channels of a run that are not in the unit in which the geometry declares them."""
    file = run.file
    for channel in geometry.channels:
        unit = run.reading_units.get(channel.name, VOLTAGE)
        if channel.name not in run.channel_names or unit == channel.reading_unit:
            continue
        fault = f"channel `{channel.name}` is in {unit}, but the geometry declares it in {channel.reading_unit}"
        if (unit, channel.reading_unit) == (VOLTAGE, RATIO):
            remedy = f"Add the voltage of its bridge as `{EXCITATION}`, or state its unit (`mV/V`) in the attribute"
        else:
            remedy = "Correct the attribute, or `unit` of the channel in the geometry"
        yield UserError(fault, file, "channels, attribute unit", remedy)


def channels_of_free_unit(geometry: Geometry) -> tuple[str, ...]:
    """Channels whose unit files may state: the geometry does not, nor has it a sensitivity in V."""
    return tuple(
        channel.name for channel in geometry.channels if channel.unit is None and not channel.measures_mechanics
    )


def declare_reading_units(geometry: Geometry, stated: Iterable[Mapping[str, str]]) -> Geometry:
    """The geometry with the units that files state for channels whose unit it leaves open; the first one counts."""
    free = set(channels_of_free_unit(geometry))
    units: dict[str, str] = {}
    for of_file in stated:
        units |= {name: unit for name, unit in of_file.items() if name in free - set(units)}
    if not units:
        return geometry
    channels = tuple(
        channel.model_copy(update={"unit": units[channel.name]}) if channel.name in units else channel
        for channel in geometry.channels
    )
    return geometry.model_copy(update={"channels": channels})


def unit_attribute(run: Run) -> str | list[str]:
    """Units of the channels of a run as its file states them: one where all have the same, else one for each."""
    units = [run.reading_units.get(name, VOLTAGE) for name in run.channel_names]
    return units[0] if len(set(units)) == 1 else units


def _stated_units(layout: DatasetLayout) -> dict[str, str]:
    units = layout.units if len(layout.units) > 1 else layout.units * len(layout.names)
    return dict(zip(layout.names, units, strict=True))


def _unit_faults(layout: DatasetLayout) -> Iterator[UserError]:
    place = "channels, attribute unit"
    remedy = "It should be `V`, a ratio such as `mV/V`, or `count`: one for all channels, or one for each"
    if len(layout.units) not in (1, len(layout.names)):
        fault = f"{len(layout.units)} units for {len(layout.names)} channels" if layout.units else "its unit is missing"
        yield UserError(fault, place=place, remedy=remedy)
        return
    for unit in dict.fromkeys(layout.units):
        try:
            parse_unit(unit, *READING_UNITS)
        except UserError:
            yield UserError(f"its unit is {unit or 'missing'}", place=place, remedy=remedy)


def _scale_faults(contents: RunFileContents) -> Iterator[UserError]:
    """Yield readings of a dynamic run in parts of a volt, unless they are those of bridges with their excitation.

    The samples of such a run are volts: nothing in them tells a unit that is misstated from weak signals. The known
    weights of a static run do, and ratios are another quantity.
    """
    assert contents.channels is not None
    has_supply = contents.excitation is not None or contents.channel_excitation is not None
    if contents.attributes.get("kind") == "static" or has_supply:
        return
    units = _stated_units(contents.channels)
    scaled = [name for name in _volt_channels(contents.channels) if parse_unit(units[name], VOLTAGE).factor != 1.0]
    for name in scaled[:1]:
        fault = f"the unit of `{name}` is {units[name]}, in a run that is not static"
        remedy = "Write its samples in V; `balance import` converts units"
        yield UserError(fault, place="channels, attribute unit", remedy=remedy)


def _volt_channels(layout: DatasetLayout) -> list[str]:
    units = _stated_units(layout)
    return [name for name in layout.names if parse_unit(units[name], *READING_UNITS).dimension == VOLTAGE]


def _supplied_channels(contents: RunFileContents) -> list[str]:
    """Channels in V whose excitation the file has."""
    assert contents.channels is not None
    in_volts = _volt_channels(contents.channels)
    if contents.excitation is not None:
        return [name for name in in_volts if not contents.excitation.names or name in contents.excitation.names]
    values = dict(zip(contents.channels.names, _constant_excitations(contents), strict=True))
    return [name for name in in_volts if np.isfinite(values[name])]


def _constant_excitations(contents: RunFileContents) -> list[float]:
    """Voltage of the bridge of each channel; NaN where there is none."""
    assert contents.channels is not None
    values = as_list(contents.channel_excitation)
    count = len(contents.channels.names)
    return [float(value) for value in (values * count if len(values) == 1 else values)] or [np.nan] * count


def _measured_faults(layout: DatasetLayout, excitation: DatasetLayout) -> Iterator[UserError]:
    columns = excitation.shape[1] if len(excitation.shape) == 2 else 1
    if len(excitation.shape) not in (1, 2) or not excitation.is_real or not excitation.is_complete:
        fault = "is not a complete table of numbers"
        yield UserError(fault, place=EXCITATION, remedy="Give one column for all bridges, or one for each")
    elif excitation.shape[0] != layout.shape[0]:
        fault = f"{excitation.shape[0]} rows, but {layout.shape[0]} rows of channels"
        yield UserError(fault, place=EXCITATION, remedy="Both should have one row for each sample")
    elif len(excitation.names) != columns and (excitation.names or columns > 1):
        fault, remedy = f"{len(excitation.names)} names for {columns} columns", "Name the channel of each column"
        yield UserError(fault, place=f"{EXCITATION}, attribute names", remedy=remedy)
    elif excitation.units not in (("V",), ("mV",)):
        fault = f"its unit is {', '.join(excitation.units) or 'missing'}"
        yield UserError(fault, place=f"{EXCITATION}, attribute unit", remedy="It should be `V` or `mV`")
    else:
        for name in sorted(set(excitation.names) - set(_volt_channels(layout))):
            fault = f"`{name}` is no channel that is read in V"
            remedy = f"Channels in V are {', '.join(_volt_channels(layout)) or 'none'}"
            yield UserError(fault, place=f"{EXCITATION}, attribute names", remedy=remedy)


def _constant_faults(layout: DatasetLayout, contents: RunFileContents) -> Iterator[UserError]:
    values, place = as_list(contents.channel_excitation), f"channels, attribute {EXCITATION}"
    if len(values) not in (1, len(layout.names)):
        fault = f"{len(values)} values for {len(layout.names)} channels"
        yield UserError(fault, place=place, remedy="Give one for all bridges, or one for each channel")
    elif not all(isinstance(value, int | float) and (np.isnan(value) or 0.0 < value < np.inf) for value in values):
        remedy = "It should be a positive voltage in V, nan for a channel that is no bridge"
        yield UserError("is no voltage of a bridge", place=place, remedy=remedy)
