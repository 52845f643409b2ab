"""Which terms a load schedule can tell at all, and why it cannot tell the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import without_zeros
from balance_cli.calibration.terms import Term, columns, linear_terms

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Share of a term's variation that the loads themselves must leave; a share of full range that counts as loaded.
LEAST_LEFT = 1e-3
LOADED = 0.02


@dataclass(frozen=True)
class Support:
    """Terms that the loads support, and the reason for each of the others, by term."""

    terms: tuple[Term, ...]
    refused: dict[Term, str]


def supported(terms: Sequence[Term], x: Array, block: Index, loads: Sequence[str]) -> Support:
    """Sort terms by whether loads x (m, n), in units of full range, with a zero for each block (m,), support them.

    A term is refused where the zeros and the loads themselves explain it, or it does what a term before it does.
    """
    straight = without_zeros(columns(linear_terms(x.shape[1]), x), block)
    basis = _orthonormal(straight)
    kept: list[Term] = []
    refused: dict[Term, str] = {}
    spanned = np.zeros((len(x), 0))
    for term in terms:
        column = without_zeros(columns([term], x), block)[:, 0]
        if term.linear:
            kept.append(term)
            continue
        left = column - basis @ (basis.T @ column)
        if np.linalg.norm(left) <= LEAST_LEFT * np.linalg.norm(columns([term], x)):
            refused[term] = _reason(term, x, loads)
            continue
        unit = left / np.linalg.norm(left)
        alike = np.abs(unit @ spanned)
        if alike.size and alike.max() > 1.0 - 0.5 * LEAST_LEFT**2:
            same = [one for one in kept if not one.linear][int(np.argmax(alike))]
            refused[term] = f"does what {same.name(loads)} does in these loads"
            continue
        kept.append(term)
        spanned = np.column_stack([spanned, unit])
    return Support(tuple(kept), refused)


def _orthonormal(values: Array) -> Array:
    size = np.linalg.norm(values, axis=0)
    U, s, _ = np.linalg.svd(values / np.where(size > 0, size, 1.0), full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s[0]])


def _reason(term: Term, x: Array, loads: Sequence[str]) -> str:
    """What the schedule lacks, in words."""
    applied = np.abs(x) > LOADED
    for i in term.loads:
        if not applied[:, i].any():
            return f"{loads[i]} was never loaded"
    if not term.alone and not np.any(applied[:, term.i] & applied[:, term.j]):
        return f"{loads[term.i]} and {loads[term.j]} were never loaded together"
    for i in term.loads:
        if not (np.any(x[:, i] > LOADED) and np.any(x[:, i] < -LOADED)):
            way = "downwards" if np.any(x[:, i] > LOADED) else "upwards"
            return f"{loads[i]} was never loaded {way}"
    return "the loads themselves explain it in this schedule"
