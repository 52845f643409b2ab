"""Steady tones in a record, such as the mains: kept apart from the transient that local models take out.

The lines of a tone that lasts are those of a transient that does not decay: a local model would spend a pole on it, on
the axis, and take it out with the transient. No mode of a structure has a pole there. So where a fit puts one, the tone
becomes an input of its own, whose lines are known, and what that input explains is kept apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.local_fit import Windows
from balance_cli.signals.local_window import WindowFit, design, poles

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Distance of a pole from the axis, in lines: a mode of 50 Hz in a record of 10 s has this at a damping ratio of 1e-4.
ON_AXIS = 0.05


def tone_lines(
    windows: Windows,
    fits: Sequence[WindowFit],
    refit: Callable[[Windows], tuple[WindowFit, ...]],
    first: Index,
    owned: Index,
    lines: int,
) -> ComplexArray:
    """What steady tones make of the channels (lines, c), in the windows' units; zero where no fit has such a pole.

    `first` (W,) and `owned` (W, 2) are the windows' first lines and those for which they speak.
    """
    found = np.zeros((lines, windows.Y.shape[2]), complex)
    for w, fit in enumerate(fits):
        places = _on_axis(fit, owned[w] - first[w])
        if places.size:
            here = slice(first[w], first[w] + windows.Y.shape[1])
            found[here] += _explained(windows.subset(np.array([w])), places, refit)
    return found


def _on_axis(fit: WindowFit, owned: Index) -> Array:
    """Places, in lines of the window, of poles on the axis within the lines `owned` (from, to)."""
    half = (len(fit.r) - 1) / 2
    at = half + half * poles(fit)
    tone = (np.abs(at.imag) < ON_AXIS) & (at.real >= owned[0] - 0.5) & (at.real < owned[1] - 0.5)
    return np.asarray(at.real[tone])


def _explained(window: Windows, places: Array, refit: Callable[[Windows], tuple[WindowFit, ...]]) -> ComplexArray:
    """What inputs with the lines of tones at `places` explain of one window's lines (M, c).

    With them as inputs the poles are the structure's; beside these each tone has one amplitude in each channel.
    """
    tones = _lines_of_tones(places, window.Y.shape[1])
    (fit,) = refit(replace(window, U=np.concatenate([window.U, tones[None]], axis=2)))
    basis = np.linalg.qr(design(replace(fit, U=window.U[0])))[0]
    alone = tones - basis @ (basis.conj().T @ tones)
    return np.asarray(tones @ np.linalg.lstsq(alone, window.Y[0], rcond=None)[0])


def _lines_of_tones(places: Array, lines: int) -> ComplexArray:
    """Lines (M, t) of exp(j 2 pi p n / N) over n < N, over N, for N much greater than M: Dirichlet's kernel."""
    away = places - np.arange(lines)[:, None]
    return np.asarray(np.exp(1j * np.pi * away) * np.sinc(away))
