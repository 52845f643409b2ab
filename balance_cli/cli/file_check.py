"""Recognition of a file by its content, and everything that is wrong with it (for `balance check`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from balance_cli.campaign.recording.channel_health import channel_faults, live_channels
from balance_cli.campaign.recording.channel_range import full_range_faults
from balance_cli.campaign.recording.gaps import gap_summary
from balance_cli.campaign.recording.load_table import is_point_table, read_load_table, runs_of_table
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.run_file import geometry_mismatches, read_run
from balance_cli.campaign.recording.table_geometry import read_table_head
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.campaign.rig.geometry_file import geometry_digest, read_geometry
from balance_cli.io.artefacts import StoredArtefact, read_stored
from balance_cli.io.errors import UserError
from balance_cli.io.formats import (
    ARTEFACT_FORMATS,
    FRF_MAP_FORMAT,
    GEOMETRY_FORMAT,
    HALL_FORMAT,
    HISTORY_FORMAT,
    IMPORT_FORMAT,
    MATRIX_FORMAT,
    PLAN_FORMAT,
    RUN_FORMAT,
)
from balance_cli.io.result_view import plural
from balance_cli.io.sniff import describe_file, implied_format, require_file, sniff_format

LOADS_HEADER = "run,component,unit,harmonic,frequency_hz,cosine,sine,amplitude,phase_deg,sigma_cosine,sigma_sine,flag"

POINT_LOADS_HEADER = "run,line,"
"""How the tables begin that `balance apply` writes."""

MATRIX_FAMILY = MATRIX_FORMAT.partition("/")[0] + "/"

POINT_TABLE = "point table"
FORMATS_NOT_READ = {"balance-truth/1": "truth behind simulated runs"}
"""Formats that no command reads."""


@dataclass(frozen=True)
class FileFinding:
    """A file that was checked.

    `kind` is `geometry`, `run`, `loads`, `unknown` or a format; `about` describes the content in a line of text.
    `run_kind` is the kind of a run (`static`, `sweep`, ...), `has_pulses` whether it has 1/rev pulses,
    `sample_rate` [Hz] that of its samples, `has_points` whether forces act at points other than the hub. `run` and
    `geometry` are what the file holds, where it can be read.
    """

    kind: str
    about: str
    name: str = ""
    rig: str = ""
    digest: str = ""
    faults: tuple[UserError, ...] = ()
    run_kind: str = ""
    has_pulses: bool = False
    sample_rate: float | None = None
    has_points: bool = False
    run: Run | None = None
    geometry: Geometry | None = None

    @property
    def is_unreadable(self) -> bool:
        """Whether faults of the samples themselves keep a run out of comparisons with others."""
        return any(fault.place.startswith("channel ") for fault in self.faults)


def check_file(path: Path, geometry: Geometry | None) -> FileFinding:
    """Recognize a file and check it, against a geometry where one is given."""
    declared = sniff_format(path) or implied_format(path)
    readers: dict[str, Callable[[Path, Geometry | None], FileFinding]] = {
        GEOMETRY_FORMAT: _check_geometry_file,
        RUN_FORMAT: _check_run_file,
        **dict.fromkeys(ARTEFACT_FORMATS, _check_artefact_file),
        **dict.fromkeys((IMPORT_FORMAT, FRF_MAP_FORMAT), _check_map_file),
        HISTORY_FORMAT: _check_history_file,
        **dict.fromkeys((HALL_FORMAT, PLAN_FORMAT), _check_planning_file),
    }
    if declared in readers:
        return readers[declared](path, geometry)
    if declared in FORMATS_NOT_READ:
        return FileFinding(str(declared), FORMATS_NOT_READ[str(declared)])
    if declared is None and path.is_file() and path.suffix in (".yaml", ".yml"):
        return _check_geometry_file(path, geometry)
    if declared is None and _first_line(path).startswith(MATRIX_FAMILY):
        return _check_matrix_file(path, geometry)
    if declared is None and _first_line(path) == LOADS_HEADER:
        return FileFinding("loads", "table of harmonic loads")
    return _check_table(path, geometry) or FileFinding("unknown", "not recognized", faults=(_unrecognized_fault(path),))


def _check_table(path: Path, geometry: Geometry | None) -> FileFinding | None:
    """A table of load points, or of the loads that `balance apply` computed; None for anything else."""
    try:
        head = read_table_head(path) if is_point_table(path) else None
    except UserError:
        return None
    if _first_line(path).startswith(POINT_LOADS_HEADER):
        return FileFinding("point loads", "table of static loads made by `balance apply`")
    if head is None or not (head.channels or head.hub_loads or head.loads):
        return None
    faults: tuple[UserError, ...] = ()
    if geometry is not None:
        try:
            read_load_table(path, geometry)
        except UserError as error:
            faults = (error.with_location(file=str(path)),)
    loads = ", ".join((*head.hub_loads, *head.loads)) or "none"
    about = f"point table: {plural(head.rows, 'row')}, loads {loads}, channels {', '.join(head.channels) or 'none'}"
    about += f", columns {', '.join(head.labels)}" if head.labels else ""
    return FileFinding(POINT_TABLE, about, faults=faults)


def runs_of_point_table(path: Path, geometry: Geometry) -> tuple[Run, ...]:
    """The static runs of a table of load points; none of a table without loads."""
    head = read_table_head(path)
    return runs_of_table(read_load_table(path, geometry), geometry) if head.hub_loads or head.loads else ()


def _unrecognized_fault(path: Path) -> UserError:
    try:
        require_file(path)
    except UserError as error:
        return error
    remedy = "Known are geometries, run files and the results of the other commands"
    return UserError(f"is {describe_file(path)}", str(path), remedy=remedy)


def _check_geometry_file(path: Path, expected: Geometry | None) -> FileFinding:
    geometry, faults = read_geometry(path)
    if geometry is None:
        return FileFinding("geometry", "geometry", faults=faults)
    if not faults and not missing_mechanics(geometry):  # effects are looked up in a geometry that is sound
        faults = _effect_faults(geometry, path)
    about = f"geometry `{geometry.name}` of rig `{geometry.rig}`: {plural(len(geometry.cells), 'cell')}, "
    about += f"{plural(len(geometry.channels), 'channel')}, "
    only_calibrated = bool(missing_mechanics(geometry))
    about += "for calibration only" if only_calibrated else f"free in {' '.join(geometry.freedom)}"
    digest = geometry_digest(geometry)
    if expected is not None and digest != geometry_digest(expected):
        fault = f"differs from the geometry `{expected.name}` given with -g"
        faults += (UserError(fault, str(path), remedy="Give only one of the two"),)
    return FileFinding("geometry", about, geometry.name, geometry.rig, digest, faults, geometry=geometry)


def _effect_faults(geometry: Geometry, path: Path) -> tuple[UserError, ...]:
    from balance_cli.model.balance import check_effects

    try:
        check_effects(geometry, str(path))
    except UserError as error:
        return (error,)
    return ()


def _check_run_file(path: Path, geometry: Geometry | None) -> FileFinding:
    from balance_cli.signals.period_consistency import period_faults
    from balance_cli.signals.rotor.pulse_consistency import pulse_faults
    from balance_cli.signals.rotor.record_length import revolution_faults

    run, faults = read_run(path)
    if run is None:
        return FileFinding("run", "run file", faults=faults)
    if geometry is None:
        channels = channel_faults(run, dict.fromkeys(run.channel_names))
    else:
        channels = live_channels(run, geometry).left_out
        faults += (*geometry_mismatches(run, geometry), *full_range_faults(run, geometry))
    rotor = None if geometry is None else geometry.rotor
    of_pulses = tuple(pulse_faults(run, None if rotor is None else rotor.speed)) or tuple(revolution_faults(run))
    faults += (*of_pulses, *period_faults(run))
    remedy = "Commands leave it out where the other channels determine the loads"
    faults += tuple(UserError(text, str(path), f"channel {name}", remedy) for name, text in channels.items())
    faults += tuple(_gap_faults(run, path))
    return FileFinding(
        "run",
        _describe_run(run),
        run.name,
        run.rig,
        run.digest,
        faults,
        run.kind,
        run.pulse_times is not None,
        run.sample_rate,
        run.additions is not None and run.additions.load_points is not None,
        run,
    )


def _describe_run(run: Run) -> str:
    about = f"{run.kind} run `{run.name}` of rig `{run.rig}`: {len(run.channel_names)} channels, "
    if run.sample_rate is None:
        return about + f"{run.samples} load points, trim `{run.trim}`"
    about += f"{run.samples / run.sample_rate:.4g} s at {run.sample_rate:g} Hz, rotor at {run.rotor_speed:g} Hz"
    if run.excited:
        levels = ", ".join(
            f"{name} {level:g} {UNIT_OF.get(name, '')} rms" for name, level in zip(run.excited, run.level, strict=True)
        )
        about += f", {run.excitation} of {levels}"
    return about


def _gap_faults(run: Run, path: Path) -> Iterator[UserError]:
    """Yield what commands interpolate in a run: it is a fault of the record, though they can do without the samples."""
    for name, about in gap_summary(run).items():
        gaps = f"{plural(about['gaps'], 'gap')}, longest {about['longest']}"
        what = "not finite, held or dropped out" if "held" in about else "not finite"
        fault = f"{plural(about['samples'], 'sample')} {what}, in {gaps}"
        remedy = "Commands interpolate them, and sigma contains the error"
        if run.kind == "static":
            remedy = "Commands leave these load points out"
        place = f"channel {name}" if name in run.channel_names else f"loads, {name}"
        yield UserError(fault, str(path), place, remedy)


def _check_history_file(path: Path, geometry: Geometry | None) -> FileFinding:
    from balance_cli.reduction.stored_history import read_history

    try:
        (about,) = read_history(path).summary_lines()
    except UserError as error:
        return FileFinding(HISTORY_FORMAT, "history of hub loads", faults=(error,))
    return FileFinding(HISTORY_FORMAT, about[0].lower() + about[1:], path.name)


def _check_artefact_file(path: Path, geometry: Geometry | None) -> FileFinding:
    format = str(sniff_format(path))
    try:
        stored = read_stored(path)
        made_from = _stored_geometry(stored)
    except UserError as error:
        return FileFinding(format, "artefact", faults=(error.with_location(file=str(path)),))
    about = f"{format} made by `balance {stored.provenance.command}` at {stored.provenance.created}"
    about += f" from {len(stored.provenance.inputs)} inputs"
    faults: tuple[UserError, ...] = ()
    if geometry and made_from and geometry_digest(geometry) != geometry_digest(made_from):
        fault = f"was made from another geometry (`{made_from.name}`), not from `{geometry.name}` given with -g"
        faults = (UserError(fault, str(path), "geometry", "Make it again with this geometry"),)
    rig = made_from.rig if made_from else ""
    return FileFinding(format, about, path.name, rig, stored.digest, faults)


def _stored_geometry(stored: StoredArtefact) -> Geometry | None:
    text = stored.tree.get("geometry")
    return Geometry.model_validate_json(text) if isinstance(text, str) else None


def _check_map_file(path: Path, geometry: Geometry | None) -> FileFinding:
    from balance_cli.cli.map_check import check_map

    format = sniff_format(path) or implied_format(path) or IMPORT_FORMAT
    about, rig, faults = check_map(path, format, geometry)
    return FileFinding(format, about, rig=rig, faults=faults)


def _check_planning_file(path: Path, geometry: Geometry | None) -> FileFinding:
    from balance_cli.planning.stored_forecast import describe_plan_or_hall

    kind = str(sniff_format(path) or implied_format(path))
    try:
        return FileFinding(kind, describe_plan_or_hall(path))
    except UserError as error:
        return FileFinding(kind, "plan" if kind == PLAN_FORMAT else "test hall", faults=(error,))


def _check_matrix_file(path: Path, geometry: Geometry | None) -> FileFinding:
    from balance_cli.calibration.matrix_file import read_matrix_file
    from balance_cli.steps.calibration_from_matrix import calibration_from_matrix

    try:
        calibration_matrix, digest = read_matrix_file(path)
        if geometry is not None:
            calibration_from_matrix(calibration_matrix, geometry)
    except UserError as error:
        return FileFinding(MATRIX_FORMAT, "calibration matrix", faults=(error.with_location(file=str(path)),))
    matrix = calibration_matrix.matrix
    about = f"calibration matrix of {len(matrix.channel_names)} channels for {', '.join(matrix.components)}"
    return FileFinding(MATRIX_FORMAT, about, path.name, matrix.rig, digest)


def _first_line(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return file.readline(1000).decode("utf-8", "replace").strip()
