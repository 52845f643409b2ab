"""Whether the loads of a multisine repeat with its stated period."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.signals.run_samples import sample_rate

MOST_SAMPLES = 2**18
"""From the end of a record. Where that is less than two periods, nothing is compared."""
LEAST_REPETITION = 0.5
"""Correlation of the loads with those a period before: 1 for a multisine, 0.9 with noise of a tenth of its power.

It is 0.7 where the period falls between two samples and the highest line is at a quarter of the sample rate.
"""
FOUND_REPETITION = 0.8
"""Correlation from which another period is named."""
SEARCHED = (0.5, 2.1)
"""Periods that are tried, over the stated one: `sample_rate` or `period` wrong by up to a factor of two."""


def period_faults(run: Run) -> Iterator[UserError]:
    """Yield a fault where the loads of a multisine do not repeat after its `period`, with the time after which they do.

    Records of less than two periods show none.
    """
    if run.kind != "sweep" or run.excitation != "multisine" or not run.period or not run.has_loads:
        return
    rate = sample_rate(run)
    stated = run.period * rate
    samples = min(run.samples, MOST_SAMPLES)
    if 2.0 * stated > samples:
        return
    repetition = _repetition(run, samples)
    lag = round(stated)
    if repetition[lag - 1 : lag + 2].max() >= LEAST_REPETITION:
        return
    first, last = (min(round(share * stated), len(repetition) - 1) for share in SEARCHED)
    best = first + int(np.argmax(repetition[first : last + 1]))
    found = f", but after {best / rate:.6g} s" if repetition[best] > FOUND_REPETITION else ""
    fault = f"the loads do not repeat after {run.period:.6g} s{found}"
    yield UserError(fault, run.file, "attribute `period`", "Check `period` and `sample_rate`")


def _repetition(run: Run, samples: int) -> NDArray[np.float64]:
    """Return the correlation (samples/2 + 2,) of the excited loads with themselves, by samples of delay."""
    loads = run.read(run.samples - samples).loads
    assert loads is not None
    excited = np.nan_to_num(loads[:, [COMPONENTS.index(name) for name in run.excited]])
    excited = excited - excited.mean(axis=0)
    size = next_fast_len(2 * samples, real=True)
    power = np.abs(rfft(excited, size, axis=0)) ** 2
    products = irfft(power, size, axis=0)[: samples // 2 + 2].sum(axis=1)
    overlap = 1.0 - np.arange(len(products)) / samples
    return np.asarray(products / max(products[0], np.finfo(float).tiny) / overlap)
