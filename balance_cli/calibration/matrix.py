"""The calibration matrix in engineering units, and its conversion from and to the calibration model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.terms import Term, all_terms, linear_terms, term_values
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.io.units import VOLTAGE

Array = NDArray[np.float64]

MATRIX_SERIES = "as stated in the matrix"
"""Description of the one load series of a model that was read from a matrix; stored in artefacts."""


@dataclass(frozen=True)
class CalibrationMatrix:
    """Readings = zero + sum over p terms of coefficients (p, c) times terms of the loads in N and N m.

    The p terms are `all_terms` of the k components, in that order. `coefficients` [V per N^a (N m)^b] are zero where a
    channel does not have a term. `calibrated_range`, `smallest_load` and `largest_load` (k,) [N, N m]; `zeros` (c,)
    [V]; `residual_sigma` (c,) [V] with `dof` (c,); `correlation` (c, c) of the residuals. `rig` is empty where the
    matrix does not state it. With a `reading_unit` of V/V or 1 (counts) V stands for it.
    """

    rig: str
    components: tuple[str, ...]
    calibrated_range: Array
    smallest_load: Array
    largest_load: Array
    channel_names: tuple[str, ...]
    zeros: Array
    residual_sigma: Array
    dof: Array
    correlation: Array
    coefficients: Array
    reading_unit: str = VOLTAGE

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names (p,) of the terms."""
        return tuple(term.name(self.components) for term in all_terms(len(self.components)))

    @property
    def residual_covariance(self) -> Array:
        """Covariance (c, c) [V2] of the residuals."""
        return np.asarray(self.correlation * self.residual_sigma[:, None] * self.residual_sigma)


def matrix_from_model(model: CalibrationModel, rig: str, reading_unit: str = VOLTAGE) -> CalibrationMatrix:
    """Convert a calibration model to a matrix; its zeros are the means over the load series."""
    terms = all_terms(len(model.components))
    row = {term.name(model.components): i for i, term in enumerate(terms)}
    per_full_range = np.zeros((len(terms), len(model.channel_names)))
    per_full_range[[row[name] for name in model.terms]] = model.coefficients
    sigma = np.sqrt(np.diagonal(model.residual_covariance))
    correlation = model.residual_covariance / (sigma[:, None] * sigma)
    np.fill_diagonal(correlation, 1.0)
    return CalibrationMatrix(
        rig=rig,
        components=model.components,
        calibrated_range=model.calibrated_range,
        smallest_load=model.smallest_load,
        largest_load=model.largest_load,
        channel_names=model.channel_names,
        zeros=model.zeros.mean(axis=0),
        residual_sigma=sigma,
        dof=model.dof,
        correlation=correlation,
        coefficients=per_full_range / terms_at_calibrated_range(model.calibrated_range)[:, None],
        reading_unit=reading_unit,
    )


def model_from_matrix(matrix: CalibrationMatrix) -> CalibrationModel:
    """Convert a matrix to a calibration model with unknown errors: zero covariance; t, p-values and the like NaN."""
    k, c = len(matrix.components), len(matrix.channel_names)
    coefficients = matrix.coefficients * terms_at_calibrated_range(matrix.calibrated_range)[:, None]
    linear = {term.name(matrix.components) for term in linear_terms(k)}
    has_term = [name in linear or bool(np.any(row)) for name, row in zip(matrix.term_names, coefficients, strict=True)]
    names = tuple(name for name, is_present in zip(matrix.term_names, has_term, strict=True) if is_present)
    unknown = np.full((len(names), c), np.nan)
    return CalibrationModel(
        channel_names=matrix.channel_names,
        components=matrix.components,
        calibrated_range=matrix.calibrated_range,
        terms=names,
        coefficients=coefficients[has_term],
        covariance=np.zeros((c, len(names), len(names))),
        t=unknown,
        p_value=unknown,
        variance_inflation=unknown,
        residual_covariance=matrix.residual_covariance,
        dof=matrix.dof,
        press=np.full(c, np.nan),
        cross_validation_rms=np.full(c, np.nan),
        load_series=(MATRIX_SERIES,),
        zeros=matrix.zeros[None],
        zero_sigma=np.full((1, c), np.nan),
        largest_load=matrix.largest_load,
        smallest_load=matrix.smallest_load,
        unsupported_terms={},
    )


def terms_at_calibrated_range(full_range: Array) -> Array:
    """Values (p,) of all terms at the calibrated range (k,): V = coefficient in engineering units times this."""
    return np.asarray(term_values(all_terms(len(full_range)), full_range[None])[0])


def term_unit(term: Term, components: Sequence[str], reading_unit: str = VOLTAGE) -> str:
    """Unit of the coefficient of a term: `V/N`, `V/(N m)^2`, `V/(N (N m))`, `(V/V)/N`."""
    powers = {"N": 0, "N m": 0}
    for i in (term.i,) * (term.degree - (not term.single_load)) + (() if term.single_load else (term.j,)):
        powers[UNIT_OF[components[i]]] += 1
    parts = [_format_power(unit, power) for unit, power in powers.items() if power]
    above = f"({reading_unit})" if "/" in reading_unit else reading_unit
    return f"{above}/{parts[0]}" if len(parts) == 1 else f"{above}/({' '.join(parts)})"


def _format_power(unit: str, power: int) -> str:
    bracketed = f"({unit})" if " " in unit else unit
    return bracketed if power == 1 else f"{bracketed}^{power}"
