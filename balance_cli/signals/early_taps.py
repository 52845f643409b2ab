"""Hammer records whose taps are all at the start, as a trigger records them, and the rest that was before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.run import Array, MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals.impact import GAUSSIAN, HIT_SHARE, WINDOW_SIGMAS, ZERO_SHARE, combined_hits, hammer_loads

EARLY_SHARE = 0.1
"""Of the record: a response to taps within it hardly differs from a transient of the start, whose spectrum is as
smooth. Of a mode with 1 % of damping and noise of 0.1 % the response is off by 7 % with a tap at 0.02 of the record,
and by 0.1 % from 0.05 on."""
REST_SHARE = 0.02
"""Of the largest response, by which a channel at rest before the taps may differ from its end."""
END_SHARE = 0.2
"""Of the record, the end, whose median is the reading at rest."""


def prepend_rest(run: Run) -> Run:
    """Put samples at rest before a hammer record whose taps are all at its start; the same run for any other.

    A local model cannot tell the response to such taps from the vibration that was there before. Where the record shows
    a rig at rest before the first tap, it was so earlier too, and the tap is moved away from the start. A record stays
    as it is where the rig was not at rest.

    Raises UserError where the record begins within a tap.
    """
    hits = hammer_loads(run)
    if hits is None or run.bridged:
        return run
    size = combined_hits(hits)
    struck = np.flatnonzero(size > max(ZERO_SHARE, WINDOW_SIGMAS * GAUSSIAN * float(np.median(size))))
    if struck[-1] >= EARLY_SHARE * run.samples:
        return run
    if size[0] > HIT_SHARE:
        fault = "the record begins within a tap of the hammer: a part of its force is missing"
        remedy = "Record with a trigger that keeps some samples before the tap"
        raise UserError(fault, run.file, "loads", remedy)
    block = run.read()
    rest = _rest(block.channels, max(int(struck[0]), 1))
    if rest is None or block.loads is None:
        return run
    more = int(np.ceil(EARLY_SHARE * run.samples))
    channels = np.vstack([np.tile(rest, (more, 1)), block.channels])
    loads = np.vstack([np.tile(np.median(block.loads, axis=0), (more, 1)), block.loads])
    return replace(run, samples=len(channels), source=MemorySource(channels, loads), pulse_times=None)


def _rest(channels: Array, before: int) -> Array | None:
    """Readings at rest (c,) of channels (n, c), from the samples before a tap; None where the rig was not at rest."""
    finite = np.isfinite(channels).all(axis=0)
    quiet = channels[:before].mean(axis=0)
    used = channels[:, finite]
    end = used[-max(int(END_SHARE * len(used)), 1) :]
    late = np.median(end, axis=0)
    off = np.max(np.abs(used[:before] - late), axis=0)
    limit = REST_SHARE * np.max(np.abs(used - late), axis=0) + _noise_of(end)
    return quiet if np.all(off <= limit) else None


def _noise_of(channels: Array) -> Array:
    """Largest noise (c,) to expect of channels (n, c), from the differences of neighboring samples."""
    if len(channels) < 2:
        return np.zeros(channels.shape[1])
    return np.asarray(WINDOW_SIGMAS * GAUSSIAN * np.median(np.abs(np.diff(channels, axis=0)), axis=0))
