"""Runs that are one record under several names: counted twice, it would know everything better than it does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from balance_cli.campaign.recording.run import Run
from balance_cli.diagnosis.consistency.findings import COPIED_RECORD, FAULT, ConsistencyFinding

COMPARED_SAMPLES = 4096
"""Samples at the start of two runs that are compared: noise makes the last digits of a few differ."""
FEWEST_SAMPLES = 5
"""Samples that differ from the first one, from which two records do not agree in every digit by accident."""


def copied_record_findings(runs: Sequence[Run]) -> tuple[ConsistencyFinding, ...]:
    """Return a fault for each static run or sweep whose samples are those of a run before it in every digit."""
    first: dict[tuple[object, ...], str] = {}
    findings = []
    for run in runs:
        if run.kind not in ("static", "sweep") or not run.has_loads:
            continue
        block = run.read(0, min(run.samples, COMPARED_SAMPLES))
        assert block.loads is not None
        if np.count_nonzero(np.any(block.channels != block.channels[0], axis=1)) < FEWEST_SAMPLES:
            continue
        record = run.kind, run.samples, run.channel_names, block.channels.tobytes(), block.loads.tobytes()
        if record not in first:
            first[record] = run.name
            continue
        text = f"all samples are those of {first[record]} in every digit: one record under two names,"
        findings.append(ConsistencyFinding(COPIED_RECORD, FAULT, text, (run.name,)))
    return tuple(findings)
