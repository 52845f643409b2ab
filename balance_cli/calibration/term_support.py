"""Terms that a load schedule supports, and the reason why it does not support the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import subtract_block_means
from balance_cli.calibration.terms import Term, linear_terms, term_values

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_INDEPENDENT_SHARE = 1e-3
"""Share of the norm of a term that loads and zeros must not explain; less is inexact repetition of loads."""
MIN_APPLIED_LOAD = 0.02
"""Share of the calibrated range above which a component counts as loaded, well above load noise."""


@dataclass(frozen=True)
class TermSupport:
    """The terms that the loads support, and for each of the others the reason why not."""

    terms: tuple[Term, ...]
    unsupported: dict[Term, str]


def find_supported_terms(terms: Sequence[Term], x: Array, block: Index, loads: Sequence[str]) -> TermSupport:
    """Find the terms that loads x (m, n) support, in units of the calibrated range, with a zero for each block (m,).

    A term is not supported where the zeros and the loads themselves explain it, or where it is collinear with an
    earlier term in this schedule.
    """
    linear_columns = subtract_block_means(term_values(linear_terms(x.shape[1]), x), block)
    basis = _orthonormal_basis(linear_columns)
    supported: list[Term] = []
    unsupported: dict[Term, str] = {}
    spanned = np.zeros((len(x), 0))
    for term in terms:
        column = subtract_block_means(term_values([term], x), block)[:, 0]
        if term.linear:
            supported.append(term)
            continue
        left = column - basis @ (basis.T @ column)
        if np.linalg.norm(left) <= MIN_INDEPENDENT_SHARE * np.linalg.norm(term_values([term], x)):
            unsupported[term] = _refusal_reason(term, x, loads)
            continue
        unit = left / np.linalg.norm(left)
        correlation = np.abs(unit @ spanned)
        if correlation.size and correlation.max() > 1.0 - 0.5 * MIN_INDEPENDENT_SHARE**2:
            equivalent_term = [earlier for earlier in supported if not earlier.linear][int(np.argmax(correlation))]
            unsupported[term] = f"does what {equivalent_term.name(loads)} does in these loads"
            continue
        supported.append(term)
        spanned = np.column_stack([spanned, unit])
    return TermSupport(tuple(supported), unsupported)


def _orthonormal_basis(values: Array) -> Array:
    size = np.linalg.norm(values, axis=0)
    U, s, _ = np.linalg.svd(values / np.where(size > 0, size, 1.0), full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s[0]])


def _refusal_reason(term: Term, x: Array, loads: Sequence[str]) -> str:
    """What the schedule lacks, in words that are stored in artefacts."""
    applied = np.abs(x) > MIN_APPLIED_LOAD
    for i in term.loads:
        if not applied[:, i].any():
            return f"{loads[i]} was never loaded"
    if not term.single_load and not np.any(applied[:, term.i] & applied[:, term.j]):
        return f"{loads[term.i]} and {loads[term.j]} were never loaded together"
    for i in term.loads:
        if not (np.any(x[:, i] > MIN_APPLIED_LOAD) and np.any(x[:, i] < -MIN_APPLIED_LOAD)):
            way = "downwards" if np.any(x[:, i] > MIN_APPLIED_LOAD) else "upwards"
            return f"{loads[i]} was never loaded {way}"
    return "the loads themselves explain it in this schedule"
