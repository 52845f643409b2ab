"""Columns of a point table: which head means which load, channel or label, and the unit beside the name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.io.column_heads import split_unit
from balance_cli.io.errors import UserError
from balance_cli.io.table_text import TextTable
from balance_cli.io.units import ANGLE, FORCE, MASS, MOMENT, NUMBER, Unit, can_be_unit_of, is_unit, parse_unit

LABELS = {
    "series": ("series", "seriesno", "loadseries", "loadingsequence", "sequence", "reihe", "serie"),
    "point": ("point", "kind", "pointkind", "type"),
    "run": ("run", "runname"),
    "trim": ("trim",),
    "excitation": (
        *("excitation", "bridgeexcitation", "excitationvoltage", "exc", "vexc", "uexc", "vex", "supply"),
        *("supplyvoltage", "bridgesupply", "bridgevoltage", "speisespannung", "brueckenspannung", "alimentation"),
    ),
    "temperature": (
        *("temperature", "temp", "balancetemperature", "balancetemp", "gagetemperature", "tbal", "tbalance"),
        *("temperatur", "waagentemperatur"),
    ),
    "pitch": ("pitch", "pitchangle", "pitchattitude", "nickwinkel"),
    "roll": ("roll", "rollangle", "rollattitude", "rollwinkel"),
    "yaw": ("yaw", "yawangle", "yawattitude", "gierwinkel"),
}
"""Columns other than loads and channels, with the names under which they are understood."""
YAW = "yaw"
"""Label of the angle about the vertical."""
ATTITUDE = (*ANGLES, YAW)
"""Labels that name an angle only where their unit is one: there are moments of these names."""
LOAD_WORDS = frozenset(
    (
        *("force", "load", "moment", "torque", "applied", "component", "kraft", "last", "drehmoment", "komponente"),
        *("effort", "charge", "couple", "composante"),
        *("known", "true", "reference", "ref", "standard", "nominal", "bekannt", "referenz", "connu", "connue"),
    )
)
"""Words beside the name of a load (`Effort Fx`, `applied Mz`), in lower case; other words may mean something else."""
POINT_WORDS = {
    **dict.fromkeys(("zero", "unloaded", "tara", "null", "nullpunkt", "leer", "avide"), "tare"),
    **dict.fromkeys(("calibration", "loaded", "last", "belastung", "charge"), "load"),
    **dict.fromkeys(("repeated", "repetition", "wiederholung"), "repeat"),
    **dict.fromkeys(("checkload", "checkpoint", "kontrolle", "pruefpunkt", "verification"), "check"),
}
"""Other words for the kinds of points."""
STATISTIC_WORDS = ("std", "stdev", "stddev", "sd", "sigma", "rms", "noise", "min", "max", "unc", "uncertainty")
"""Words beside the name of a channel (`B1_std`, `sigma B1`) for what is no reading of it."""


@dataclass(frozen=True)
class Column:
    """A column of the table that is something known: its index, its name in the geometry, and its unit as text.

    `is_reading`: the column of a channel, also where a load has the same name.
    """

    index: int
    name: str
    unit: str | None
    is_reading: bool = False

    @property
    def is_angle(self) -> bool:
        """Whether the unit is one of angles, or is not stated."""
        try:
            return self.unit is None or parse_unit(self.unit, ANGLE).dimension == ANGLE
        except UserError:
            return False


def identify_columns(table: TextTable, names: Sequence[str], shared: Iterable[str]) -> list[Column | None]:
    """Each column of the table as one of the known names; None for any other.

    Words such as `Force` beside the name of a load count where no column has the name alone. Of a name that a load
    and a channel share (`shared`), the load is the column in a unit of force or moment or with such a word, and the
    column of the plain name is the reading: sensors of six components name their outputs by the loads.
    """
    both = frozenset(shared)
    columns = [_mark_reading(_identify(table, index, names), both) for index in range(len(table.header))]
    load_names = {column.name for column in columns if column is not None and not column.is_reading}
    rest = tuple(name for name in names if name not in load_names and name not in LABELS)
    return [
        _identify(table, index, rest, LOAD_WORDS) if column is None else column for index, column in enumerate(columns)
    ]


def identify_loads_and_readings(table: TextTable, loads: Sequence[str], channels: Sequence[str]) -> list[Column | None]:
    """Each column as a load, a reading of a channel or a label; None for any other."""
    names = tuple(dict.fromkeys((*loads, *channels, *LABELS)))
    own = set(channels).difference(loads)
    columns = identify_columns(table, names, set(channels).intersection(loads))
    return [
        replace(column, is_reading=True) if column is not None and column.name in own else column for column in columns
    ]


def by_name(table: TextTable, columns: Iterable[Column]) -> dict[str, Column]:
    """The columns by their names; raises UserError where two have the same."""
    named: dict[str, Column] = {}
    for column in columns:
        same = named.setdefault(column.name, column)
        if same is not column:
            fault = f"`{table.header[same.index]}` is `{column.name}` too"
            raise table.error(0, table.header[column.index], fault, "Rename one of the two columns")
    return named


def unused_columns(table: TextTable, columns: Sequence[Column | None]) -> tuple[str, ...]:
    """Heads of the columns that are nothing known, and how many columns have none."""
    unused = tuple(head for head, column in zip(table.header, columns, strict=True) if head and column is None)
    return (*unused, f"{table.unnamed} without a name in the head") if table.unnamed else unused


def _mark_reading(column: Column | None, shared: frozenset[str]) -> Column | None:
    """A column whose name alone does not tell load from reading, as a reading unless it states the unit of a load."""
    if column is None or column.name not in shared or _is_unit_of_load(column.unit):
        return column
    return replace(column, is_reading=True)


def _is_unit_of_load(text: str | None) -> bool:
    try:
        return bool(text and parse_unit(text, FORCE, MOMENT))
    except UserError:
        return False


def _identify(
    table: TextTable, index: int, names: Sequence[str], leave_out: frozenset[str] = frozenset()
) -> Column | None:
    row_unit = table.units[index] if index < len(table.units) else ""
    for name, unit in _readings_of_head(table.header[index]):
        words = re.split(r"([\s_.\-]+)", name) if leave_out else [name]
        known = _match_name("".join(word for word in words if word.lower() not in leave_out).strip(" _.-"), names)
        if known is not None:
            column = Column(index, known, unit if unit is not None else (row_unit or None))
            return column if known not in ATTITUDE or column.is_angle else None
    return None


def _readings_of_head(head: str) -> Iterator[tuple[str, str | None]]:
    """Name and unit of a head in the ways in which they are written: whole, `Fx [N]`, `Fx / N`, `Fx, N`, `Fx_N`."""
    name, unit = split_unit(head)
    # A unit in brackets is no part of the name, known or not; other brackets are.
    if unit is None or not _names_a_quantity(unit):
        yield head, None
    if unit is not None:
        yield name, unit
    for sign in (" / ", "/", ",", " in ", "_", " "):
        # The name may have such a sign itself (`X_strain_V`), and so may the unit (`Fx N m`).
        for name, separator, unit in dict.fromkeys((head.partition(sign), head.rpartition(sign))):
            if separator and is_unit(unit):
                yield name.strip(), unit.strip()


def _names_a_quantity(unit: str) -> bool:
    return is_unit(unit) or not unit


def is_statistic(name: str, others: Iterable[str]) -> bool:
    """Whether a column is a statistic of one of the others, such as the scatter of its readings: `B1_std` of `B1`."""
    plain, known = plain_name(name), {plain_name(other) for other in others}
    rest = [strip(word) for strip in (plain.removesuffix, plain.removeprefix) for word in STATISTIC_WORDS]
    return any(other != plain and other in known for other in rest)


def name_and_unit(table: TextTable, index: int) -> tuple[str, str | None]:
    """Name and unit of a column that is nothing known: of its head, or of the row of units."""
    row_unit = table.units[index] if index < len(table.units) else ""
    possible = [(name, unit) for name, unit in _readings_of_head(table.header[index]) if unit and is_unit(unit)]
    # `B2 mV/V` can be split before V too: the longest unit is meant.
    return max(possible, key=lambda pair: len(pair[1]), default=(table.header[index], row_unit or None))


def _match_name(name: str, names: Sequence[str]) -> str | None:
    """The known name: the same, else the only one with the same letters and digits in any case."""
    if name in names:
        return name
    plain = plain_name(name)
    labels = [label for label, words in LABELS.items() if label in names and plain in words]
    same = [known for known in names if plain_name(known) == plain and known not in LABELS] or labels
    return same[0] if plain and len(same) == 1 else None


def plain_name(text: str) -> str:
    """The letters and digits of a name, in lower case."""
    return re.sub(r"[^a-z0-9]", "", text.lower())


def unit_of_column(column: Column, head: str, given: Iterable[Unit], *dimensions: str) -> Unit:
    """The unit of a column: that beside its name, behind the last underscore, or the `given` one of its quantity.

    `dimensions`: those that it may have, the likely one first. Raises UserError where it has none, or another.
    """
    if column.unit is not None:
        return parse_unit(column.unit, *dimensions)
    named = _unit_in_name(head, dimensions[0])
    unit = next((each for each in given if each.dimension in dimensions), named)
    if unit is None:
        symbol = "count" if dimensions[0] == NUMBER else dimensions[0]
        raise UserError("has no unit", remedy=f"Write `{column.name} [{symbol}]` in the head, or give `--units`")
    if named is not None and named.dimension == unit.dimension and named != unit:
        fault = f"its name ends with the unit {named.symbol}, where `--units` says {unit.symbol}"
        raise UserError(fault, remedy=f"Write the unit in brackets behind the name: `{column.name} [{unit.symbol}]`")
    return unit


def _unit_in_name(head: str, dimension: str) -> Unit | None:
    """The unit behind the last underscore, as in `Pull_lbf`; raises UserError for that of a mass in a load's name."""
    before, sign, last = head.strip().rpartition("_")
    if not sign or last.isdigit() or before.lower().endswith("_per"):
        return None
    known = (dimension, MASS) if dimension == FORCE else (dimension,)
    return parse_unit(last, dimension) if any(can_be_unit_of(last, each) for each in known) else None
