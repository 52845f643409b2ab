"""What a fit found against what was declared: each parameter, and all together, in units of the declared tolerances.

A declared value with its tolerance is data too. With a Gaussian prior of covariance P0 and a posterior of covariance P,
the shift of the estimate from the declared value has the covariance P0 - P where prior and data agree (Evans and
Moshonov, Bayesian Analysis 1, 2006, 893: check for prior-data conflict). A parameter of which the data say nothing does
not shift and cannot disagree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

FAMILYWISE_P_VALUE = 0.002
"""Probability that any parameter of a model that is as declared is listed: a fifth of the 1 % of false alarms that a
verdict of `diagnose` may have, as it rests on other tests, too."""
INFORMED_SHARE = 0.05
"""Share of the declared variance that the data must remove before a shift is tested: below it rounding decides."""


@dataclass(frozen=True)
class Departure:
    """A parameter that departs from its tolerance: `declared` and `found` in `unit`, `sigmas` apart."""

    name: str
    unit: str
    declared: float
    found: float
    sigmas: float

    @property
    def description(self) -> str:
        """The departure in words."""
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.name} is {self.found:.4g}{unit}, declared as {self.declared:.4g}{unit}: "
            f"{abs(self.sigmas):.1f} standard deviations of its tolerance"
        )


@dataclass(frozen=True)
class DeclaredAgreement:
    """The departures, largest first, and the chi-square of all shifts together with its degrees of freedom."""

    departures: tuple[Departure, ...]
    chi2: float
    dof: int

    @property
    def p_value(self) -> float:
        """Probability of so large a chi-square where everything is as declared."""
        return float(stats.chi2.sf(self.chi2, self.dof)) if self.dof else 1.0


def declared_agreement(model: IdentifiedModel) -> DeclaredAgreement:
    """Compare the parameters of a fit with their declared values and tolerances.

    Parameters without a tolerance, or with an infinite one (effects), are not compared. A computed model agrees by
    construction.
    """
    table = model.parameters
    tested = (table.declared_sigma > 0) & np.isfinite(table.declared_sigma)
    scale = np.where(tested, table.declared_sigma, 1.0)
    shift = (table.value - table.declared) / scale
    removed = np.eye(len(shift)) - model.covariance / np.outer(scale, scale)
    variance = np.diag(removed)
    tested &= variance > INFORMED_SHARE
    if not model.iterations or not tested.any():
        return DeclaredAgreement((), 0.0, 0)
    sigmas = np.where(tested, shift / np.sqrt(np.where(tested, variance, 1.0)), 0.0)
    limit = stats.norm.isf(0.5 * FAMILYWISE_P_VALUE / int(tested.sum()))
    far = sorted(np.flatnonzero(np.abs(sigmas) > limit), key=lambda i: -abs(sigmas[i]))
    departures = tuple(
        Departure(table.names[i], table.units[i], float(table.declared[i]), float(table.value[i]), float(sigmas[i]))
        for i in far
    )
    chi2, dof = _joint_chi2(shift[tested], removed[np.ix_(tested, tested)])
    return DeclaredAgreement(departures, chi2, dof)


def _joint_chi2(shift: Array, covariance: Array) -> tuple[float, int]:
    """Return chi-square and degrees of freedom of a shift whose covariance may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    known = values > INFORMED_SHARE
    return float(np.sum((vectors.T @ shift)[known] ** 2 / values[known])), int(known.sum())
