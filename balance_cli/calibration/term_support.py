"""Terms that a load schedule supports, and the reason why it does not support the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
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


def find_supported_terms(
    terms: Sequence[Term],
    x: Array,
    block: Index,
    loads: Sequence[str],
    jointly: bool = False,
    excluded: Array | None = None,
) -> TermSupport:
    """Find the terms that loads x (m, n) support, in units of the calibrated range, with a zero for each block (m,).

    A term is not supported where the zeros and the loads themselves explain it, or where it is collinear with an
    earlier term in this schedule; `jointly`, where the earlier terms together explain it. `excluded` (q, n): loads of
    rows that are not fitted, which the reasons name.
    """
    basis = _orthonormal_basis(subtract_block_means(term_values(linear_terms(x.shape[1]), x), block))
    values = term_values(terms, x)
    columns = subtract_block_means(values, block)
    left = columns - basis @ (basis.T @ columns)
    size = np.linalg.norm(left, axis=0)
    is_independent = size > MIN_INDEPENDENT_SHARE * np.linalg.norm(values, axis=0)
    unit = left / np.where(size > 0, size, 1.0)
    correlation = np.abs(unit.T @ unit)
    is_linear = np.array([term.linear for term in terms], bool)
    is_supported = np.zeros(len(terms), bool)
    unsupported: dict[Term, str] = {}
    for number, term in enumerate(terms):
        if not is_linear[number]:
            earlier = np.where(is_supported & ~is_linear, correlation[number], 0.0)
            if not is_independent[number]:
                unsupported[term] = _refusal_reason(
                    term, x, loads, np.zeros((0, x.shape[1])) if excluded is None else excluded
                )
                continue
            if np.max(earlier) > 1.0 - 0.5 * MIN_INDEPENDENT_SHARE**2:
                unsupported[term] = f"does what {terms[int(np.argmax(earlier))].name(loads)} does in these loads"
                continue
        is_supported[number] = True
    if jointly:
        _drop_jointly_dependent(terms, columns, is_supported, unsupported)
    return TermSupport(tuple(compress(terms, is_supported)), unsupported)


def _drop_jointly_dependent(
    terms: Sequence[Term], columns: Array, is_supported: NDArray[np.bool_], unsupported: dict[Term, str]
) -> None:
    """Mark the terms whose columns (m, p) the earlier ones explain: a search would not add them, a list does."""
    basis = np.zeros((len(columns), 0))
    for number in np.flatnonzero(is_supported).tolist():
        left = columns[:, number]
        for _ in range(2):  # twice is enough against rounding (Kahan and Parlett)
            left = left - basis @ (basis.T @ left)
        size = np.linalg.norm(left)
        if not terms[number].linear and size <= MIN_INDEPENDENT_SHARE * np.linalg.norm(columns[:, number]):
            is_supported[number] = False
            unsupported[terms[number]] = "the other terms together explain it in this schedule"
        elif size > 0:
            basis = np.column_stack([basis, left / size])


def _orthonormal_basis(values: Array) -> Array:
    size = np.linalg.norm(values, axis=0)
    U, s, _ = np.linalg.svd(values / np.where(size > 0, size, 1.0), full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s[0]])


def _refusal_reason(term: Term, x: Array, loads: Sequence[str], excluded: Array) -> str:
    """What the schedule lacks, in words that are stored in artefacts."""
    applied = np.abs(x) > MIN_APPLIED_LOAD
    for i in term.loads:
        if not applied[:, i].any():
            return f"{loads[i]} was never loaded"
    if not term.single_load and not np.any(applied[:, term.i] & applied[:, term.j]):
        together = np.all(np.abs(excluded[:, [term.i, term.j]]) > MIN_APPLIED_LOAD, axis=1)
        pair = f"{loads[term.i]} and {loads[term.j]} were"
        return f"{pair} loaded together in excluded rows only" if together.any() else f"{pair} never loaded together"
    for i in term.loads:
        if not (np.any(x[:, i] > MIN_APPLIED_LOAD) and np.any(x[:, i] < -MIN_APPLIED_LOAD)):
            way = "downwards" if np.any(x[:, i] > MIN_APPLIED_LOAD) else "upwards"
            return f"{loads[i]} was never loaded {way}"
    return "the loads themselves explain it in this schedule"
