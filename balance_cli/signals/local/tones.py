"""Steady tones in a record, such as the mains, separated from the transient that local models remove.

A steady tone has the same lines as a transient that does not decay: a local model would give it a pole on the frequency
axis, and remove it with the transient. No mode of a structure has a pole there. Where a fit has one, the tone becomes
an additional input with known lines, and its contribution is separated. A mode that decays too slowly for the record
keeps its pole in this second fit, because the loads excite it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.local.fit import WindowedData
from balance_cli.signals.local.window import WindowFit, poles

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

AXIS_TOLERANCE = 0.05
"""Lines from a pole to the frequency axis: those of a mode of 50 Hz and a damping ratio of 1e-4 in 10 s."""
TONE_TOLERANCE = 1.0
"""Lines from a tone within which a pole that remains in the second fit is that of the tone."""


def tone_lines(
    windows: WindowedData,
    fits: Sequence[WindowFit],
    refit: Callable[[WindowedData], tuple[WindowFit, ...]],
    first: Index,
    assigned_lines: Index,
    lines: int,
) -> ComplexArray:
    """Return the contribution of steady tones to the channels (lines, c), in the units of the windows.

    It is zero where no fit has an undamped pole. `first` (W,) are the first lines of the windows, `assigned_lines`
    (W, 2) those for which they are used. `refit` fits a window again.
    """
    tones = np.zeros((lines, windows.Y.shape[2]), complex)
    for w, fit in enumerate(fits):
        positions = _undamped_poles(fit, assigned_lines[w] - first[w])
        if positions.size:
            positions, amplitudes = _tone_amplitudes(windows.subset(np.array([w])), positions, refit)
            # A tone between two lines leaks far beyond its window.
            tones += _dirichlet_kernel(positions + first[w], lines) @ amplitudes
    return tones


def _undamped_poles(fit: WindowFit, assigned_lines: Index) -> Array:
    """Positions, in lines of the window, of poles on the axis within the assigned lines (from, to)."""
    position = _pole_positions(fit)
    tone = (
        (np.abs(position.imag) < AXIS_TOLERANCE)
        & (position.real >= assigned_lines[0] - 0.5)
        & (position.real < assigned_lines[1] - 0.5)
    )
    return np.asarray(position.real[tone])


def _pole_positions(fit: WindowFit) -> ComplexArray:
    """Poles, in lines of the window."""
    half = (len(fit.r) - 1) / 2
    return half + half * poles(fit)


def _tone_amplitudes(
    window: WindowedData, positions: Array, refit: Callable[[WindowedData], tuple[WindowFit, ...]]
) -> tuple[Array, ComplexArray]:
    """Positions (t,) that are tones, and their amplitudes in the channels (t, c).

    With the lines of the tones as inputs the remaining poles are those of the structure, and each tone has one
    amplitude in each channel. Where a pole remains at a position, it is a mode that the loads excite, and not a tone.
    """
    M = window.Y.shape[1]
    (fit,) = refit(replace(window, U=np.concatenate([window.U, _dirichlet_kernel(positions, M)[None]], axis=2)))
    distance = np.abs(_pole_positions(fit) - positions[:, None])
    positions = positions[np.min(distance, axis=1, initial=np.inf) > TONE_TOLERANCE]
    tones = _dirichlet_kernel(positions, M)
    basis = np.linalg.qr(replace(fit, U=window.U[0]).regressors)[0]
    remainder = tones - basis @ (basis.conj().T @ tones)
    return positions, np.asarray(np.linalg.lstsq(remainder, window.Y[0], rcond=None)[0])


def _dirichlet_kernel(positions: Array, lines: int) -> ComplexArray:
    """Lines (M, t) of the tones exp(j 2 pi p n / N), n < N, divided by N, for N much greater than M."""
    distance = positions - np.arange(lines)[:, None]
    return np.asarray(np.exp(1j * np.pi * distance) * np.sinc(distance))
