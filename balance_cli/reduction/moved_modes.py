"""Whether the modes of the balance lie in a run where the model has them: turbulence shows them between the harmonics.

The residual test compares channels with each other. What more cells than loads read is kinematics, which a mass, a
damping or a stiffness that all cells have in common leaves as it is: with 5 % more mass at the hub, loads of a rig of
eight cells were 138 standard deviations wrong, and chi-square was good. Its modes lay 2 to 8 % lower.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.operational_modes import OperationalModes
from balance_cli.signals.distributions import chi2

Array = NDArray[np.float64]

BIAS = 0.002
"""Relative standard deviation of an eigenfrequency beside its sigma: flanks of neighbors leave 0.001, and the spectrum
of real turbulence is not flat."""
SIGNIFICANCE = 1e-6
"""Probability with which the modes of a sound run depart so far. On runs of three rigs whose mass and stiffness are
those of the model, no mode departs by more than 2.6 sigma."""
SHOWN = 3.0
"""Standard deviations from which a mode is named among those that have moved."""
NOTABLE_SHARE = 0.02
"""Error of a load, as a share of it, from which it is flagged: that of a known load in a check run."""


@dataclass(frozen=True)
class MovedModes:
    """Modes that have moved: `predicted` (m,) [Hz] of the model, relative `departure` (m,) and its `sigma` (m,)."""

    predicted: Array
    departure: Array
    sigma: Array

    def error_share(self, frequency: Array, damping: float = 0.01) -> Array:
        """Return the largest share (h,) by which loads at `frequency` (h,) [Hz] are wrong, as far as one mode tells.

        A cell of an oscillator reads f / (1 - r^2 + 2 j zeta r), r the frequency over its own, which has moved by d:
        the load is off by 2 d r^2 / |1 - r^2 + 2 j zeta r|.
        """
        r = frequency[:, None] / self.predicted
        share = 2.0 * np.abs(self.departure) * r**2 / np.abs(1.0 - r**2 + 2j * damping * r)
        return np.asarray(share.max(axis=1))

    @property
    def sentence(self) -> str:
        """The modes in words, with the likely cause."""
        parts = ", ".join(
            f"{f:.4g} Hz by {100 * d:+.2g} +- {100 * s:.1g} %"
            for f, d, s in zip(self.predicted, self.departure, self.sigma, strict=True)
        )
        return (
            f"turbulence shows that modes lie elsewhere than in the model, that at {parts}: the mass, a stiffness or "
            "the support has changed since the sweeps"
        )


def moved_modes(modes: OperationalModes) -> MovedModes | None:
    """Return the modes that have moved in a run; None where all lie where the model has them, or none shows."""
    known = np.isfinite(modes.frequency)
    predicted = modes.predicted[known]
    departure = modes.frequency[known] / predicted - 1.0
    sigma = np.hypot(modes.sigma[known] / predicted, BIAS)
    if not known.any() or chi2.sf(float(np.sum((departure / sigma) ** 2)), len(departure)) > SIGNIFICANCE:
        return None
    moved = np.abs(departure) > min(SHOWN, float(np.max(np.abs(departure / sigma)))) * sigma * (1.0 - 1e-9)
    return MovedModes(predicted[moved], departure[moved], sigma[moved])
