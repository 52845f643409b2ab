"""Exact integration of linear systems on a uniform grid; between samples the signals are fifth-degree polynomials.

With `x' = lambda x + v(t)` and v the polynomial through six adjacent samples, one step of length T is
`x[k+1] = exp(lambda T) x[k] + sum_j w_j v[k+j]`, j = -2..3, exactly: an exponential integrator with a
high-order hold (phi functions as in Hochbruck and Ostermann, Acta Numerica 19, 2010, section 2). The remaining error is
that of the interpolation, 1e-8 of a sinusoid sampled 40 times a period.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import factorial
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

Samples = NDArray[Any]
"""Real or complex samples, time along the first axis."""

OFFSETS = np.arange(-2, 4)
CACHED_STEPS = 1024
"""Steps whose sums are formed together: they stay in the processor's cache, which makes the sums four times as fast."""


def phi_functions(z: complex, count: int) -> ComplexArray:
    """phi_1 .. phi_count (count,) of z, `phi_{m+1}(z) = int_0^1 exp(z (1 - s)) s^m / m! ds`."""
    chain: ComplexArray = np.zeros((count + 1, count + 1), complex)
    chain[0, 0] = z
    chain[np.arange(count), np.arange(1, count + 1)] = 1.0
    row: ComplexArray = scipy.linalg.expm(chain)[0, 1:]
    return row


def hold_weights(pole: complex, step: float, offsets: NDArray[np.int_] = OFFSETS) -> ComplexArray:
    """Weights (j,) of the samples at `offsets` in one step of `x' = pole x + v`, v the polynomial through them."""
    count = len(offsets)
    moments = phi_functions(pole * step, count) * [factorial(m) for m in range(count)]
    powers = np.linalg.inv(np.vander(offsets.astype(float), increasing=True))
    weights: ComplexArray = step * moments @ powers
    return weights


def _extrapolate(first: Samples, positions: NDArray[np.int_]) -> Samples:
    """The polynomial through six samples 0..5, (6, s), taken at other `positions`."""
    nodes = np.arange(len(first), dtype=float)
    values = np.vander(positions.astype(float), len(nodes), increasing=True)
    return np.asarray(values @ np.linalg.solve(np.vander(nodes, increasing=True), first))


def extrapolate_ends(signal: Samples) -> Samples:
    """Samples (n, s) with two before and two after, from the polynomials at either end; n at least 6."""
    head = _extrapolate(signal[:6], np.array([-2, -1]))
    tail = _extrapolate(signal[-6:], np.array([6, 7]))
    return np.concatenate([head, signal, tail])


def first_order_recursion(decay: complex, forcing: Samples, start: NDArray[Any]) -> ComplexArray:
    """`x[0] = start`, `x[k+1] = decay x[k] + forcing[k]` along the first axis; (n+1, s)."""
    from scipy.signal import lfilter  # its import takes longer than a diagnosis that simulates nothing

    driven = np.concatenate([np.asarray(start)[None, :], forcing])
    states: ComplexArray = lfilter([1.0], [1.0, -decay], driven, axis=0)
    return states


@lru_cache(maxsize=1024)  # all runs of a rig have the same poles
def _strided_weights(pole: complex, step: float, stride: int) -> NDArray[Any]:
    """Weights of the samples -2 .. stride+2 in `stride` steps at once; real where the pole is."""
    single = hold_weights(pole, step)
    weights = np.zeros(stride + len(single) - 1, complex)
    for sub in range(stride):
        weights[sub : sub + len(single)] += np.exp(pole * step * (stride - 1 - sub)) * single
    return weights.real if complex(pole).imag == 0 else weights


def integrate_first_order(pole: complex, signal: Samples, step: float, start: NDArray[Any]) -> NDArray[Any]:
    """Solution (n, s) of `x' = pole x + v` at the samples of v (n, s), from `start` (s,)."""
    weights, wide = _strided_weights(pole, step, 1), extrapolate_ends(signal)
    forcing = np.stack([np.convolve(column, weights[::-1], "valid") for column in wide.T], axis=1)
    decay = np.exp(pole * step)
    return first_order_recursion(decay.real if complex(pole).imag == 0 else decay, forcing, start)


def _integrate_modes(poles: ComplexArray, inputs: ComplexArray, u: Array, step: float, stride: int) -> ComplexArray:
    """States (ceil(n/stride), m) of `z_i' = poles_i z_i + (inputs u)_i` at every `stride`-th sample of u (n, a)."""
    from scipy.signal import lfilter  # see `first_order_recursion`

    weights = np.stack([_strided_weights(complex(pole), step, stride) for pole in poles])
    taps = weights.shape[1]
    windows = np.lib.stride_tricks.sliding_window_view(extrapolate_ends(u), taps, axis=0)[::stride]
    # One product of real matrices for the forcing of all modes.
    by_mode = np.ascontiguousarray((inputs[:, :, None] * weights[:, None, :]).reshape(len(poles), -1).T)
    states = np.empty((len(windows) + 1, len(poles)), complex)
    states[0] = -(inputs @ u[0]) / poles
    for start in range(0, len(windows), CACHED_STEPS):
        block = windows[start : start + CACHED_STEPS]
        np.matmul(block.reshape(len(block), -1), by_mode.view(float), out=states[start + 1 :][: len(block)].view(float))
    for i, decay in enumerate(np.exp(poles * step * stride)):
        states[:, i] = lfilter([1.0], [1.0, -decay], states[:, i])
    return states


@dataclass(frozen=True)
class ModalSystem:
    """`z_i' = poles_i z_i + (inputs u)_i`, `y = Re(outputs z) + direct u`: a real linear system in its modes.

    `poles` (m,), `inputs` (m, u), `outputs` (y, m), `direct` (y, u). Of a conjugate pair one
    mode is stored, with doubled outputs.
    """

    poles: ComplexArray
    inputs: ComplexArray
    outputs: ComplexArray
    direct: Array

    def response(self, u: Array, step: float, stride: int = 1) -> Array:
        """Outputs (ceil(n/stride), y) at every `stride`-th sample of the inputs (n, u).

        These are sampled every `step` s. The response begins from equilibrium under the first sample.
        """
        acting = np.flatnonzero(np.any(u != 0, axis=0))
        live = np.flatnonzero(np.any(self.inputs[:, acting], axis=1) & np.any(self.outputs, axis=0))
        y: Array = u[::stride] @ self.direct.T
        if len(live):
            states = _integrate_modes(self.poles[live], self.inputs[np.ix_(live, acting)], u[:, acting], step, stride)
            outputs = self.outputs[:, live]
            interleaved = np.stack([outputs.real, -outputs.imag], axis=-1).reshape(len(outputs), -1)
            y += states.view(float) @ interleaved.T
        return y

    def subsystem(self, outputs: slice, inputs: slice) -> ModalSystem:
        """The same system with only some of its outputs and inputs."""
        return ModalSystem(self.poles, self.inputs[:, inputs], self.outputs[outputs], self.direct[outputs, inputs])

    def static_gain(self) -> Array:
        """Response (y, u) to constant inputs."""
        gain: Array = self.direct - np.real((self.outputs / self.poles) @ self.inputs)
        return gain


def modal_system(A: Array, B: Array, C: Array, direct: Array | None) -> ModalSystem:
    """`x' = A x + B u`, `y = C x + direct u` in modes. Raises UserError where A has no full set of eigenvectors."""
    poles, vectors = np.linalg.eig(A)
    if np.linalg.cond(vectors / np.linalg.norm(vectors, axis=0)) > 1e13:
        raise UserError("a critically damped mode has no eigenvectors of its own", place="damping_ratio")
    inputs = np.linalg.solve(vectors, B.astype(complex))
    outputs = C @ vectors
    upper = poles.imag >= 0
    weight = np.where(poles.imag > 0, 2.0, 1.0)
    none = np.zeros((len(C), B.shape[1]))
    return ModalSystem(poles[upper], inputs[upper], (outputs * weight)[:, upper], none if direct is None else direct)
