"""Whether the modes of the balance lie in a run where the model has them: turbulence shows them between the harmonics.

The residual test compares channels with each other. What more cells than loads read is kinematics, which a mass, a
damping or a stiffness that all cells have in common leaves as it is: with 5 % more mass at the hub, loads of a rig of
eight cells were 138 standard deviations wrong, and chi-square was good. Its modes lay 2 to 8 % lower.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.measured_response import TransferSource
from balance_cli.reduction.operational_modes import ModeShapes, OperationalModes, shapes_of_model
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
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
    """Modes that have moved: `predicted` (m,) [Hz] of the model, relative `departure` (m,) and its `sigma` (m,).

    `modes` are all of the run, of which these stand out.
    """

    predicted: Array
    departure: Array
    sigma: Array
    modes: OperationalModes

    def error_share(self, frequency: Array) -> Array:
        """Return the largest share (h,) by which loads at `frequency` (h,) [Hz] are wrong, as far as one mode tells.

        A cell of an oscillator reads f / (1 - r^2 + 2 j zeta r), r the frequency over its own, which has moved by d:
        the load is off by 2 d r^2 / |1 - r^2 + 2 j zeta r|. What moved some modes has moved others: those that do not
        show in the run count as moved by the rms of those that do, and those that hardly do by what they show.
        """
        predicted, known = self.modes.predicted, np.isfinite(self.modes.frequency)
        departure = np.where(known, self.modes.frequency / predicted - 1.0, 0.0)
        departure = np.where(known, departure, np.sqrt(np.mean(departure[known] ** 2)))
        r = frequency[:, None] / predicted
        share = 2.0 * np.abs(departure) * r**2 / np.abs(1.0 - r**2 + 2j * self.modes.damping_ratio * r)
        return np.asarray(share.max(axis=1))

    @property
    def sentence(self) -> str:
        """The modes in words, with the likely cause."""
        parts = ", ".join(
            f"{f:.4g} Hz by {100 * d:+.2g} +- {100 * s:.1g} %"
            for f, d, s in zip(self.predicted, self.departure, self.sigma, strict=True)
        )
        return (
            f"turbulence shows that modes lie elsewhere than in the response, that at {parts}: the mass, a stiffness "
            "or the support has changed since the sweeps"
        )


def mode_shapes(record: RotorRecord, source: ResponseSource) -> ModeShapes | None:
    """Return the modes of a response as the live channels of a record read them; None where it does not tell them."""
    if source.system is not None:
        return shapes_of_model(record, source.system)
    if not isinstance(source, TransferSource):
        return None
    from balance_cli.signals.response.response_poles import best_poles

    poles = sorted(best_poles(source.responses), key=lambda item: abs(item[1].s))
    if not poles:
        return None
    volts = np.zeros((len(record.health.live), len(poles)), complex)
    for k, (response, pole) in enumerate(poles):
        place = {name: row for row, name in enumerate(response.channel_names)}
        for row, name in enumerate(record.health.live):
            volts[row, k] = pole.residue[place[name], 0] if name in place else 0.0
    s, sigma = (np.array([getattr(pole, name) for _, pole in poles]) for name in ("s", "sigma"))
    return ModeShapes(s, volts, sigma)


def moved_modes(modes: OperationalModes) -> MovedModes | None:
    """Return the modes that have moved in a run; None where all lie where the response has them, or none shows."""
    known = np.isfinite(modes.frequency)
    predicted = modes.predicted[known]
    departure = modes.frequency[known] / predicted - 1.0
    sigma = np.hypot(modes.sigma[known] / predicted, BIAS)
    if not known.any() or chi2.sf(float(np.sum((departure / sigma) ** 2)), len(departure)) > SIGNIFICANCE:
        return None
    moved = np.abs(departure) > min(SHOWN, float(np.max(np.abs(departure / sigma)))) * sigma * (1.0 - 1e-9)
    return MovedModes(predicted[moved], departure[moved], sigma[moved], modes)
