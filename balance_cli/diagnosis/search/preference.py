"""Choice among explanations that the data cannot distinguish."""

from __future__ import annotations

from collections.abc import Sequence


def choose_most_linear(nonlinear_terms: Sequence[int], gains: Sequence[float], tolerance: float) -> int:
    """Return the index of the model with the fewest nonlinear terms among those within `tolerance` of the best gain.

    `nonlinear_terms` and `gains` are those of each model. An offset and a nonlinear force can have the same effect on
    the data, and every rig has offsets. Among models with equally many terms the one with the largest gain is chosen.
    """
    equivalent = [i for i, gain in enumerate(gains) if gain >= max(gains) - tolerance]
    return min(equivalent, key=lambda i: (nonlinear_terms[i], -gains[i]))
