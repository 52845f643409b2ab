"""The matrix of a balance in engineering units: what balances are handed on with, and the way from and to the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.terms import Term, all_terms, columns, linear_terms
from balance_cli.campaign.rig.components import UNIT_OF

Array = NDArray[np.float64]

MATRIX_SERIES = "as stated in the matrix"
"""In the place of the loading sequence that a zero belongs to."""


@dataclass(frozen=True)
class CalibrationMatrix:
    """Readings = zero + sum over p terms of coefficients (p, c) times terms of the loads in N and N m.

    The p terms are `all_terms` of the k components, in that order; coefficients in V per N^a (N m)^b, zero where a
    channel does not have a term. `full_range`, `smallest` and `largest` (k,) [N, N m]; `zeros` (c,) [V];
    `residual_sigma` (c,) [V] with `dof` (c,); `correlation` (c, c) of the residuals. `rig`: its name, empty where it is
    not stated.
    """

    rig: str
    components: tuple[str, ...]
    full_range: Array
    smallest: Array
    largest: Array
    channel_names: tuple[str, ...]
    zeros: Array
    residual_sigma: Array
    dof: Array
    correlation: Array
    coefficients: Array

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names (p,) of the terms."""
        return tuple(term.name(self.components) for term in all_terms(len(self.components)))

    @property
    def residual_covariance(self) -> Array:
        """Covariance (c, c) [V2] of the residuals."""
        return np.asarray(self.correlation * self.residual_sigma[:, None] * self.residual_sigma)


def matrix_from_model(model: CalibrationModel, rig: str) -> CalibrationMatrix:
    """The matrix of a model; its zero is the mean over the loading sequences."""
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
        full_range=model.full_range,
        smallest=model.smallest,
        largest=model.largest,
        channel_names=model.channel_names,
        zeros=model.zeros.mean(axis=0),
        residual_sigma=sigma,
        dof=model.dof,
        correlation=correlation,
        coefficients=per_full_range / terms_at_calibrated_range(model.full_range)[:, None],
    )


def model_from_matrix(matrix: CalibrationMatrix) -> CalibrationModel:
    """The model of a matrix. Errors of its coefficients are not known: covariance zero, t and the like NaN."""
    k, c = len(matrix.components), len(matrix.channel_names)
    coefficients = matrix.coefficients * terms_at_calibrated_range(matrix.full_range)[:, None]
    linear = {term.name(matrix.components) for term in linear_terms(k)}
    has_term = [name in linear or bool(np.any(row)) for name, row in zip(matrix.term_names, coefficients, strict=True)]
    names = tuple(name for name, is_present in zip(matrix.term_names, has_term, strict=True) if is_present)
    unknown = np.full((len(names), c), np.nan)
    return CalibrationModel(
        channel_names=matrix.channel_names,
        components=matrix.components,
        full_range=matrix.full_range,
        terms=names,
        coefficients=coefficients[has_term],
        covariance=np.zeros((c, len(names), len(names))),
        t=unknown,
        p_value=unknown,
        variance_inflation=unknown,
        residual_covariance=matrix.residual_covariance,
        dof=matrix.dof,
        press=np.full(c, np.nan),
        left_out=np.full(c, np.nan),
        sequences=(MATRIX_SERIES,),
        zeros=matrix.zeros[None],
        zero_sigma=np.full((1, c), np.nan),
        largest=matrix.largest,
        smallest=matrix.smallest,
        refused={},
    )


def terms_at_calibrated_range(full_range: Array) -> Array:
    """Values (p,) of all terms at full range (k,): what a coefficient in engineering units is multiplied by."""
    return np.asarray(columns(all_terms(len(full_range)), full_range[None])[0])


def term_unit(term: Term, components: Sequence[str]) -> str:
    """Unit of a coefficient: `V/N`, `V/(N m)^2`, `V/(N (N m))`."""
    powers = {"N": 0, "N m": 0}
    for i in (term.i,) * (term.degree - (not term.single_load)) + (() if term.single_load else (term.j,)):
        powers[UNIT_OF[components[i]]] += 1
    parts = [_format_power(unit, power) for unit, power in powers.items() if power]
    return f"V/{parts[0]}" if len(parts) == 1 else f"V/({' '.join(parts)})"


def _format_power(unit: str, power: int) -> str:
    bracketed = f"({unit})" if " " in unit else unit
    return bracketed if power == 1 else f"{bracketed}^{power}"
