"""Matrix files of `balance calibrate`: calibrations from them, and their text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from balance_cli.cli.common import Session
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry


def read_matrix_calibration(session: Session, rig: Geometry, path: Path, hold_out: Sequence[Run]) -> Calibration:
    """Read a matrix of any known form as a calibration, checked by the static runs of `hold_out`."""
    from balance_cli.calibration.linear_matrix import LinearMatrix
    from balance_cli.calibration.matrix_file import read_any_matrix
    from balance_cli.steps.calibration_from_linear_matrix import calibration_from_linear_matrix
    from balance_cli.steps.calibration_from_matrix import calibration_from_matrix

    matrix, digest = read_any_matrix(path, rig)
    session.record_input(path.name, "matrix", digest)
    try:
        if isinstance(matrix, LinearMatrix):
            session.warn(
                "the matrix states neither noise nor zeros: sigma of loads is not known, and loads need a zero"
            )
            return calibration_from_linear_matrix(matrix, rig, hold_out)
        result = calibration_from_matrix(matrix, rig, hold_out)
    except UserError as error:
        raise error.with_location(file=str(path)) from error
    session.warn("the matrix states no errors of its coefficients: sigma of mean loads will not include them")
    return result


def matrix_file_text(result: Calibration, path: Path) -> str:
    """Format the matrix as the suffix of its file requires; raises UserError where there is no model of all trims."""
    from balance_cli.calibration.matrix import matrix_from_model
    from balance_cli.calibration.matrix_text import matrix_csv, matrix_text
    from balance_cli.campaign.rig.load_components import load_components

    if result.all_trims is None:
        fault = "there is no matrix: the trims have too few channels in common, or other loads were applied"
        raise UserError(fault, str(path), remedy="Repair the channels, apply the carried loads, or leave --matrix out")
    units = {channel.name: channel.reading_unit for channel in result.geometry.channels}
    readings = sorted({units[name] for name in result.all_trims.model.channel_names})
    if len(readings) > 1 or not load_components(result.geometry).are_hub_loads:
        what = f"channels in {' and '.join(readings)}" if len(readings) > 1 else "components of their own names"
        fault = f"such a matrix has channels in one unit and the loads Fx to Mz, but the calibration has {what}"
        raise UserError(fault, str(path), remedy="Write the linear part with --linear-matrix")
    matrix = matrix_from_model(result.all_trims.model, result.geometry.rig, readings[0])
    return matrix_csv(matrix) if path.suffix == ".csv" else matrix_text(matrix)


def linear_matrix_text(result: Calibration, path: Path) -> str:
    """Format T0, loads from readings, as plain CSV or in the XML of ATI: of several trims, that of their model.

    A model with curvature has another slope at zero load than the straight line through its range.
    """
    from balance_cli.calibration.linear_matrix import LinearMatrix, ati_xml, linear_csv
    from balance_cli.campaign.rig.components import COMPONENTS
    from balance_cli.campaign.rig.load_components import component_units

    trim = next(iter(result.trims.values()))
    T0, names = trim.T0, trim.channel_names
    if result.all_trims is not None and len(result.trims) > 1:
        model = result.all_trims.model
        T0, names = model.inverse() * model.calibrated_range[:, None], model.channel_names
    declared = {channel.name: channel.reading_unit for channel in result.geometry.channels}
    units = tuple(declared[name] for name in names)
    matrix = LinearMatrix(trim.components, names, units, T0, trim.full_scale, result.geometry.name)
    if path.suffix == ".csv":
        loads = component_units(result.geometry)
        return linear_csv(matrix, [loads[name] for name in trim.components])
    if trim.components != COMPONENTS or set(units) != {"V"}:
        fault = "a .cal file has the loads Fx to Mz, and channels in V"
        raise UserError(fault, str(path), remedy="Write the matrix as .csv")
    return ati_xml(matrix)
