"""Results as files, with their provenance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from balance_cli.api.inputs import PathLike
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_digest
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io import artefacts
from balance_cli.io.formats import (
    CALIBRATION_FORMAT,
    DIAGNOSIS_FORMAT,
    LOADS_FORMAT,
    MODEL_FORMAT,
    SPECTRA_FORMAT,
    TRANSFER_FORMAT,
)
from balance_cli.reduction.result import HubLoads
from balance_cli.reduction.spectra_result import LoadSpectra
from balance_cli.signals.response.transfer import Transfer

Result = Calibration | Transfer | IdentifiedModel | Diagnosis | HubLoads | LoadSpectra

ARTEFACT_TYPES: Mapping[str, type[Any]] = {
    CALIBRATION_FORMAT: Calibration,
    TRANSFER_FORMAT: Transfer,
    MODEL_FORMAT: IdentifiedModel,
    DIAGNOSIS_FORMAT: Diagnosis,
    LOADS_FORMAT: HubLoads,
    SPECTRA_FORMAT: LoadSpectra,
}
COMMANDS = {
    Calibration: "calibrate",
    Transfer: "sweep-tf",
    IdentifiedModel: "identify",
    Diagnosis: "diagnose",
    HubLoads: "reduce",
    LoadSpectra: "reduce",
}
"""The command that makes a result of each type, for its provenance."""


def load_artefact(path: PathLike) -> Any:
    """Load a result that a command or `save_artefact` has written; its type follows from the format of the file.

    Raises UserError where the file is not an artefact, damaged, or changed since it was written.

    >>> import balance_cli as bal
    >>> import tempfile, pathlib
    >>> folder = tempfile.TemporaryDirectory()
    >>> file = pathlib.Path(folder.name) / "calibration.h5"
    >>> run, geometry = bal.read_run("sample_data/static-bare.h5"), bal.read_geometry("configs/rts-6.yaml")
    >>> digest = bal.save_artefact(file, bal.calibrate(run, geometry), inputs=[geometry, run])
    >>> bal.load_artefact(file)
    Calibration of RTS-6: 1 trim
      bare: 121 rows, condition 7.4, largest residual 0.0326 % FS (Mx)
    >>> folder.cleanup()
    """
    return artefacts.load_artefact(Path(path), ARTEFACT_TYPES).content


def save_artefact(
    path: PathLike,
    result: Result,
    *,
    inputs: Iterable[Run | Geometry] = (),
    options: Mapping[str, Any] | None = None,
) -> str:
    """Write a result as an artefact that every command reads; returns its digest.

    `inputs` (runs and geometry) and `options` that differ from their defaults are recorded. With those of the command
    the digest is that of the command. Raises UserError where the file cannot be written, TypeError for what is no
    result.
    """
    entries = tuple(_input_entry(item) for item in inputs)
    format = next((name for name, type_ in ARTEFACT_TYPES.items() if isinstance(result, type_)), None)
    if format is None:
        raise TypeError(f"{type(result).__name__} is not a result that can be saved")
    provenance = artefacts.make_provenance(COMMANDS[type(result)], options or {}, entries)
    return artefacts.save_artefact(Path(path), format, result, provenance)


def _input_entry(item: Run | Geometry) -> artefacts.Input:
    if isinstance(item, Geometry):
        return artefacts.Input(item.name, "geometry", geometry_digest(item))
    return artefacts.Input(item.name, "run", item.digest)
