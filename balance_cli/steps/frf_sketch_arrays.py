"""Entries of a draft map of frequency responses that the names of columns and variables tell."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from balance_cli.campaign.recording.import_map_file import UNFINISHED
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.importers.frf.variables import Variables

PART_WORDS = {
    "magnitude": "magnitude|mag|modulus|amplitude|ampl|amp|abs|betrag",
    "phase": "phase|angle|arg|ph|winkel",
    "real": "real|re|realteil",
    "imaginary": "imaginary|imag|im|imagin\u00e4rteil|imaginaerteil",
    "coherence": "coherence|coh|koh\u00e4renz|kohaerenz",
}
"""Words, English and German, before or after the name of a response, by the key of the map whose array they name."""
COMPLETE = (("value",), ("real", "imaginary"), ("magnitude", "phase"))
"""Parts that are a complex number."""
FREQUENCY_NAMES = ("f", "freq", "frequency", "frequenz", "hz")
UNIT_LINES = (("dB", "magnitude_unit: dB"), ("rad", "phase_unit: rad"))
"""Units of parts of complex numbers that a map states, where they are not the usual ones."""
MOST_LISTED = 100
"""Names of one file that a draft lists."""


@dataclass(frozen=True)
class SketchedPair:
    """A response over a reference in the arrays `parts` {key of the map: name of the array} of the file `file`.

    `channel` and `component` are those of the rig, `unit` and `reference_unit` as the file states them; each may be
    empty.
    """

    file: str
    channel: str
    component: str
    parts: Mapping[str, str]
    unit: str
    reference_unit: str

    @property
    def entry(self) -> str:
        """The entry of the map."""
        arrays = ", ".join(f"{key}: {json.dumps(name)}" for key, name in self.parts.items())
        channel = json.dumps(self.channel) if self.channel else UNFINISHED
        named = f"response: {channel}, reference: {self.component or UNFINISHED}"
        return f"  - {{file: {json.dumps(self.file)}, {named}, {arrays}}}"


@dataclass(frozen=True)
class SketchedArrays:
    """What the names of the arrays of files tell about a map."""

    files: Sequence[Variables]
    channel_names: Sequence[str]

    @cached_property
    def pairs(self) -> tuple[SketchedPair, ...]:
        """The pairs of all files."""
        return tuple(pair for file in self.files for pair in _pairs_of_file(file, self.channel_names))

    def response_lines(self) -> Iterator[str]:
        """Yield the entries of `responses` for the channels that are named, and one to be completed."""
        units = {pair.channel: pair.unit or UNFINISHED for pair in reversed(self.pairs) if pair.channel}
        for name in (name for name in self.channel_names if name in units):
            yield f"  {json.dumps(name)}: {{name: {json.dumps(name)}, unit: {json.dumps(units[name])}}}"
        if not self.pairs or any(not pair.channel for pair in self.pairs):
            yield f"  {UNFINISHED}: {UNFINISHED}  # a name of yours: {{name: CHANNEL, unit: V}}"

    def reference_lines(self) -> Iterator[str]:
        """Yield the entries of `references` for the components that are named, and one to be completed."""
        units = {pair.component: pair.reference_unit or UNFINISHED for pair in reversed(self.pairs) if pair.component}
        for name in (name for name in COMPONENTS if name in units):
            yield f"  {name}: {{component: {name}, unit: {json.dumps(units[name])}}}"
        if not self.pairs or any(not pair.component for pair in self.pairs):
            yield f"  {UNFINISHED}: {UNFINISHED}  # a name of yours: {{component: Fz, unit: N}}"

    def body_lines(self) -> Iterator[str]:
        """Yield what the arrays are, and the entries that say which is which."""
        for file in self.files:
            yield from _listing(file, {name for pair in self.pairs for name in pair.parts.values()})
        names = (name for file in self.files for name in file.arrays)
        guess = next((name for name in names if re.split("[./]", name.lower())[-1] in FREQUENCY_NAMES), UNFINISHED)
        yield f"frequency: {json.dumps(guess)}"
        units = {unit for file in self.files for unit in file.units.values()}
        yield from (line for unit, line in UNIT_LINES if unit in units)
        several = [line for file in self.files for line in _array_entries(file)]
        yield from ("arrays:", *several) if several else ()
        single = [pair.entry for pair in self.pairs]
        if not single and not several:
            single = [SketchedPair(file.path.name, "", "", _TO_COMPLETE, "", "").entry for file in self.files]
        yield from ("pairs:", *single) if single else ()


_TO_COMPLETE = {"real": UNFINISHED, "imaginary": UNFINISHED}


def _pairs_of_file(file: Variables, channel_names: Sequence[str]) -> Iterator[SketchedPair]:
    """Yield the vectors of a file that are the parts of one response, in their order."""
    named: dict[str, dict[str, str]] = {}
    for name, array in file.arrays.items():
        if array.ndim == 1:
            base, part = (name, "value") if array.dtype.kind == "c" else _base_and_part(name)
            named.setdefault(base, {}).setdefault(part, name)
    for base, parts in named.items():
        keys = next((keys for keys in COMPLETE if all(key in parts for key in keys)), None)
        if keys is None:
            continue
        channel = _longest_within(channel_names, base) or _longest_within(channel_names, file.path.stem)
        rest = re.sub(_pattern(channel), " ", base) if channel else base
        component = _longest_within(COMPONENTS, rest) or _longest_within(COMPONENTS, file.path.stem)
        stated = file.units.get(parts[keys[0]], "")
        unit, _, reference_unit = stated.rpartition("/") if "/" in stated else ("", "", "")
        used = {key: parts[key] for key in (*keys, "coherence") if key in parts}
        yield SketchedPair(file.path.name, channel, component, used, unit.strip(" ()"), reference_unit.strip(" ()"))


def _base_and_part(name: str) -> tuple[str, str]:
    """Return a name without the word for a part of a complex number, and the key of that part; `` without one.

    A table of one response may have the words alone as names.
    """
    for part, words in PART_WORDS.items():
        if re.fullmatch(words, name, re.IGNORECASE):
            return "", part
        for pattern in (rf"(?:{words})[\s_.:([-]+(.+?)[\s)\]]*", rf"(.+?)[\s_.:([-]+(?:{words})[\s)\]]*"):
            found = re.fullmatch(pattern, name, re.IGNORECASE)
            if found:
                return found[1], part
    return name, ""


def _longest_within(names: Sequence[str], text: str) -> str:
    """Return the longest of the names that stands in a text between other signs than letters and digits, or ``."""
    return max((name for name in names if re.search(_pattern(name), text)), key=len, default="")


def _pattern(name: str) -> str:
    """Return a pattern of a name, in which another sign may stand for a point, as names of variables have none."""
    return rf"(?i)(?<![^\W_]){re.escape(name)}(?![^\W_])".replace(r"\.", "[._]")


def _listing(file: Variables, used: set[str]) -> Iterator[str]:
    """Yield the arrays of a file that no pair names, as comments."""
    left = [name for name in file.arrays if name not in used]
    yield f"# {file.path.name} ({file.format}){':' if left else ''}"
    for name in left[:MOST_LISTED]:
        array = file.arrays[name]
        kind = "complex" if array.dtype.kind == "c" else "real"
        shape = " x ".join(map(str, array.shape))
        yield f"#   {name}: {shape}, {kind} {file.units.get(name, '')}".rstrip()


def _array_entries(file: Variables) -> Iterator[str]:
    """Yield the entries of the complex arrays of a file that have several axes."""
    for name, array in file.arrays.items():
        if array.dtype.kind == "c" and array.ndim > 1:
            names = f"responses: [{UNFINISHED}], references: [{UNFINISHED}]"
            like = (other for other in file.arrays if _is_coherence(file, other, array.shape))
            names += next((f", coherence: {json.dumps(other)}" for other in like), "")
            yield f"  - {{file: {json.dumps(file.path.name)}, value: {json.dumps(name)}, {names}}}"


def _is_coherence(file: Variables, name: str, shape: tuple[int, ...]) -> bool:
    """Whether an array is named as a coherence, and has the shape of responses."""
    last = re.split("[./]", name)[-1]
    return file.arrays[name].shape == shape and bool(re.match(rf"(?i)({PART_WORDS['coherence']})", last))
