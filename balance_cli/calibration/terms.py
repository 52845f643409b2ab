"""The terms of a balance calibration: the ten families of AIAA R-091, for any number of loads.

With loads F, G in units of their calibrated range the families are, in the order of AIAA R-091,

    F   |F|   F^2   F|F|   FG   |FG|   F|G|   |F|G   F^3   |F^3|

96 terms for six loads. Each is a product of a function of F and a function of G, so that values and derivatives are
table look-ups. The non-iterative method uses the same terms for loads as functions of readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONSTANT, IDENTITY, ABSOLUTE, SQUARE, SIGNED_SQUARE, CUBE, ABSOLUTE_CUBE = range(7)
"""Functions of one load: 1, F, |F|, F^2, F|F|, F^3, |F^3|."""

_SINGLE_LOAD_NAMES = {
    IDENTITY: "{0}",
    ABSOLUTE: "|{0}|",
    SQUARE: "{0}^2",
    SIGNED_SQUARE: "{0}|{0}|",
    CUBE: "{0}^3",
    ABSOLUTE_CUBE: "|{0}^3|",
}
_TWO_LOAD_NAMES = {
    (IDENTITY, IDENTITY): "{0} {1}",
    (ABSOLUTE, ABSOLUTE): "|{0} {1}|",
    (IDENTITY, ABSOLUTE): "{0} |{1}|",
    (ABSOLUTE, IDENTITY): "|{0}| {1}",
}
_DEGREE = {CONSTANT: 0, IDENTITY: 1, ABSOLUTE: 1, SQUARE: 2, SIGNED_SQUARE: 2, CUBE: 3, ABSOLUTE_CUBE: 3}


@dataclass(frozen=True)
class Term:
    """A function of load i times a function of load j; for a single load j is i and its function CONSTANT."""

    i: int
    function: int
    j: int
    other_function: int = CONSTANT

    @property
    def single_load(self) -> bool:
        """Whether the term depends on one load only."""
        return self.other_function == CONSTANT

    @property
    def linear(self) -> bool:
        """Whether the term is the load itself."""
        return self.single_load and self.function == IDENTITY

    @property
    def is_quadratic(self) -> bool:
        """Whether the term is a square, or a product of two loads."""
        own = self.function == SQUARE if self.single_load else self.function == IDENTITY
        return own and self.other_function in (CONSTANT, IDENTITY)

    @property
    def loads(self) -> tuple[int, ...]:
        """Indices of the loads on which the term depends."""
        return (self.i,) if self.single_load else (self.i, self.j)

    @property
    def degree(self) -> int:
        """Degree of the term as a polynomial in the loads."""
        return _DEGREE[self.function] + _DEGREE[self.other_function]

    def name(self, loads: Sequence[str]) -> str:
        """Name of the term as written in tables: `Fx |My|`."""
        if self.single_load:
            return _SINGLE_LOAD_NAMES[self.function].format(loads[self.i])
        return _TWO_LOAD_NAMES[self.function, self.other_function].format(loads[self.i], loads[self.j])


def linear_terms(count: int) -> tuple[Term, ...]:
    """The terms that are the loads themselves."""
    return tuple(Term(i, IDENTITY, i) for i in range(count))


def all_terms(count: int) -> tuple[Term, ...]:
    """All ten families of n = `count` loads in the order of AIAA R-091: 2 n (n + 2) terms."""
    single_load = [[Term(i, function, i) for i in range(count)] for function in _SINGLE_LOAD_NAMES]
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    cross_terms = [[Term(i, first, j, second) for i, j in pairs] for first, second in _TWO_LOAD_NAMES]
    families = (*single_load[:4], *cross_terms, *single_load[4:])
    return tuple(term for family in families for term in family)


def term_from_name(name: str, loads: Sequence[str]) -> Term:
    """The term with this name; raises KeyError if there is none."""
    return _terms_by_name(tuple(loads))[name]


@lru_cache(maxsize=8)
def _terms_by_name(loads: tuple[str, ...]) -> dict[str, Term]:
    return {term.name(loads): term for term in all_terms(len(loads))}


def term_values(terms: Sequence[Term], x: Array) -> Array:
    """Values (m, p) of the terms at loads x (m, n) in units of the calibrated range."""
    values = _function_values(x)
    i, a, j, b = _term_indices(terms)
    return np.asarray(values[a, :, i] * values[b, :, j]).T


def term_derivatives(terms: Sequence[Term], x: Array) -> Array:
    """Derivatives (m, p, n) of the terms with respect to the loads x (m, n); at a kink the right-hand derivative."""
    values, derivatives = _function_values(x), _function_derivatives(x)
    i, a, j, b = _term_indices(terms)
    gradient = np.zeros((len(terms), *x.shape))
    rows = np.arange(len(terms))
    gradient[rows, :, i] = derivatives[a, :, i] * values[b, :, j]
    gradient[rows, :, j] += np.where((b == CONSTANT)[:, None], 0.0, values[a, :, i] * derivatives[b, :, j])
    return np.asarray(gradient.transpose(1, 0, 2))


def largest_derivatives(terms: Sequence[Term], reach: Array) -> Array:
    """Largest absolute value (p, n) of each derivative over loads within +-`reach` (n,)."""
    # The absolute value of every derivative grows with that of every load.
    return np.asarray(np.abs(term_derivatives(terms, np.asarray(reach, float)[None]))[0])


def _term_indices(terms: Sequence[Term]) -> tuple[NDArray[np.intp], ...]:
    """Load i, its function, load j and its function (p,) of each term."""
    table = [(term.i, term.function, term.j, term.other_function) for term in terms]
    return tuple(np.array(table, dtype=np.intp).reshape(-1, 4).T)


def _function_values(x: Array) -> Array:
    """Values (7, m, n) of the functions of each load."""
    size = np.abs(x)
    square = x * x
    return np.stack([np.ones_like(x), x, size, square, x * size, x * square, size * square])


def _function_derivatives(x: Array) -> Array:
    """Derivatives (7, m, n) of the functions of each load."""
    size, sign = np.abs(x), np.where(x < 0, -1.0, 1.0)
    return np.stack([np.zeros_like(x), np.ones_like(x), sign, 2 * x, 2 * size, 3 * x**2, 3 * x * size])
