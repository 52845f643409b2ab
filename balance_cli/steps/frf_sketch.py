"""A draft of the map of frequency responses, from what files name."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from balance_cli.campaign.recording.import_map_file import UNFINISHED
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.importers.frf.functions import FrfFile, Terminal
from balance_cli.importers.frf.variables import Variables
from balance_cli.io.formats import FRF_MAP_FORMAT
from balance_cli.steps.frf_conventions import AXIS_OF


def sketch_frf_map(sources: Sequence[FrfFile | Variables], geometry: Geometry | None) -> str:
    """Return a draft map of the functions of files, with a TODO for each entry that they do not tell."""
    lines = [f"format: {FRF_MAP_FORMAT}", f"rig: {UNFINISHED if geometry is None else geometry.rig}"]
    functions = [item for source in sources if isinstance(source, FrfFile) for item in source.functions]
    arrays = [source for source in sources if isinstance(source, Variables)]
    for source in sources:
        lines += [f"# {source.path.name}: {note}" for note in (source.notes if isinstance(source, FrfFile) else ())]
    lines.append("responses:")
    responses = {item.response.name: item.response for item in functions}
    lines += [_response_line(terminal, geometry) for terminal in responses.values()]
    if arrays:
        lines.append(f"  {UNFINISHED}: {UNFINISHED}  # a name of yours: {{name: CHANNEL, unit: V}}")
    lines.append("references:")
    references = {item.reference.name: item.reference for item in functions}
    lines += [_reference_line(terminal) for terminal in references.values()]
    if arrays:
        lines.append(f"  {UNFINISHED}: {UNFINISHED}  # a name of yours: {{component: Fz, unit: N}}")
    lines += ["# a force beside the hub: {position: [0, 0, 0.1], direction: [0, 0, 1], unit: N}"]
    for variables in arrays:
        lines += _array_lines(variables)
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


def _array_lines(variables: Variables) -> Iterator[str]:
    """Yield what the arrays of a file are, and the entries that say which is which."""
    yield f"# {variables.path.name} ({variables.format}):"
    for name, array in list(variables.arrays.items())[:100]:
        kind = "complex" if array.dtype.kind == "c" else "real"
        shape = " x ".join(map(str, array.shape))
        yield f"#   {name}: {shape}, {kind} {variables.units.get(name, '')}".rstrip()
    vectors = [name for name, array in variables.arrays.items() if array.ndim == 1 and array.dtype.kind != "c"]
    guess = next((name for name in vectors if name.lower() in ("f", "freq", "frequency", "hz")), UNFINISHED)
    yield f"frequency: {json.dumps(guess)}"
    complex_names = [name for name, array in variables.arrays.items() if array.dtype.kind == "c"]
    file = f"  - {{file: {json.dumps(variables.path.name)}"
    many = [name for name in complex_names if variables.arrays[name].ndim > 1]
    yield "arrays:" if many else "pairs:"
    for name in many:
        yield f"{file}, value: {json.dumps(name)}, responses: [{UNFINISHED}], references: [{UNFINISHED}]}}"
    if not many:
        one = [f"value: {json.dumps(name)}" for name in complex_names]
        for text in one or [f"real: {UNFINISHED}, imaginary: {UNFINISHED}"]:
            yield f"{file}, response: {UNFINISHED}, reference: {UNFINISHED}, {text}}}"
