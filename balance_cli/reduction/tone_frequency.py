"""Whether a tone has the frequency that was given for it: its phase must not turn from half to half of a record.

A tone that is half a cycle off over the record loses a third of its amplitude, and most of its phase. A search for
lines beside it finds those from one cycle on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.recording.run import Run, excerpt_run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord, tone_record
from balance_cli.signals.distributions import student_widening
from balance_cli.signals.run_samples import sample_rate

SIGNIFICANT_TURN = 5.0
"""Standard deviations of the turn between the halves: loads are off by half as many of theirs."""


@dataclass(frozen=True)
class ToneTurn:
    """Angle [rad] by which a tone turns between the middles of two halves of a record, with sigma; and `error` [Hz]."""

    angle: float
    sigma: float
    error: float

    @property
    def is_significant(self) -> bool:
        """Whether the tone has another frequency, or is none."""
        return abs(self.angle) > SIGNIFICANT_TURN * self.sigma


def tone_turn(
    run: Run, frequency: float, others: Sequence[float], geometry: Geometry, source: ResponseSource
) -> ToneTurn | None:
    """Return the turn of a tone [Hz] in the channel that shows it best; None where a half holds too few cycles.

    `others`: tones that are regressed with it. Noise is common to the channels, so that more of them tell no more.
    """
    middle = run.samples // 2
    try:
        first, second = (
            tone_record(part, frequency, others, geometry, source)
            for part in (excerpt_run(run, 0, middle), excerpt_run(run, middle, run.samples))
        )
    except UserError:
        return None
    names = [name for name in first.health.live if name in second.health.live]
    (a, variance_a), (b, variance_b) = (_amplitudes(part, names) for part in (first, second))
    duration = middle / sample_rate(run)
    turned = b * np.conj(a) * np.exp(-2j * np.pi * frequency * duration)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Half of the noise of an amplitude turns it.
        sigma = np.sqrt(0.5 * (variance_a / np.abs(a) ** 2 + variance_b / np.abs(b) ** 2))
    sigma = np.where(np.isfinite(sigma), sigma, np.inf)
    best = int(np.argmin(sigma))
    angle = float(np.angle(turned[best]))
    return ToneTurn(angle, float(sigma[best]), angle / (2.0 * np.pi * duration))


def _amplitudes(record: RotorRecord, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Complex amplitudes (c,) of the tone in these channels, from the first sample on, and their variance."""
    spectra = record.spectra
    columns = spectra.columns(names)
    variance = np.real(np.diagonal(spectra.covariance[1]))[columns]
    return spectra.amplitude[1, columns], variance * float(student_widening(2.0 * spectra.dof[1]))
