"""What `balance reduce` reads: the calibration, the response with its geometry, and the zero record."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.wind_off import ZeroRecord
    from balance_cli.signals.nyquist_noise import UsualNoise
    from balance_cli.signals.response.transfer import Transfer


def parse_frequencies(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[float, ...]:
    """Return the frequencies [Hz] of a list with commas. UserError where one is not a positive number."""
    frequencies = []
    for word in (value or "").split(",") if value is not None else ():
        try:
            frequency = float(word)
        except ValueError:
            frequency = math.nan
        if not (math.isfinite(frequency) and frequency > 0):
            raise UserError(f"`{word}` is not a frequency above 0 Hz", "--frequencies", remedy="Write F,F,... in Hz")
        frequencies.append(frequency)
    return tuple(frequencies)


def read_calibration(session: Session, path: Path | None, mean_loads: str | None = None) -> Calibration | None:
    """Read the static calibration, if one is given, with the method that computes `mean_loads` (None: its default)."""
    from balance_cli.calibration.load_method import choose_load_method
    from balance_cli.calibration.result import Calibration

    if path is None:
        if mean_loads is not None:
            raise UserError(
                "needs a static calibration", "--mean-loads", remedy="Add --calibration CAL, or leave it out"
            )
        return None
    calibration: Calibration = session.artefact(path, {"balance-calibration/1": Calibration}, "calibration").content
    return choose_load_method(calibration, mean_loads, "--mean-loads")


def read_response(
    session: Session, calibration: Calibration | None, model: Path | None, transfer: Path | None, interpolation: str
) -> tuple[Geometry, ResponseSource, tuple[UsualNoise, ...]]:
    """Return geometry, response and the noise of its sweeps; the response is a model, measured, or the static matrix.

    Raises UserError where its geometry is not that of the calibration, or they contradict each other at rest.
    """
    from balance_cli.cli.consistency import compare_static_response, repeat_findings
    from balance_cli.reduction.measured_response import transfer_source
    from balance_cli.reduction.response_sources import static_source
    from balance_cli.steps.reduction_inputs import require_same_geometry

    if model is not None:
        from balance_cli.estimation.identified_model import IdentifiedModel
        from balance_cli.reduction import model_sources

        identified: IdentifiedModel = session.artefact(model, {"balance-model/1": IdentifiedModel}, "model").content
        if calibration is not None:
            require_same_geometry(identified.geometry, calibration, str(model))
        repeat_findings(session, calibration, identified)
        source = model_sources.model_source(identified)
        compare_static_response(session, calibration, source, identified.geometry, model)
        return _geometry(identified.geometry, calibration), source, identified.usual_noise or ()
    if transfer is not None:
        from balance_cli.signals.response import transfer as results

        measured: Transfer = session.artefact(transfer, {"balance-transfer/1": results.Transfer}, "transfer").content
        if calibration is not None:
            require_same_geometry(measured.geometry, calibration, str(transfer))
        repeat_findings(session, calibration, measured)
        try:
            source = transfer_source(measured, interpolation)
        except UserError as error:
            raise error.with_location(file=str(transfer)) from error
        _report_sigma(session, measured)
        for channel, reason in source.channels_left_out.items():
            session.warn(f"{transfer}: channel {channel} left out of the harmonic loads: {reason}")
        compare_static_response(session, calibration, source, measured.geometry, transfer)
        return _geometry(measured.geometry, calibration), source, measured.usual_noise or ()
    assert calibration is not None
    repeat_findings(session, calibration)
    return calibration.geometry, static_source(calibration), ()


def _report_sigma(session: Session, measured: Transfer) -> None:
    """Say where sigma of imported responses comes from, on which that of the loads rests."""
    from balance_cli.signals.response.transfer import sigma_notes

    notes = sigma_notes(measured)
    if notes:
        session.extra_summary["response_notes"] = list(notes)
    for note in notes:
        session.echo(f"response: {note}")


def _geometry(declared: Geometry, calibration: Calibration | None) -> Geometry:
    """Return the geometry of the loads: that of the calibration, which an updated model extends by effects."""
    return declared if calibration is None else calibration.geometry


def read_zero(
    session: Session,
    calibration: Calibration | None,
    path: Path | None,
    zeros: tuple[Run, ...],
    record: Run,
) -> ZeroRecord | None:
    """Return the wind-off record: the one given, or the one among `zeros`; none without a calibration.

    A check or wind `record` shows the steps of the converter, and whether the zero was made under load.
    """
    from balance_cli.steps.reduction_inputs import compared_zero

    if calibration is None:
        return None
    if path is not None:
        zeros = tuple(session.runs([path], calibration.geometry, role="zero"))
    reference, loaded = compared_zero(zeros, calibration, record)
    if loaded:
        session.warn(loaded)
    return reference
