"""A draft of the map of frequency responses, from what files name."""

from __future__ import annotations

import json
from collections.abc import Sequence

from balance_cli.campaign.recording.import_map_file import UNFINISHED
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.importers.frf.functions import FrfFile, Terminal
from balance_cli.importers.frf.variables import Variables
from balance_cli.io.formats import FRF_MAP_FORMAT
from balance_cli.steps.frf_conventions import AXIS_OF
from balance_cli.steps.frf_sketch_arrays import SketchedArrays


def sketch_frf_map(sources: Sequence[FrfFile | Variables], geometry: Geometry | None) -> str:
    """Return a draft map of the functions of files, with a TODO for each entry that they do not tell."""
    lines = [f"format: {FRF_MAP_FORMAT}", f"rig: {UNFINISHED if geometry is None else geometry.rig}"]
    functions = [item for source in sources if isinstance(source, FrfFile) for item in source.functions]
    tables = [source for source in sources if isinstance(source, Variables)]
    arrays = SketchedArrays(tables, () if geometry is None else geometry.channel_names)
    for source in sources:
        lines += [f"# {source.path.name}: {note}" for note in (source.notes if isinstance(source, FrfFile) else ())]
    lines.append("responses:")
    responses = {item.response.name: item.response for item in functions}
    lines += [_response_line(terminal, geometry) for terminal in responses.values()]
    lines += arrays.response_lines() if arrays.files else ()
    lines.append("references:")
    references = {item.reference.name: item.reference for item in functions}
    lines += [_reference_line(terminal) for terminal in references.values()]
    lines += arrays.reference_lines() if arrays.files else ()
    lines += ["# a force beside the hub: {position: [0, 0, 0.1], direction: [0, 0, 1], unit: N}"]
    lines += arrays.body_lines() if arrays.files else ()
    lines += [
        "# averages: 20  # independent averages of the coherence",
        "# window: hann  # none, hamming, blackman, flattop",
    ]
    return "\n".join(lines) + "\n"


def _response_line(terminal: Terminal, geometry: Geometry | None) -> str:
    channels = () if geometry is None else geometry.channel_names
    channel = next((name for name in channels if name in terminal.names), UNFINISHED)
    unit = f", unit: {UNFINISHED}" if not terminal.unit and not terminal.quantity else ""
    comment = f"  # {terminal.quantity or 'of no stated quantity'}, {terminal.unit or 'without a unit'}"
    return f"  {json.dumps(terminal.name)}: {{name: {channel}{unit}}}{comment}"


def _reference_line(terminal: Terminal) -> str:
    component = next((name for name, axis in AXIS_OF.items() if terminal.direction[1:] == axis), UNFINISHED)
    unit = f", unit: {UNFINISHED}" if not terminal.unit and not terminal.quantity else ""
    sign = "  # along the negative axis" if terminal.direction.startswith("-") else ""
    return f"  {json.dumps(terminal.name)}: {{component: {component}{unit}}}{sign}"
