"""Steady tones in a record, such as the mains: kept apart from the transient that local models take out.

The lines of a tone that lasts are those of a transient that does not decay: a local model would spend a pole on it, on
the axis, and take it out with the transient. No mode of a structure has a pole there. So where a fit puts one, the tone
becomes an input of its own, whose lines are known, and what that input explains is kept apart. A mode that decays too
little for the record keeps its pole then, for the loads drive it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.local.fit import WindowedData
from balance_cli.signals.local.window import WindowFit, design_matrix, poles

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Distance of a pole from the axis, in lines: a mode of 50 Hz in a record of 10 s has this at a damping ratio of 1e-4.
AXIS_TOLERANCE = 0.05
# Distance, in lines, within which a pole that is left beside a tone is that of the tone.
TONE_TOLERANCE = 1.0


def tone_lines(
    windows: WindowedData,
    fits: Sequence[WindowFit],
    refit: Callable[[WindowedData], tuple[WindowFit, ...]],
    first: Index,
    assigned_lines: Index,
    lines: int,
) -> ComplexArray:
    """What steady tones make of the channels (lines, c), in the windows' units; zero where no fit has such a pole.

    `first` (W,) and `owned` (W, 2) are the windows' first lines and those for which they speak.
    """
    found = np.zeros((lines, windows.Y.shape[2]), complex)
    for w, fit in enumerate(fits):
        places = _undamped_poles(fit, assigned_lines[w] - first[w])
        if places.size:
            places, amplitudes = _tone_amplitudes(windows.subset(np.array([w])), places, refit)
            # Off a line a tone reaches far beyond its window.
            found += _dirichlet_kernel(places + first[w], lines) @ amplitudes
    return found


def _undamped_poles(fit: WindowFit, assigned_lines: Index) -> Array:
    """Places, in lines of the window, of poles on the axis within the lines `owned` (from, to)."""
    at = _pole_positions(fit)
    tone = (
        (np.abs(at.imag) < AXIS_TOLERANCE) & (at.real >= assigned_lines[0] - 0.5) & (at.real < assigned_lines[1] - 0.5)
    )
    return np.asarray(at.real[tone])


def _pole_positions(fit: WindowFit) -> ComplexArray:
    """The poles, in lines of the window."""
    half = (len(fit.r) - 1) / 2
    return half + half * poles(fit)


def _tone_amplitudes(
    window: WindowedData, places: Array, refit: Callable[[WindowedData], tuple[WindowFit, ...]]
) -> tuple[Array, ComplexArray]:
    """Which of the `places` are tones (t,), and their amplitudes in the channels (t, c).

    With the lines of tones as inputs the poles are the structure's; beside these each tone has one amplitude in each
    channel. Where a pole is left at the place it was no tone: the loads have to do with it.
    """
    M = window.Y.shape[1]
    (fit,) = refit(replace(window, U=np.concatenate([window.U, _dirichlet_kernel(places, M)[None]], axis=2)))
    distance = np.abs(_pole_positions(fit) - places[:, None])
    places = places[np.min(distance, axis=1, initial=np.inf) > TONE_TOLERANCE]
    tones = _dirichlet_kernel(places, M)
    basis = np.linalg.qr(design_matrix(replace(fit, U=window.U[0])))[0]
    alone = tones - basis @ (basis.conj().T @ tones)
    return places, np.asarray(np.linalg.lstsq(alone, window.Y[0], rcond=None)[0])


def _dirichlet_kernel(places: Array, lines: int) -> ComplexArray:
    """Lines (M, t) of exp(j 2 pi p n / N) over n < N, over N, for N much greater than M: Dirichlet's kernel."""
    away = places - np.arange(lines)[:, None]
    return np.asarray(np.exp(1j * np.pi * away) * np.sinc(away))
