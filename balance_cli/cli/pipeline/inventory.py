"""What a campaign folder holds: its geometry, its runs by kind, and the files that are left out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from balance_cli.campaign.rig.components import RUN_KINDS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_digest, load_geometry
from balance_cli.cli.file_check import FileFinding, check_file
from balance_cli.cli.pipeline.state import FileStamp, State
from balance_cli.io.errors import UserError
from balance_cli.io.formats import GEOMETRY_FORMAT, RUN_FORMAT
from balance_cli.io.sniff import sniff_format

GEOMETRY_NAMES = ("geometry.yaml", "geometry.yml")
RUN_SUFFIXES = (".h5", ".hdf5")


@dataclass(frozen=True)
class RunFile:
    """A run file that can be used: path, name of the run, content digest, whether it has 1/rev pulses, rate [Hz].

    `has_points`: forces at points other than the hub.
    """

    path: Path
    name: str
    digest: str
    has_pulses: bool = True
    sample_rate: float | None = None
    has_points: bool = False


@dataclass(frozen=True)
class Inventory:
    """The geometry and the runs {kind: files} of a campaign, and the files that are left out {path: reason}.

    `given` {role: (path, digest)}: a `model` and a `calibration` that were made before, as artefacts.
    `channel_faults` {path: faults}: channels that the commands leave out of runs that are used.
    """

    geometry_path: Path
    geometry: Geometry
    geometry_digest: str
    runs: Mapping[str, tuple[RunFile, ...]]
    left_out: Mapping[Path, str] = field(default_factory=dict)
    channel_faults: Mapping[Path, tuple[str, ...]] = field(default_factory=dict)
    given: Mapping[str, tuple[Path, str]] = field(default_factory=dict)

    def of_kind(self, *kinds: str) -> tuple[RunFile, ...]:
        """Return the runs of these kinds."""
        return tuple(run for kind in kinds for run in self.runs.get(kind, ()))

    @property
    def digests(self) -> dict[Path, str]:
        """The content digest of each input."""
        runs = {run.path: run.digest for run in self.of_kind(*RUN_KINDS)}
        return {self.geometry_path: self.geometry_digest} | runs | dict(self.given.values())

    def given_path(self, role: str) -> Path | None:
        """Return the artefact of this role that was given, if any."""
        return self.given[role][0] if role in self.given else None


def find_geometry(folder: Path) -> Path:
    """Return the geometry file of a campaign folder: geometry.yaml, geometry.yml, or the only file with a geometry.

    Raises UserError where there is none, or more than one.
    """
    texts = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".yaml", ".yml"))
    named = [path for path in texts if path.name.lower() in GEOMETRY_NAMES and path.is_file()]
    candidates = named or [path for path in texts if path.is_file() and sniff_format(path) == GEOMETRY_FORMAT]
    if len(candidates) > 1:
        names = ", ".join(path.name for path in candidates)
        raise UserError(f"holds more than one geometry: {names}", str(folder), remedy="Choose one with -g GEOMETRY")
    if not candidates:
        remedy = f"Put {GEOMETRY_NAMES[0]} beside the runs, or give it with -g GEOMETRY"
        raise UserError("holds no geometry", str(folder), remedy=remedy)
    return candidates[0]


def take_inventory(folder: Path, geometry_path: Path | None, state: State) -> Inventory:
    """Return what a campaign folder holds; files that did not change since `state` was written are not read again.

    Raises UserError where there is no geometry, it has a fault, or no run file is there or can be used.
    """
    if not folder.is_dir():
        raise UserError("is not a folder", str(folder), remedy="Give the folder with the run files of a campaign")
    geometry_path = geometry_path or find_geometry(folder)
    geometry = load_geometry(geometry_path)
    _check_effects(geometry, geometry_path)
    digest = geometry_digest(geometry)
    files = run_files(folder)
    findings = {path: _finding(path, geometry, digest, state) for path in files}
    if not findings:
        fault = "holds no run file (*.h5), and no folder in it does"
        raise UserError(fault, str(folder), remedy="Give the folder with the run files; `balance import` makes them")
    inventory = _sort_findings(Inventory(geometry_path, geometry, digest, {}), findings)
    if not inventory.of_kind(*RUN_KINDS):
        path, reason = next(iter(inventory.left_out.items()))
        raise UserError(
            f"none of its {len(findings)} run files can be used", str(folder), remedy=f"First: {path}: {reason}"
        )
    return inventory


def run_files(folder: Path) -> list[Path]:
    """Return the run files of a campaign folder; where it has none itself, those of the folders in it."""
    own = _run_files_among(folder.iterdir())
    return own or _run_files_among(path for inner in folder.iterdir() if inner.is_dir() for path in inner.iterdir())


def _run_files_among(paths: Iterable[Path]) -> list[Path]:
    """Return those that have the suffix of a run file and are no file of another format."""
    files = sorted(path for path in paths if path.suffix.lower() in RUN_SUFFIXES and path.is_file())
    return [path for path in files if sniff_format(path) in (None, RUN_FORMAT)]


def _check_effects(geometry: Geometry, path: Path) -> None:
    from balance_cli.model.balance import check_effects

    check_effects(geometry, str(path))


def _finding(path: Path, geometry: Geometry, digest: str, state: State) -> FileFinding:
    """Return what a file is, from the state where it was examined against this geometry and did not change."""
    stamp = FileStamp.of(path)
    known = state.findings.get(str(path))
    if known is not None and known.stamp == stamp and known.geometry == digest:
        return known.finding
    finding = check_file(path, geometry)
    state.remember_finding(path, stamp, digest, finding)
    return finding


def _sort_findings(inventory: Inventory, findings: Mapping[Path, FileFinding]) -> Inventory:
    runs: dict[str, tuple[RunFile, ...]] = dict.fromkeys(RUN_KINDS, ())
    left_out: dict[Path, str] = {}
    channels: dict[Path, tuple[str, ...]] = {}
    names: dict[str, Path] = {}
    for path, finding in findings.items():
        blocking = [fault for fault in finding.faults if not fault.place.startswith("channel ")]
        if blocking or not finding.run_kind:
            left_out[path] = _reason(blocking, finding)
        elif finding.name in names:
            left_out[path] = f"has the same run name as {names[finding.name].name}, `{finding.name}`"
        else:
            names[finding.name] = path
            facts = (finding.digest, finding.has_pulses, finding.sample_rate, finding.has_points)
            run = RunFile(path, finding.name, *facts)
            runs[finding.run_kind] = (*runs[finding.run_kind], run)
            if finding.faults:
                channels[path] = tuple(f"{fault.place}: {fault.fault}" for fault in finding.faults)
    return Inventory(inventory.geometry_path, inventory.geometry, inventory.geometry_digest, runs, left_out, channels)


def _reason(blocking: list[UserError], finding: FileFinding) -> str:
    if not blocking:
        return finding.about
    first = blocking[0]
    return f"{first.place}: {first.fault}" if first.place else first.fault
