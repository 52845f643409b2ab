"""Cross-checks of imported responses: against the geometry, as sweeps are checked, and against a static calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.diagnosis.consistency.campaign import findings_from_rows
from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
from balance_cli.diagnosis.consistency.severity import ConsequenceRule, findings_for_command, measured_anyway
from balance_cli.io.errors import UserError
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.signals.response.choices import INTERPOLATIONS
from balance_cli.signals.response.transfer import Transfer, response_components
from balance_cli.signals.response_rows import BAND_RATIO, ResponseRows
from balance_cli.signals.run_spectrum import FrequencyResponse
from balance_cli.steps.contradicted_loads import compare_static_response
from balance_cli.steps.measured_static_response import measured_static_response

REMEDY = "Correct the map (`sign`, `unit`, names), or the geometry"
NOT_COMPARED = "not compared with a static calibration, which alone shows a wrong sign or scale of a single channel"


def geometry_findings(transfer: Transfer) -> tuple[ConsistencyFinding, ...]:
    """Return the warnings about imported responses and their geometry: units, signs, axes, names, frequencies.

    Raises UserError for the first fault. A geometry without mechanics tells nothing.
    """
    if missing_mechanics(transfer.geometry):
        return ()
    findings = response_findings((transfer,), transfer.geometry, measured_anyway)
    for finding in findings:
        if finding.is_fault:
            raise UserError(finding.sentence, place="references" if finding.components else "responses", remedy=REMEDY)
    return findings


def response_findings(
    transfers: Sequence[Transfer], geometry: Geometry, is_harmless: ConsequenceRule
) -> tuple[ConsistencyFinding, ...]:
    """Return what the cross-checks of sweeps say of measured responses and a geometry with mechanics."""
    rows = [part for item in transfers for response in item.responses for part in _rows(response, geometry)]
    return findings_for_command(findings_from_rows(geometry, rows, {}), is_harmless)


def static_findings(
    transfer: Transfer, calibration: Calibration | None, file: str
) -> tuple[tuple[ConsistencyFinding, ...], str]:
    """Return the warnings about imported responses and a static calibration, and in words what was compared.

    At low frequency both say what the channels read for a load. Raises UserError, with the `file` of the calibration,
    where they differ by more than any effect explains.
    """
    if calibration is None:
        return (), f"{NOT_COMPARED}: give --calibration"
    lacking = [name for name in carried_components(transfer.geometry) if name not in response_components(transfer)]
    if lacking:
        return (), f"{NOT_COMPARED}: there is no response to {', '.join(lacking)}"
    source = transfer_source(transfer, INTERPOLATIONS[0])
    if measured_static_response(source, calibration.geometry) is None:
        lowest = max(float(response.frequency[0]) for response in transfer.responses)
        return (), f"{NOT_COMPARED}: the lines from {lowest:.4g} Hz on do not tell the response at rest"
    findings = compare_static_response(calibration, source, transfer.geometry, file)
    agreement = "they differ" if findings else "they agree"
    return findings, f"compared with the static calibration at low frequency: {agreement}"


def _rows(response: FrequencyResponse, geometry: Geometry) -> Iterator[ResponseRows]:
    """Yield the lines of a response as the cross-checks of sweeps take them, one of each narrow band."""
    band = np.round(np.log(response.frequency) / np.log(BAND_RATIO)).astype(np.intp)
    band, lines = np.unique(band, return_index=True)
    channels = [geometry.channel_names.index(name) for name in response.channel_names]
    for j, component in enumerate(response.components):
        variance = np.diagonal(response.channel_covariance[lines], axis1=1, axis2=2).real
        variance = variance * response.load_covariance[lines, j, j].real[:, None]
        values = np.full((len(lines), len(geometry.channel_names)), np.nan, complex)
        values[:, channels] = response.response[lines, :, j]
        noise = np.zeros(values.shape)
        noise[:, channels] = variance / np.maximum(np.abs(values[:, channels]) ** 2, np.finfo(np.float32).tiny)
        loads = np.zeros((len(lines), len(COMPONENTS)), complex)
        loads[:, COMPONENTS.index(component)] = 1.0
        yield ResponseRows(
            run=response.run,
            kind="sweep",
            rotor_speed=response.rotor_speed,
            excited=(component,),
            frequency=response.frequency[lines],
            channels=values,
            loads=loads,
            reference=np.full(len(lines), COMPONENTS.index(component), np.intp),
            band=band,
            noise_share=noise,
        )
