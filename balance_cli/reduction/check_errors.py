"""Errors of a check run: reduced against applied loads, with the noise floor of the record beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.plate import moment_reference_length
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import CheckErrors
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.weighted_least_squares import SolvedLoads
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.signals.distributions import student_widening

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
    record: RotorRecord,
    harmonic_solution: SolvedLoads,
    geometry: Geometry,
    source: ResponseSource,
    load_matrices: ComplexArray | None = None,
) -> CheckErrors:
    """Compare complex amplitudes of harmonics 1 to 8 (`load_error` and `interaction` in docs/json.md).

    A component was applied where its column of the loads is not all zeros. `load_matrices` (n+1, 6, 6) are the
    loads that act for each load that the exciters' force cells record, where a model knows them; the error is that
    against the loads that act.
    """
    spectra, components = record.spectra, record.components
    was_applied = np.any(spectra.amplitude[:, spectra.columns(components)] != 0, axis=0)
    rows = _load_rows(record, geometry, load_matrices)
    applied = np.einsum("hmi,hi->hm", rows, spectra.amplitude[:, spectra.columns(COMPONENTS)])
    last = min(HARMONICS_COMPARED, len(spectra.frequency_hz) - 1)
    error = _rms(harmonic_solution.loads[:last] - applied[1 : last + 1])
    variance = _difference_variance(record, harmonic_solution, geometry, source, rows[1:])
    size = np.where(
        was_applied, _rms(applied[1 : last + 1]), _largest_force(applied[1 : last + 1], components, geometry)
    )
    relative_error, noise_floor = error / size, np.sqrt(np.mean(variance[:last], axis=0)) / size
    beyond_reduced = variance - _reduced_variance(harmonic_solution)
    return CheckErrors(
        load_error=_by_component(components, relative_error, was_applied),
        interaction=_by_component(components, relative_error, ~was_applied),
        load_noise=_by_component(components, noise_floor, was_applied),
        interaction_noise=_by_component(components, noise_floor, ~was_applied),
        applied=applied,
        added_variance=np.concatenate([np.zeros_like(beyond_reduced[:1]), beyond_reduced]),
    )


def _load_rows(record: RotorRecord, geometry: Geometry, load_matrices: ComplexArray | None) -> ComplexArray:
    """Return the applied loads (n+1, m, 6) per recorded load, without the anti-alias filter."""
    matrices = np.eye(6) if load_matrices is None else load_matrices
    rows = matrices[..., [COMPONENTS.index(name) for name in record.components], :]
    H = anti_alias_response(geometry.acquisition, record.spectra.frequency_hz)
    return np.asarray(rows / H[:, None, None])


def _difference_variance(
    record: RotorRecord,
    harmonic_solution: SolvedLoads,
    geometry: Geometry,
    source: ResponseSource,
    load_rows: ComplexArray,
) -> Array:
    """Return the expected |reduced - applied|^2 (n, m) from the noise of the record.

    Reduced and applied loads are both sums of recorded signals. What these have in common, such as the turn by an
    error of the azimuth or loads that fluctuate, is in the covariance of the signals, and cancels.
    """
    spectra, live, m = record.spectra, record.health.live, len(record.components)
    G = harmonic_solution.equations.estimator
    rows = G.shape[2] // 2
    frequency = spectra.frequency_hz[1:]
    H = anti_alias_response(geometry.acquisition, frequency)[:, None, None]
    of_channels = (G[:, :m, :rows] + 1j * G[:, m:, :rows]) @ source.channel_combination(frequency, live).combination / H
    difference = np.concatenate([of_channels, -load_rows], axis=2)
    columns = spectra.columns((*live, *COMPONENTS))
    covariance = spectra.covariance[1:][:, columns][:, :, columns]
    variance = np.einsum("hmi,hij,hmj->hm", difference, covariance, difference.conj()).real
    return np.asarray(variance * student_widening(2.0 * spectra.dof[1:])[:, None])


def _rms(values: ComplexArray) -> Array:
    return np.asarray(np.sqrt(np.mean(np.abs(values) ** 2, axis=0)))


def _reduced_variance(harmonic_solution: SolvedLoads) -> Array:
    """Return the variance (n, m) of the reduced loads by the noise of the channels."""
    m = harmonic_solution.loads.shape[1]
    variance = np.diagonal(harmonic_solution.noise_covariance, axis1=1, axis2=2)
    return np.asarray(variance[:, :m] + variance[:, m:])


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
