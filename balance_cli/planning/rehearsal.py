"""Rehearsals of planned runs: a record is simulated with the noise of the plan, and its spectra are estimated.

Where the acquisition samples much faster than the band of a sweep asks for, the rehearsal has a lower rate: lines,
periods and the density of the noise are those of the record, and with them all that a sweep tells.
"""

from __future__ import annotations

import math
from dataclasses import replace

from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.planning.channel_noise import ChannelNoise
from balance_cli.planning.hall import SAMPLES_PER_CYCLE
from balance_cli.simulation.plans import AnyPlan, SweepPlan
from balance_cli.simulation.signal_store import SignalStore

WHOLE = 1e-6
"""Samples of a period that are no more than this beside a whole number are it: rounding of `period` times the rate."""


def rehearse(plan: AnyPlan, store: SignalStore, noise: ChannelNoise, seed: int) -> Spectra:
    """Return the spectra of a planned run with its means and waveforms, as a diagnosis computes them.

    Raises UserError where the record has no usable lines.
    """
    record = store.record(*lower_sample_rate(plan, noise), seed)
    return measured_spectra([record], store.rig.geometry, means=True)


def lower_sample_rate(plan: AnyPlan, noise: ChannelNoise) -> tuple[AnyPlan, ChannelNoise]:
    """Return a sweep with SAMPLES_PER_CYCLE at the end of its band, and noise of the same density [V2/Hz] at that rate.

    At five samples squares and cubes of lines up to the end f of the band have no alias within it (5 f - 3 f > f).
    A multisine alone, of whole samples in a period, has nothing above its band; other runs stay as they are.
    """
    if not isinstance(plan, SweepPlan) or plan.excitation != "multisine":
        return plan, noise
    samples = plan.period * plan.sample_rate
    fewer = 2 * math.ceil(0.5 * SAMPLES_PER_CYCLE * plan.band[1] * plan.period)
    if fewer >= samples or abs(samples - round(samples)) > WHOLE:
        return plan, noise
    factor = math.sqrt(fewer / samples)
    scaled = noise.scale_by(factor)
    return (
        plan.model_copy(update={"sample_rate": fewer / plan.period}),
        # Rounding is white, too; its density falls with the rate like that of any noise.
        replace(scaled, quantum=scaled.quantum * factor),
    )
