"""Which of several explanations comes in where the data cannot tell them apart."""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.model.balance import BalanceModel

INDISTINGUISHABLE_CHI2 = 6.0
"""Chi-square within which two explanations are the same: a log-likelihood of 3."""


def choose_most_linear(models: Sequence[BalanceModel], gains: Sequence[float]) -> int:
    """Number of the one that gains most; of those that gain the same, one with the fewest forces that are not linear.

    An offset and a force that bends can do the same; the one is found in every rig.
    """
    alike = [i for i, gain in enumerate(gains) if gain >= max(gains) - INDISTINGUISHABLE_CHI2]
    return min(alike, key=lambda i: (len(models[i].system().forces), -gains[i]))
