"""Which terms a load schedule can tell at all, and why it cannot tell the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import subtract_block_means
from balance_cli.calibration.terms import Term, columns, linear_terms

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Share of a term's variation that the loads themselves must leave; a share of full range that counts as loaded.
MIN_INDEPENDENT_SHARE = 1e-3
MIN_APPLIED_LOAD = 0.02


@dataclass(frozen=True)
class TermSupport:
    """Terms that the loads support, and the reason for each of the others, by term."""

    terms: tuple[Term, ...]
    refused: dict[Term, str]


def find_supported_terms(terms: Sequence[Term], x: Array, block: Index, loads: Sequence[str]) -> TermSupport:
    """Sort terms by whether loads x (m, n), in units of full range, with a zero for each block (m,), support them.

    A term is refused where the zeros and the loads themselves explain it, or it does what a term before it does.
    """
    linear_columns = subtract_block_means(columns(linear_terms(x.shape[1]), x), block)
    basis = _orthonormal_basis(linear_columns)
    kept: list[Term] = []
    refused: dict[Term, str] = {}
    spanned = np.zeros((len(x), 0))
    for term in terms:
        column = subtract_block_means(columns([term], x), block)[:, 0]
        if term.linear:
            kept.append(term)
            continue
        left = column - basis @ (basis.T @ column)
        if np.linalg.norm(left) <= MIN_INDEPENDENT_SHARE * np.linalg.norm(columns([term], x)):
            refused[term] = _refusal_reason(term, x, loads)
            continue
        unit = left / np.linalg.norm(left)
        correlation = np.abs(unit @ spanned)
        if correlation.size and correlation.max() > 1.0 - 0.5 * MIN_INDEPENDENT_SHARE**2:
            equivalent_term = [one for one in kept if not one.linear][int(np.argmax(correlation))]
            refused[term] = f"does what {equivalent_term.name(loads)} does in these loads"
            continue
        kept.append(term)
        spanned = np.column_stack([spanned, unit])
    return TermSupport(tuple(kept), refused)


def _orthonormal_basis(values: Array) -> Array:
    size = np.linalg.norm(values, axis=0)
    U, s, _ = np.linalg.svd(values / np.where(size > 0, size, 1.0), full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s[0]])


def _refusal_reason(term: Term, x: Array, loads: Sequence[str]) -> str:
    """What the schedule lacks, in words."""
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
