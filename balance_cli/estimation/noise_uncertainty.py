"""How well a variance by noise is known whose parts were estimated from few readings.

The noise of the channels of a static run is known from the rows in which no noise of a load hides it, and in some
combinations of channels these are few.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.run_spectrum import NoisePart

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SCORES_AT_ONCE = 64
"""Scores whose combinations of channels are compared at once: a few megabytes."""
SHARE_DIGITS = 6
"""Digits to which shares of parts are equal: lines of one load series differ by rounding."""


def noise_uncertainty(parts: Sequence[NoisePart], influence: ComplexArray) -> Array:
    """Return the relative variance (n,) of the estimated variance of n scores.

    `influence` (k, c, n) of c channels at k lines on the scores.
    """
    starts = range(0, influence.shape[2], SCORES_AT_ONCE)
    blocks = [_uncertainty_of_parts(parts, influence[:, :, start : start + SCORES_AT_ONCE]) for start in starts]
    return np.concatenate(blocks) if blocks else np.zeros(0)


def line_uncertainty(parts: Sequence[NoisePart], influence: ComplexArray) -> Array:
    """Return the same (k,) of the scores that single lines make, line by line with `influence` (k, c)."""
    power = np.array([_line_power(influence[:, :, None], part.shape)[:, 0] for part in parts])
    share = np.array([part.share for part in parts])
    return _relative_variance(parts, power[:, None], share[:, None])


def _uncertainty_of_parts(parts: Sequence[NoisePart], influence: ComplexArray) -> Array:
    """Relative variance (n,) of the estimated variance of n scores with this `influence` (k, c, n) of the channels."""
    power = np.array([_line_power(influence, part.shape) for part in parts])
    return _relative_variance(parts, power, np.array([part.share for part in parts])[:, :, None])


def _relative_variance(parts: Sequence[NoisePart], power: Array, share: Array) -> Array:
    """The same from the `power` (j, k, n) and `share` (j, k, n or 1) of each part at the k lines of each score."""
    size, error = (np.array([getattr(part, name) for part in parts]) for name in ("size", "error"))
    by_part = np.sum(share * power, axis=1)
    total = np.maximum(size @ by_part, np.finfo(float).tiny)
    relative = error[:, None] * by_part / total
    every = np.array([part.share for part in parts])
    return np.asarray(np.sum(relative**2 * _concentration(size[:, None, None] * power, share, every), axis=0))


def _concentration(noise: Array, share: Array, every: Array) -> Array:
    """How many times larger (j, n) the variance of each part's estimate is, since few lines show it in these scores.

    `noise` (j, k, n): of each of j parts, where its share is one, in the combination of channels that a score takes at
    each of its k lines, where its `share` is (j, k, n or 1); `every` (j, l): its share at all lines of the run. A line
    l informs about a part in the combination of line k by the square of the part in all noise of that combination at l.
    With these weights w, of sum one over l, and the part p = share * noise,

        factor = K sum_l (sum_k p_k w_lk)^2 / (sum_k p_k)^2 :

    one where all K lines of a part tell the same, and 6 where it is seen beside the noise of loads in a sixth of them.
    """
    tiny = np.finfo(float).tiny
    patterns, lines = np.unique(every.round(SHARE_DIGITS), axis=1, return_counts=True)
    total = np.maximum(np.einsum("jg,jkn->gkn", patterns, noise), tiny)
    factors = []
    for part, pattern, own_share, shares in zip(noise, patterns, share, every, strict=True):
        information = (pattern[:, None, None] * part / total) ** 2
        weight = information / np.maximum(np.einsum("g,gkn->kn", lines, information), tiny)
        own = own_share * part
        shown = np.einsum("kn,gkn->gn", own, weight)
        count = np.sum(shares) ** 2 / max(float(np.sum(shares**2)), tiny)
        factors.append(count * (lines @ shown**2) / np.maximum(own.sum(axis=0) ** 2, tiny))
    return np.maximum(factors, 1.0)


def _line_power(influence: ComplexArray, shape: Array) -> Array:
    """g* shape g of an influence (k, c, n) at each line: (k, n)."""
    parts = np.ascontiguousarray(influence).view(float)  # real and imaginary parts in turn: a product of real matrices
    power = np.einsum("kcn,kcn->kn", parts, shape @ parts)
    return np.asarray(power[:, ::2] + power[:, 1::2])
