"""Error of loads by the static matrix: what the dynamics of the declared rig would change in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.harmonic_loads import harmonic_loads
from balance_cli.reduction.response_sources import ResponseSource, StaticSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.weighted_least_squares import SolvedLoads


def add_dynamic_error(
    solution: SolvedLoads, record: RotorRecord, geometry: Geometry, source: ResponseSource
) -> SolvedLoads:
    """Return the loads by a static matrix with the error of leaving out the dynamics; other loads as they are.

    The error is estimated by the loads that the rig as declared gives for the same record: its standard deviation is
    their difference, and that of the declared rig by its tolerances. A rig without declared mechanics has no estimate.
    """
    if not isinstance(source, StaticSource):
        return solution
    # Identification takes half a second to import, which other responses do without.
    from balance_cli.estimation.measured_spectra import Spectra
    from balance_cli.reduction.model_sources import model_source
    from balance_cli.steps.identify import IdentifyOptions, identify

    try:
        declared = identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed"))
        reference = harmonic_loads(record, geometry, model_source(declared))
    except (UserError, np.linalg.LinAlgError):
        return solution
    square = np.tile(np.abs(solution.loads - reference.loads) ** 2, 2)
    error = square[:, :, None] * np.eye(square.shape[1]) + reference.covariance
    return replace(solution, model_covariance=solution.model_covariance + error)
