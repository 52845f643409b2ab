"""What temperature adds to the readings, as a calibration stores it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

RANGE_MARGIN = 0.1
"""Share of the temperatures of the calibration by which others may lie outside: the error of the line stays like it."""

UNKNOWN_EFFECT = 5.0
"""[K] from the calibration or the zero from which an effect that nobody determined counts: gauges that are matched to
the material of a balance change their sensitivity by 0.01 to 0.05 % per kelvin, half of a usual accuracy."""


@dataclass(frozen=True)
class TemperatureTerms:
    """What temperature adds to the readings of c channels, for k load components.

    `coefficients` (1+k, c): zero shift [V/K], then changes of sensitivity [V/(N K), V/(N m K)]; zero for a term that a
    channel does not have, where `t` (1+k, c) is NaN. `covariance` (c, 1+k, 1+k); a channel in which no change of
    sensitivity was seen has the mean squares of those that the calibration allows. Temperatures [degC]: `reference`, at
    which the calibration holds, `lowest` and `highest` of the calibration, and `under_load` (k,) while each load acted.
    """

    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    coefficients: Array
    covariance: Array
    t: Array
    reference: float
    lowest: float
    highest: float
    under_load: Array

    @property
    def is_empty(self) -> bool:
        """Whether no channel depends on temperature."""
        return not np.any(self.coefficients)

    @property
    def spread(self) -> float:
        """Standard deviation [K] of a temperature that is not known: uniform over those of the calibration."""
        return float((self.highest - self.lowest) / np.sqrt(12.0))

    def is_outside(self, temperature: float) -> bool:
        """Whether a temperature [degC] lies outside those of the calibration."""
        margin = RANGE_MARGIN * (self.highest - self.lowest)
        return not self.lowest - margin <= temperature <= self.highest + margin

    def slopes(self, loads: ArrayLike, shift: float = 1.0) -> Array:
        """Change (m, c) [V/K] of the readings at loads (m, k) [N, N m]; `shift`: share of the zero shift."""
        f = np.atleast_2d(np.asarray(loads, float))
        return np.asarray(shift * self.coefficients[0] + f @ self.coefficients[1:])

    def readings(self, temperature: ArrayLike, loads: ArrayLike) -> Array:
        """What temperature adds to the readings (m, c) [V] at temperatures (m,) [degC] and loads (m, k) [N, N m]."""
        return np.asarray((np.asarray(temperature, float)[:, None] - self.reference) * self.slopes(loads))

    def error_variance(self, zero_difference: float, difference: float, loads: Array) -> Array:
        """Variance (c,) [V2] of what temperature adds, by the errors of its coefficients.

        `difference` [K] from the reference acts on the loads (k,); `zero_difference` [K] from the zero that is
        subtracted acts on the zero shift. The sensitivities were measured at the temperatures under load; the error of
        referring them to the reference is part of theirs (`sensitivity_covariance`), and counts once.
        """
        away = self.under_load - self.reference
        further = np.sqrt(np.maximum((difference - away) ** 2 - away**2, 0.0))
        row = np.r_[zero_difference, further * loads]
        return np.asarray(np.einsum("i,cij,j->c", row, self.covariance, row))

    def sensitivity_covariance(self) -> Array:
        """Covariance (c, k, k) of the sensitivities [V/N, V/(N m)] by the error of referring them to the reference."""
        away = self.under_load - self.reference
        return np.asarray(self.covariance[:, 1:, 1:] * away[:, None] * away)

    def names(self, channel: int) -> tuple[str, ...]:
        """Terms of a channel: `T`, `Fx T`."""
        all_names = ("T", *(f"{name} T" for name in self.components))
        return tuple(name for name, value in zip(all_names, self.coefficients[:, channel], strict=True) if value != 0.0)
