"""Errors on a check run: reduced against applied loads, beside what the record's noise alone would leave."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.components import COMPONENTS
from balance_cli.estimation.hub_loads import SolvedLoads
from balance_cli.geometry import Geometry
from balance_cli.hub_loads import CheckErrors, RunLoads
from balance_cli.model.plate import hub_arm
from balance_cli.signals.anti_alias import anti_alias
from balance_cli.signals.harmonics import Harmonics

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

HARMONICS_COMPARED = 8


def check_errors(spectra: Harmonics, dynamic: SolvedLoads, reduced: RunLoads, geometry: Geometry) -> CheckErrors:
    """Compare over harmonics 1 to 8, complex amplitudes (contract, `load_error` and `interaction`).

    A component was applied where its column of the loads is not all zeros.
    """
    H = anti_alias(geometry.acquisition, spectra.frequency_hz)
    mine = spectra.columns(reduced.components)
    applied = spectra.amplitude[:, mine] / H[:, None]
    variance = np.real(np.diagonal(spectra.covariance, axis1=1, axis2=2))[:, mine] / np.abs(H[:, None]) ** 2
    was_applied = np.any(spectra.amplitude[:, mine] != 0, axis=0)
    last = min(HARMONICS_COMPARED, len(spectra.frequency_hz) - 1)
    error = _rms(reduced.amplitude[1 : last + 1] - applied[1 : last + 1])
    noise = _noise(dynamic, variance[1:])[:last]
    size = np.where(was_applied, _rms(applied[1 : last + 1]), _largest_force(applied[1 : last + 1], reduced, geometry))
    relative, of_noise = error / size, np.sqrt(np.mean(noise, axis=0)) / size
    return CheckErrors(
        load_error=_named(reduced.components, relative, was_applied),
        interaction=_named(reduced.components, relative, ~was_applied),
        load_noise=_named(reduced.components, of_noise, was_applied),
        interaction_noise=_named(reduced.components, of_noise, ~was_applied),
        applied=applied,
    )


def _rms(values: ComplexArray) -> Array:
    return np.asarray(np.sqrt(np.mean(np.abs(values) ** 2, axis=0)))


def _noise(dynamic: SolvedLoads, applied_variance: Array) -> Array:
    """Expected |reduced - applied|^2 (n, m) from noise of the channels and of the applied loads' own reading."""
    m = dynamic.loads.shape[1]
    variance = np.diagonal(dynamic.noise_covariance, axis1=1, axis2=2)
    return np.asarray(variance[:, :m] + variance[:, m:] + applied_variance)


def _largest_force(applied: ComplexArray, reduced: RunLoads, geometry: Geometry) -> Array:
    """What interactions are compared with: the largest applied force; for moments times the height of the hub.

    Where moments alone were applied, the largest of them over that height stands for the force.
    """
    arm = hub_arm(geometry.hub)
    moment = np.array([COMPONENTS.index(name) >= 3 for name in reduced.components])
    sizes = _rms(applied)
    forces = sizes[~moment]
    force = max(forces.max(initial=0.0), 0.0) or (sizes[moment] / arm).max(initial=0.0) or np.nan
    return np.asarray(np.where(moment, arm * force, force), float)


def _named(components: tuple[str, ...], values: Array, keep: NDArray[np.bool_]) -> dict[str, float]:
    return {name: float(value) for name, value, k in zip(components, values, keep, strict=True) if k}
