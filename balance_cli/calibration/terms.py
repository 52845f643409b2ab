"""The terms of a balance calibration: the ten families of AIAA R-091, for any number of loads.

With loads F, G in units of their full range the families are, in the usual order,

    F   |F|   F^2   F|F|   FG   |FG|   F|G|   |F|G   F^3   |F^3|

96 for six loads. Each is a product of one function of F and one of G, which makes columns and derivatives one
look-up each. The same terms serve for loads as functions of outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ONE, SAME, SIZE, SQUARE, SIGNED, CUBE, CUBE_SIZE = range(7)
"""Functions of one load: 1, F, |F|, F^2, F|F|, F^3, |F^3|."""

_ALONE = {SAME: "{0}", SIZE: "|{0}|", SQUARE: "{0}^2", SIGNED: "{0}|{0}|", CUBE: "{0}^3", CUBE_SIZE: "|{0}^3|"}
_TOGETHER = {
    (SAME, SAME): "{0} {1}",
    (SIZE, SIZE): "|{0} {1}|",
    (SAME, SIZE): "{0} |{1}|",
    (SIZE, SAME): "|{0}| {1}",
}
_DEGREE = {ONE: 0, SAME: 1, SIZE: 1, SQUARE: 2, SIGNED: 2, CUBE: 3, CUBE_SIZE: 3}


@dataclass(frozen=True)
class Term:
    """A function of load i times a function of load j; j is i and its function ONE where one load is in it alone."""

    i: int
    function: int
    j: int
    other: int = ONE

    @property
    def alone(self) -> bool:
        """Whether one load only is in it."""
        return self.other == ONE

    @property
    def linear(self) -> bool:
        """Whether it is the load itself."""
        return self.alone and self.function == SAME

    @property
    def loads(self) -> tuple[int, ...]:
        """The loads that are in it."""
        return (self.i,) if self.alone else (self.i, self.j)

    @property
    def degree(self) -> int:
        """Of what power of the loads it is."""
        return _DEGREE[self.function] + _DEGREE[self.other]

    def name(self, loads: Sequence[str]) -> str:
        """As written in tables: `Fx |My|`."""
        if self.alone:
            return _ALONE[self.function].format(loads[self.i])
        return _TOGETHER[self.function, self.other].format(loads[self.i], loads[self.j])


def linear_terms(count: int) -> tuple[Term, ...]:
    """The loads themselves."""
    return tuple(Term(i, SAME, i) for i in range(count))


def all_terms(count: int) -> tuple[Term, ...]:
    """All ten families of so many loads, in the order of AIAA R-091: 2 n (n + 2) terms."""
    alone = [[Term(i, function, i) for i in range(count)] for function in _ALONE]
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    together = [[Term(i, one, j, other) for i, j in pairs] for one, other in _TOGETHER]
    families = (*alone[:4], *together, *alone[4:])
    return tuple(term for family in families for term in family)


def term_named(name: str, loads: Sequence[str]) -> Term:
    """The term with this name. KeyError where there is none."""
    return {term.name(loads): term for term in all_terms(len(loads))}[name]


def columns(terms: Sequence[Term], x: Array) -> Array:
    """Values (m, p) of the terms at loads x (m, n), in units of their full range."""
    values = _functions(x)
    i, a, j, b = _indices(terms)
    return np.asarray(values[a, :, i] * values[b, :, j]).T


def slopes(terms: Sequence[Term], x: Array) -> Array:
    """Derivatives (m, p, n) of the terms by the loads x (m, n); at a fold that from above."""
    values, slope = _functions(x), _slopes(x)
    i, a, j, b = _indices(terms)
    found = np.zeros((len(terms), *x.shape))
    rows = np.arange(len(terms))
    found[rows, :, i] = slope[a, :, i] * values[b, :, j]
    found[rows, :, j] += np.where((b == ONE)[:, None], 0.0, values[a, :, i] * slope[b, :, j])
    return np.asarray(found.transpose(1, 0, 2))


def steepest(terms: Sequence[Term], reach: Array) -> Array:
    """The largest size (p, n) of each derivative over loads within +-`reach` (n,)."""
    # Every derivative grows, in size, with the size of every load.
    return np.asarray(np.abs(slopes(terms, np.asarray(reach, float)[None]))[0])


def _indices(terms: Sequence[Term]) -> tuple[NDArray[np.intp], ...]:
    table = np.array([(term.i, term.function, term.j, term.other) for term in terms], dtype=np.intp).reshape(-1, 4)
    return tuple(table.T)


def _functions(x: Array) -> Array:
    """Functions (7, m, n) of each load."""
    size = np.abs(x)
    return np.stack([np.ones_like(x), x, size, x**2, x * size, x**3, size**3])


def _slopes(x: Array) -> Array:
    """Their derivatives (7, m, n)."""
    size, sign = np.abs(x), np.where(x < 0, -1.0, 1.0)
    return np.stack([np.zeros_like(x), np.ones_like(x), sign, 2 * x, 2 * size, 3 * x**2, 3 * x * size])
