"""Errors of a check run: reduced against applied loads, with the noise floor of the record beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.plate import moment_reference_length
from balance_cli.reduction.result import CheckErrors
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

HARMONICS_COMPARED = 8
"""Harmonics 1 to 8, as `load_error` is defined in the file contract."""
SAME_PATTERN = 0.98
"""Correlation of what was found with what was expected at the harmonics, from which they differ by a factor only."""
FEWEST_HARMONICS = 3
"""Harmonics that have a pattern: a single one differs from any other by a factor only."""
SMALLEST_FACTOR, LARGEST_FACTOR = 0.5, 2.0
"""Range of factors between reduced and applied loads that a response may be wrong by; units and signs lie outside."""


def check_errors(
    spectra: Harmonics,
    harmonic_solution: SolvedLoads,
    components: tuple[str, ...],
    geometry: Geometry,
    load_matrices: ComplexArray | None = None,
) -> CheckErrors:
    """Compare complex amplitudes of harmonics 1 to 8 (`load_error` and `interaction` in docs/json.md).

    A component was applied where its column of the loads is not all zeros. `load_matrices` (n+1, 6, 6) are the
    loads that act for each load that the exciters' force cells record, where a model knows them; the error is that
    against the loads that act.
    """
    H = anti_alias_response(geometry.acquisition, spectra.frequency_hz)
    columns = spectra.columns(components)
    was_applied = np.any(spectra.amplitude[:, columns] != 0, axis=0)
    applied = spectra.amplitude[:, columns]
    variance = np.real(np.diagonal(spectra.covariance, axis1=1, axis2=2))[:, columns]
    if load_matrices is not None and np.any(load_matrices != np.eye(6)):
        applied, variance = _applied_loads(spectra, load_matrices, components)
    applied, variance = applied / H[:, None], variance / np.abs(H[:, None]) ** 2
    last = min(HARMONICS_COMPARED, len(spectra.frequency_hz) - 1)
    error = _rms(harmonic_solution.loads[:last] - applied[1 : last + 1])
    noise = _expected_square_error(harmonic_solution, variance[1:])[:last]
    size = np.where(
        was_applied, _rms(applied[1 : last + 1]), _largest_force(applied[1 : last + 1], components, geometry)
    )
    relative_error, noise_floor = error / size, np.sqrt(np.mean(noise, axis=0)) / size
    return CheckErrors(
        load_error=_by_component(components, relative_error, was_applied),
        interaction=_by_component(components, relative_error, ~was_applied),
        load_noise=_by_component(components, noise_floor, was_applied),
        interaction_noise=_by_component(components, noise_floor, ~was_applied),
        applied=applied,
    )


def _applied_loads(
    spectra: Harmonics, load_matrices: ComplexArray, components: tuple[str, ...]
) -> tuple[ComplexArray, Array]:
    """Return the loads (n+1, m) that act, and their variance, from those that the force cells measure."""
    columns = spectra.columns(COMPONENTS)
    rows = load_matrices[:, [COMPONENTS.index(name) for name in components]]
    covariance = spectra.covariance[:, columns][:, :, columns]
    applied = np.einsum("hmi,hi->hm", rows, spectra.amplitude[:, columns])
    return applied, np.real(np.einsum("hmi,hij,hmj->hm", rows, covariance, rows.conj()))


def _rms(values: ComplexArray) -> Array:
    return np.asarray(np.sqrt(np.mean(np.abs(values) ** 2, axis=0)))


def _expected_square_error(harmonic_solution: SolvedLoads, applied_variance: Array) -> Array:
    """Return the expected |reduced - applied|^2 (n, m) from the noise of the channels and of the measured loads."""
    m = harmonic_solution.loads.shape[1]
    variance = np.diagonal(harmonic_solution.noise_covariance, axis1=1, axis2=2)
    return np.asarray(variance[:, :m] + variance[:, m:] + applied_variance)


def _largest_force(applied: ComplexArray, components: tuple[str, ...], geometry: Geometry) -> Array:
    """Return the reference (m,) of interactions: the largest applied force, for moments times the height of the hub.

    Where only moments were applied, the reference force is the largest of them over that height.
    """
    arm = moment_reference_length(geometry.hub)
    moment = np.array([COMPONENTS.index(name) >= 3 for name in components])
    sizes = _rms(applied)
    forces = sizes[~moment]
    force = max(forces.max(initial=0.0), 0.0) or (sizes[moment] / arm).max(initial=0.0) or np.nan
    return np.asarray(np.where(moment, arm * force, force), float)


def _by_component(components: tuple[str, ...], values: Array, selected: NDArray[np.bool_]) -> dict[str, float]:
    return {name: float(value) for name, value, select in zip(components, values, selected, strict=True) if select}


def scale_contradiction(check: CheckErrors, loads: ComplexArray, components: tuple[str, ...]) -> str:
    """Return in words that reduced loads (n+1, m) and applied loads differ by a sign or a unit; empty where they agree.

    Only a component counts whose reduced harmonics have the pattern of the applied ones, so that a wrong response,
    which changes the pattern, is not taken for a wrong unit.
    """
    factors: dict[str, float] = {}
    if len(loads) <= FEWEST_HARMONICS:
        return ""
    for name in check.load_error:
        applied, reduced = (values[1:, components.index(name)] for values in (check.applied, loads))
        product, power = np.vdot(applied, reduced), float(np.vdot(applied, applied).real)
        pattern = abs(product) / np.sqrt(power * max(float(np.vdot(reduced, reduced).real), np.finfo(float).tiny))
        factor = float(product.real) / power
        if pattern > SAME_PATTERN and not SMALLEST_FACTOR < factor < LARGEST_FACTOR:
            factors[name] = factor
    text = ", ".join(f"{name} {factor:.4g}" for name, factor in factors.items())
    return (
        f"reduced loads over applied ones: {text}; check units and signs of `loads` and `channels`" if factors else ""
    )
