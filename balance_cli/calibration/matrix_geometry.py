"""The least geometry that a linear matrix needs: the hub loads and the channels that it names, with their units."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from balance_cli.calibration.ati_matrix import read_ati_matrix
from balance_cli.calibration.matrix_file import is_matrix_of_all_terms, is_xml, read_text_file
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.column_heads import split_unit
from balance_cli.io.errors import UserError
from balance_cli.io.formats import GEOMETRY_FORMAT
from balance_cli.io.table_text import TextTable, read_table
from balance_cli.io.units import NUMBER, RATIO, VOLTAGE, is_unit, parse_unit

REMEDY = "Give the balance with -g GEOMETRY"


def geometry_of_matrix(path: Path) -> Geometry:
    """The hub loads and channels of a linear matrix: plain CSV, or the XML of ATI, whose channels are G0, G1 and so on.

    Raises UserError where the file does not tell them.
    """
    if is_matrix_of_all_terms(path):
        raise UserError("a matrix with all terms needs a geometry", str(path), remedy=REMEDY)
    if is_xml(path):
        text, _ = read_text_file(path)
        matrix = read_ati_matrix(text.removeprefix("\ufeff"), str(path))
        return _geometry(path, COMPONENTS, {f"G{number}": VOLTAGE for number in range(matrix.T0.shape[1])})
    table = read_table(path)
    below = table.units or ("",) * len(table.header)
    heads = [(*split_unit(head), unit) for head, unit in zip(table.header, below, strict=True)][1:]
    columns = {name: unit or under for name, unit, under in heads}
    lines = {name: unit or "" for name, unit in (split_unit(cells[0]) for _, cells in table.rows)}
    channels = {**_channels(columns), **_channels(lines)}
    components = [name for name in COMPONENTS if name in columns or name in lines]
    _require(table, components, channels)
    return _geometry(path, components, channels)


def _channels(names: dict[str, str]) -> dict[str, str]:
    """Base unit of each name whose unit is one of readings."""
    dimensions = {name: parse_unit(unit).dimension for name, unit in names.items() if unit and is_unit(unit)}
    return {name: unit for name, unit in dimensions.items() if unit in (VOLTAGE, RATIO, NUMBER)}


def _require(table: TextTable, components: Sequence[str], channels: dict[str, str]) -> None:
    if not components or not channels:
        lacking = "loads Fx to Mz" if not components else "channels with their units, as `B1 [mV/V]`,"
        raise UserError(f"has no {lacking} in its first column or head", str(table.path), remedy=REMEDY)


def _geometry(path: Path, components: Sequence[str], channels: dict[str, str]) -> Geometry:
    return Geometry.model_validate(
        {
            "format": GEOMETRY_FORMAT,
            "name": path.stem,
            "rig": path.stem,
            "channels": [{"name": name, "unit": unit} for name, unit in channels.items()],
            "components": list(components),
        }
    )
