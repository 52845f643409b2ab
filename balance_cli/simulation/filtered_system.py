"""A linear system with a filter behind each of its outputs, as one system in modes, by partial fractions.

It is solved at the sample rate at once; otherwise the outputs would be computed on the fine grid, and filtered there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.integrate import ModalSystem

ComplexArray = NDArray[np.complex128]

MIN_SEPARATION = 1e-3
"""Least distance of two poles, relative to the larger: their partial fractions cancel to the third digit."""


@dataclass(frozen=True)
class RationalFilter:
    """The filter `gain prod(s - zeros) / prod(s - poles)`, with no more zeros than poles; complex ones in pairs."""

    zeros: ComplexArray
    poles: ComplexArray
    gain: float

    def __matmul__(self, other: RationalFilter) -> RationalFilter:
        """Both filters, one behind the other."""
        zeros, poles = np.append(self.zeros, other.zeros), np.append(self.poles, other.poles)
        return RationalFilter(zeros, poles, self.gain * other.gain)

    @property
    def direct(self) -> float:
        """The gain at infinite frequency."""
        return self.gain if len(self.zeros) == len(self.poles) else 0.0

    def response(self, s: ComplexArray) -> ComplexArray:
        """The filter at each `s`."""
        response: ComplexArray = self.gain * _products(s, self.zeros) / _products(s, self.poles)
        return response

    def residue(self, pole: complex) -> complex:
        """The residue at one of the poles, zero where it is none."""
        own = self.poles == pole
        rest = RationalFilter(self.zeros, self.poles[~own], self.gain)
        return complex(rest.response(np.array([pole]))[0]) if own.any() else 0.0


def _products(s: ComplexArray, roots: ComplexArray) -> ComplexArray:
    return np.asarray(np.prod(s[:, None] - roots, axis=1))


NO_FILTER = RationalFilter(np.zeros(0, complex), np.zeros(0, complex), 1.0)


def has_distinct_poles(system: ModalSystem, filters: Sequence[RationalFilter]) -> bool:
    """Whether no pole of a filter nearly coincides with another of its poles, or with one of the system."""
    return all(_are_distinct(each.poles, np.append(each.poles, system.poles)) for each in filters)


def _are_distinct(some: ComplexArray, others: ComplexArray) -> bool:
    """Whether each of the first poles is away from all others; the first of these are the same."""
    distance = np.abs(some[:, None] - others) + np.where(np.eye(len(some), len(others)), np.inf, 0.0)
    return bool(np.all(distance > MIN_SEPARATION * np.maximum(np.abs(some)[:, None], np.abs(others))))


def filter_outputs(system: ModalSystem, filters: Sequence[RationalFilter]) -> ModalSystem:
    """The system whose outputs (y,) are those of `system` behind one filter each; their poles must be distinct.

    A pole of the filters has one mode for each input, and what the system makes of the input is in its outputs.
    """
    poles = np.unique(np.concatenate([each.poles for each in filters]))
    poles = poles[poles.imag >= 0]
    direct = np.array([each.direct for each in filters])[:, None]
    passed = np.array([each.response(system.poles) for each in filters])
    residues = np.array([[each.residue(pole) for pole in poles] for each in filters]).reshape(len(filters), len(poles))
    weight = np.where(poles.imag > 0, 2.0, 1.0)
    y, u = system.direct.shape
    at_poles = np.array([_response(system, pole) for pole in poles]).reshape(len(poles), y, u)
    of_filters = (residues * weight)[:, :, None] * at_poles.swapaxes(0, 1)
    return ModalSystem(
        np.append(system.poles, np.repeat(poles, u)),
        np.vstack([system.inputs, np.tile(np.eye(u), (len(poles), 1))]),
        np.hstack([system.outputs * passed, of_filters.reshape(y, -1)]),
        direct * system.direct,
    )


def _response(system: ModalSystem, s: complex) -> ComplexArray:
    """The response (y, u) of the system at `s`, its stored modes and their conjugates."""
    modes = (system.outputs / (s - system.poles)) @ system.inputs
    conjugate = (system.outputs.conj() / (s - system.poles.conj())) @ system.inputs.conj()
    return np.asarray(system.direct + 0.5 * (modes + conjugate))
