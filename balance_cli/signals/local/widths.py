"""Windows of a spectrum: where they lie, and how wide they are, which the data decide.

A wide window averages more noise, a narrow one needs fewer poles. Both describe the same data: a window, and its two
halves side by side. A test of the one against the other (`signals.local.selection`) decides, and what it halves is
examined again. Windows without poles have none to spare, and remain. Bandwidths follow the
data in this way in Fan and Gijbels, J. R. Stat. Soc. B 57 (1995) 371.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.local.selection import Descriptions, is_preferred
from balance_cli.signals.local.window import WindowFit

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class WindowLayout:
    """Windows of `lines` lines. Window w begins at line `first[w]`, and is used for `assigned_lines[w]` (from, to)."""

    first: Index
    assigned_lines: Index
    lines: int

    @property
    def index(self) -> Index:
        """The lines (W, M) of each window."""
        return np.asarray(self.first[:, None] + np.arange(self.lines))

    def subset(self, windows: Mask) -> WindowLayout:
        """Return the selected windows."""
        return replace(self, first=self.first[windows], assigned_lines=self.assigned_lines[windows])

    def halved(self, total: int) -> WindowLayout:
        """Return windows half as wide for the same assigned lines, of a spectrum of `total` lines."""
        hop = self.lines // 6
        start = (self.assigned_lines[:, :1] + [0, hop]).ravel()
        stop = np.minimum(start + hop, np.repeat(self.assigned_lines[:, 1], 2))
        return _windows_about(np.stack([start, stop], axis=1)[start < stop], hop, self.lines // 2, total)


@dataclass(frozen=True)
class FittedWindows:
    """Fitted windows of any widths in the order of the lines (W, 2) for which they are used; `first` (W,) as above."""

    first: Index
    assigned_lines: Index
    fit: tuple[WindowFit, ...]


Fitter = Callable[[WindowLayout], tuple[tuple[WindowFit, ...], Descriptions]]
"""Fits windows, and returns the fits with what they leave of the data."""


def sliding_windows(total: int, lines: int, hop: int) -> WindowLayout:
    """Return windows of `lines` of `total` lines, each of which is used for `hop` lines in its middle.

    At the edges they are shifted inward.
    """
    start = np.arange(0, total, hop)
    return _windows_about(np.stack([start, np.minimum(start + hop, total)], axis=1), hop, lines, total)


def _windows_about(assigned_lines: Index, hop: int, lines: int, total: int) -> WindowLayout:
    return WindowLayout(np.clip(assigned_lines[:, 0] + hop // 2 - lines // 2, 0, total - lines), assigned_lines, lines)


class _Windows:
    """Windows fitted so far: the halves of one window are the narrower windows of its neighbors."""

    def __init__(self, fit: Fitter) -> None:
        self._fit = fit
        self._kept: dict[tuple[int, int], tuple[WindowFit, Descriptions]] = {}

    def fitted(self, first: Index, lines: int) -> list[tuple[WindowFit, Descriptions]]:
        """Return the fits of windows of so many lines."""
        new = np.array(sorted({start for start in first.tolist() if (start, lines) not in self._kept}), np.intp)
        if new.size:
            fits, left = self._fit(WindowLayout(new, np.stack([new, new + lines], axis=1), lines))
            for w, start in enumerate(new.tolist()):
                self._kept[start, lines] = fits[w], left.subset(np.array([w]))
        return [self._kept[start, lines] for start in first.tolist()]

    def divided(self, layout: WindowLayout) -> Mask:
        """Return the windows (W,) whose two halves are preferred."""
        whole, half = self.fitted(layout.first, layout.lines), layout.lines // 2
        with_poles = np.flatnonzero([fit.orders.denominator > 0 for fit, _ in whole])
        first = layout.first[with_poles]
        halves = zip(self.fitted(first, half), self.fitted(first + half, half), strict=True)
        result = np.zeros(len(whole), bool)
        result[with_poles] = [
            bool(is_preferred(below + above, whole[w][1])[0])
            for w, ((_, below), (_, above)) in zip(with_poles, halves, strict=True)
        ]
        return result


def fit_best_widths(layout: WindowLayout, fit: Fitter, least: int, total: int) -> FittedWindows:
    """Fit windows, and halve those whose two halves are better, as long as the halves have `least` lines."""
    windows = _Windows(fit)
    done: list[tuple[int, tuple[int, int], WindowFit]] = []
    while layout.first.size:
        divided = windows.divided(layout) if layout.lines // 2 >= least else np.zeros(len(layout.first), bool)
        kept = layout.subset(~divided)
        fits = [one for one, _ in windows.fitted(kept.first, kept.lines)]
        done += zip(kept.first.tolist(), map(tuple, kept.assigned_lines.tolist()), fits, strict=True)
        layout = layout.subset(divided).halved(total)
    first, assigned_lines, used = zip(*sorted(done, key=lambda one: one[1]), strict=True)
    return FittedWindows(np.array(first), np.array(assigned_lines), used)
