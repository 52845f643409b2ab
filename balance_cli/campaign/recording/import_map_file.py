"""Reading of a map, and the run that it makes of a file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from balance_cli.campaign.recording.import_map import ImportMap, MappedRun
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.io.formats import IMPORT_FORMAT
from balance_cli.io.sniff import describe_file, is_hdf5, require_file
from balance_cli.io.validation import dotted_place, validation_faults
from balance_cli.io.yaml_file import read_yaml

UNFINISHED = "TODO"
"""What a sketch has in place of what is to be completed."""
_WORD = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True)
class DeclaredRun:
    """A run that files make together, with the words of the pattern filled in; `place` is that of its entry.

    `mapping` has the channels and loads of the entry in place of those of the map.
    """

    name: str
    entry: MappedRun
    place: str
    files: tuple[Path, ...]
    mapping: ImportMap


def read_import_map(path: Path) -> ImportMap:
    """The map in a YAML file. Raises UserError for its first fault."""
    try:
        require_file(path)
        if not path.is_file() or is_hdf5(path):
            raise UserError(f"is {describe_file(path)}, where a map was expected", remedy="Give the YAML file of a map")
        declared = read_yaml(path, "a map")
        if not isinstance(declared, dict) or declared.get("format") != IMPORT_FORMAT:
            remedy = f"It should begin with `format: {IMPORT_FORMAT}`; `balance import --sketch FILE` prints one"
            raise UserError("is not a map of an import", place="format", remedy=remedy)
        refuse_unfinished(declared)
        return ImportMap.model_validate(declared)
    except ValidationError as error:
        raise validation_faults(ImportMap, error)[0].with_location(file=str(path)) from error
    except UserError as error:
        raise error.with_location(file=str(path)) from error


def refuse_unfinished(declared: object, place: tuple[int | str, ...] = ()) -> None:
    """Raise UserError where a sketch was not completed."""
    entries = (
        declared.items() if isinstance(declared, dict) else enumerate(declared) if isinstance(declared, list) else ()
    )
    for key, value in entries:
        if value == UNFINISHED:
            raise UserError(
                f"`{UNFINISHED}` is left of the sketch", place=dotted_place((*place, key)), remedy="Complete it"
            )
        refuse_unfinished(value, (*place, key))


def declared_runs(declared: ImportMap, files: tuple[Path, ...], map_file: str) -> tuple[DeclaredRun, ...]:
    """The runs of these files: the first entry whose pattern fits each; files of the same run name are one run.

    Raises UserError where no entry fits a file, or a filled-in text is not valid.
    """
    runs: dict[str, DeclaredRun] = {}
    for file in files:
        number, words = _matching_entry(declared, file, map_file)
        place = f"runs[{number}]"
        try:
            entry = _fill_in(declared.runs[number], words)
            mapping = declared.for_run(entry)
        except UserError as error:
            raise error.with_location(map_file, place) from error
        except ValueError as error:
            remedy = "Set those of the map that these files do not have to null in the entry"
            raise UserError(str(error), map_file, place, remedy) from error
        if entry.run in runs and runs[entry.run].place != place:
            fault = (
                f"gives {file.name} the run name `{entry.run}`, which another entry gives {runs[entry.run].files[0]}"
            )
            raise UserError(fault, map_file, place, "Give each run a name of its own")
        before = runs[entry.run].files if entry.run in runs else ()
        runs[entry.run] = DeclaredRun(entry.run, entry, place, (*before, file), mapping)
    return tuple(runs.values())


def _matching_entry(declared: ImportMap, file: Path, map_file: str) -> tuple[int, dict[str, str]]:
    for number, entry in enumerate(declared.runs):
        match = _pattern(entry.file).fullmatch(file.name)
        if match:
            return number, {
                **match.groupdict(),
                "stem": file.stem,
                "name": file.name,
                "folder": file.resolve().parent.name,
            }
    patterns = ", ".join(f"`{entry.file}`" for entry in declared.runs)
    raise UserError(f"no entry fits the file {file.name}", map_file, "runs", f"Add one; the patterns are {patterns}")


def _pattern(text: str) -> re.Pattern[str]:
    """`*` and `?` as in a shell; `{word}` fits any characters, which the word then stands for."""
    parts, field_names = [], set()
    for part in re.split(r"(\{\w+\}|\*|\?)", text):
        word = _WORD.fullmatch(part)
        if word and word[1].isidentifier():
            parts.append(f"(?P={word[1]})" if word[1] in field_names else f"(?P<{word[1]}>.+?)")
            field_names.add(word[1])
        else:
            parts.append({"*": ".*", "?": "."}.get(part, re.escape(part)))
    return re.compile("".join(parts), re.IGNORECASE)


def _fill_in(entry: MappedRun, words: dict[str, str]) -> MappedRun:
    """The entry with `{word}` replaced in its texts."""

    def fill(text: str | None) -> str | None:
        return None if text is None else _WORD.sub(lambda match: _word(match[1], words), text)

    excited = tuple(_component(fill(name) or "") for name in entry.excited)
    texts = {name: fill(getattr(entry, name)) for name in ("run", "trim", "excitation", "note", "recorded")}
    if "/" in str(texts["run"]) or "\\" in str(texts["run"]):
        raise UserError(f"the run name `{texts['run']}` has a slash", remedy="Correct `run`")
    return entry.model_copy(update={**texts, "excited": excited})


def _word(name: str, words: dict[str, str]) -> str:
    if name not in words:
        raise UserError(
            f"`{{{name}}}` is not in the pattern", remedy=f"Use {', '.join(f'{{{word}}}' for word in words)}"
        )
    return words[name]


def _component(name: str) -> str:
    """A component in the spelling of run files."""
    match = next((component for component in COMPONENTS if component.lower() == name.lower()), None)
    if match is None:
        raise UserError(f"`{name}` is no component", remedy=f"`excited` should be of {', '.join(COMPONENTS)}")
    return match
