"""Artefacts: results of the steps as HDF5, with provenance and a digest of their content.

An artefact holds one frozen dataclass in the group `content` (see `balance_cli.io.hdf5_tree`).
Root attributes: `format`, `digest`, `command`, `options` (JSON), `inputs` (JSON), `versions` (JSON), `created`
(ISO 8601).
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py

from balance_cli.io.atomic import atomic_write
from balance_cli.io.errors import UserError
from balance_cli.io.formats import ARTEFACT_FORMATS
from balance_cli.io.hdf5_links import refuse_other_files
from balance_cli.io.hdf5_output import Hdf5Output
from balance_cli.io.hdf5_tree import Tree, from_tree, read_tree, to_tree, tree_digest, write_tree
from balance_cli.io.reader_process import read_in_child
from balance_cli.io.sniff import attribute_text, describe_file, is_hdf5, require_file, sniff_format
from balance_cli.io.text_output import storable_text
from balance_cli.io.version import __version__

ROOT_ATTRIBUTES = ("format", "digest", "command", "options", "inputs", "versions", "created")
PACKAGES = ("numpy", "scipy", "h5py", "pandas", "pydantic")


@dataclass(frozen=True)
class Input:
    """One input of a result: its name, its role, and the digest of its content."""

    name: str
    role: str
    digest: str


@dataclass(frozen=True)
class Provenance:
    """How a result was made; `options` are the non-default ones, as JSON values."""

    command: str
    options: Mapping[str, Any]
    inputs: tuple[Input, ...]
    versions: Mapping[str, str]
    created: str


@dataclass(frozen=True)
class Artefact:
    """An artefact as read: `content` is a dataclass of the type that belongs to `format`."""

    format: str
    content: Any
    provenance: Provenance
    digest: str


@dataclass(frozen=True)
class StoredArtefact:
    """An artefact as stored, of any type: the tree of its content, and the digest stated in the file."""

    format: str
    tree: Tree
    provenance: Provenance
    digest: str


def make_provenance(command: str, options: Mapping[str, Any], inputs: tuple[Input, ...]) -> Provenance:
    """The provenance of a result made now, by this installation."""
    plain_options = json.loads(json.dumps(dict(options), default=str))
    versions = {"balance-cli": __version__, "python": platform.python_version()}
    versions |= {package: version(package) for package in PACKAGES}
    return Provenance(command, plain_options, inputs, versions, datetime.now(UTC).isoformat(timespec="seconds"))


def content_digest(format: str, content: Any, provenance: Provenance) -> str:
    """Hex SHA-256 of schema, data, options and input digests, without command, names, paths, versions and time."""
    return _artefact_digest(format, to_tree(content), provenance)


def _artefact_digest(format: str, tree: Tree, provenance: Provenance) -> str:
    inputs = sorted((item.role, item.digest) for item in provenance.inputs)
    parts = (format, tree_digest(tree), json.dumps(provenance.options, sort_keys=True), json.dumps(inputs))
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def save_artefact(path: Path, format: str, content: Any, provenance: Provenance) -> str:
    """Write an artefact, whole or not at all, and return its digest.

    Raises UserError where the file cannot be written, TypeError where the content has a type that
    cannot be stored.
    """
    if format not in ARTEFACT_FORMATS:
        raise ValueError(f"unknown format {format}")
    tree = to_tree(content)
    digest = _artefact_digest(format, tree, provenance)
    with atomic_write(Path(path)) as part, Hdf5Output(part) as output:
        for name, text in _root_attributes(format, digest, provenance).items():
            output.file.attrs[name] = storable_text(text)
        write_tree(output.file.create_group("content", track_order=True), tree)
    return digest


def _root_attributes(format: str, digest: str, provenance: Provenance) -> dict[str, str]:
    return {
        "format": format,
        "digest": digest,
        "command": provenance.command,
        "options": json.dumps(provenance.options, ensure_ascii=False),
        "inputs": json.dumps([asdict(item) for item in provenance.inputs], ensure_ascii=False),
        "versions": json.dumps(dict(provenance.versions)),
        "created": provenance.created,
    }


def _other_file(path: Path) -> str:
    """Return the remedy for a file that is not an artefact: tables of loads are results for other programs."""
    return "Give the result as .h5, not its table" if path.suffix.lower() == ".csv" else "Give another file"


def load_artefact(path: Path, types: Mapping[str, type[Any]]) -> Artefact:
    """Read an artefact of one of the formats in `types` (format -> dataclass).

    Raises UserError where the file is something else, damaged, or changed since it was written.
    """
    path = Path(path)
    require_file(path)
    expected = " or ".join(f"`{format}`" for format in types)
    if sniff_format(path) not in types or not is_hdf5(path):
        raise UserError(f"is {describe_file(path)}, where {expected} was expected", str(path), remedy=_other_file(path))
    stored = read_stored(path)
    with _damage_as_user_error(path):
        content = from_tree(stored.tree, types[stored.format])
    return Artefact(stored.format, content, stored.provenance, stored.digest)


@read_in_child
def read_stored(path: Path) -> StoredArtefact:
    """Read an artefact without knowing its type, and check its digest.

    Raises UserError as `load_artefact` does.
    """
    with _damage_as_user_error(path), h5py.File(path, "r") as file:
        attributes = {name: attribute_text(str(value)) or "" for name, value in file.attrs.items()}
        provenance = _read_provenance(attributes)
        try:
            refuse_other_files(file, "content")
        except UserError as error:
            raise error.with_location(file=str(path)) from error
        stored = StoredArtefact(attributes["format"], read_tree(file["content"]), provenance, attributes["digest"])
        computed = _artefact_digest(stored.format, stored.tree, provenance)
    if computed != stored.digest:
        fault = "its content does not match its digest: it was changed after it was written"
        raise UserError(fault, str(path), "digest", f"Create it again with `balance {provenance.command}`")
    return stored


def _read_provenance(attributes: Mapping[str, str]) -> Provenance:
    """The provenance in the root attributes. Raises LookupError, ValueError or TypeError where it is damaged."""
    missing = [name for name in ROOT_ATTRIBUTES if name not in attributes]
    if missing:
        raise ValueError(f"`{attributes.get('format')}` needs the attribute `{missing[0]}`, which is missing")
    options, inputs, versions = (json.loads(attributes[name]) for name in ("options", "inputs", "versions"))
    if not (isinstance(options, dict) and isinstance(versions, dict) and isinstance(inputs, list)):
        raise ValueError("the attributes `options` and `versions` are not tables, or `inputs` is not a list")
    entries = tuple(Input(**item) for item in inputs)
    texts = [*versions.values(), *(text for entry in entries for text in (entry.name, entry.role, entry.digest))]
    if not all(isinstance(text, str) for text in texts):
        raise ValueError("an entry of the attributes `inputs` and `versions` is not text")
    return Provenance(attributes["command"], options, entries, versions, attributes["created"])


@contextmanager
def _damage_as_user_error(path: Path) -> Iterator[None]:
    """Turn any exception from reading a damaged file into a UserError."""
    try:
        yield
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        fault = f"does not match its format: {reason}"
        raise UserError(fault, str(path), remedy="It is damaged; create it again") from error
