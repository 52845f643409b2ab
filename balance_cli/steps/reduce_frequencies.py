"""Reduction at given frequencies: hub loads of a run at tones that turn with no rotor, or whose pulses are missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.flags import NOT_STEADY
from balance_cli.reduction.reliability import join_harmonics
from balance_cli.reduction.response_sources import ResponseSource, at_rotor_speed
from balance_cli.reduction.result import CheckErrors, RunLoads
from balance_cli.reduction.rotor_record import count_cycles, tone_record
from balance_cli.reduction.tone_frequency import ToneTurn, tone_turn
from balance_cli.reduction.undeclared_mass import join_harmonics_of_masses
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals.rotor.other_lines import LEAST_SEPARATION
from balance_cli.signals.run_samples import sample_rate
from balance_cli.steps.reduce import flag_scale_contradiction, reduce_record

Array = NDArray[np.float64]


def reduce_run_at_frequencies(
    run: Run,
    frequencies: Sequence[float],
    geometry: Geometry,
    calibration: Calibration | None,
    source: ResponseSource,
    zero: ZeroRecord | None,
) -> RunLoads:
    """Reduce a run to its mean loads and to its loads at `frequencies` [Hz], in rising order.

    Row 0 of the result is the mean, row i the i-th frequency; phases count from the first sample. The tones are
    regressed together. Raises UserError where two frequencies are closer than the record resolves, or as `reduce_run`.
    """
    given, source = sorted(set(frequencies)), at_rotor_speed(source, run.rotor_speed)
    resolution = LEAST_SEPARATION * sample_rate(run) / run.samples
    for low, high in pairwise(given):
        if high - low < resolution:
            fault = f"{low:g} and {high:g} Hz are closer than the record resolves, {resolution:.3g} Hz"
            raise UserError(fault, run.file, "--frequencies", "Give one of them")
    parts = []
    for frequency in given:
        others = [f for f in given if f != frequency]
        record = tone_record(run, frequency, others, geometry, source)
        loads = reduce_record(record, geometry, calibration, source, zero)
        loads = _flag_turning(loads, frequency, tone_turn(run, frequency, others, geometry, source))
        parts.append(replace(loads, frequency_hz=np.array([0.0, frequency])))
    return _join_tones(parts)


def _flag_turning(loads: RunLoads, frequency: float, turn: ToneTurn | None) -> RunLoads:
    """Return the loads of a tone flagged where it turns within the record: it has another frequency, or none."""
    if turn is None or not turn.is_significant:
        return loads
    at = frequency + turn.error
    note = (
        f"the tone at {frequency:g} Hz turns by {np.degrees(turn.angle):.2g} +- {np.degrees(turn.sigma):.1g} deg from "
        f"one half of the record to the other: it may be at {at:.6g} Hz, or is not steady"
    )
    return loads.with_flag(NOT_STEADY, note, where=np.arange(len(loads.amplitude))[:, None] > 0)


def with_pulses_at(run: Run, frequency: float) -> Run:
    """Return a run as if a rotor of constant speed `frequency` [Hz] had given a pulse at the first sample.

    Raises UserError where the record holds too few revolutions, or too few samples in each.
    """
    return replace(run, pulse_times=np.arange(count_cycles(run, frequency) + 1) / frequency, rotor_speed=0.0)


def _join_tones(parts: Sequence[RunLoads]) -> RunLoads:
    """Return the mean of the first part, and below it the tone of each."""
    first = parts[0]
    rows = ("frequency_hz", "amplitude", "sigma_cosine", "sigma_sine", "redundancy", "redundancy_limit", "condition")
    stacked: dict[str, Any] = {
        name: np.concatenate([getattr(first, name)[:1], *(getattr(part, name)[1:2] for part in parts)]) for name in rows
    }
    flags = (first.flags[0], *(part.flags[1] for part in parts))
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    interval = (max(part.interval[0] for part in parts), min(part.interval[1] for part in parts))
    unnoticed = join_harmonics([part.unnoticed for part in parts])
    added = join_harmonics_of_masses([part.undeclared_mass for part in parts])
    errors: dict[str, Any] = {"unnoticed": unnoticed, "undeclared_mass": added}
    joined = replace(first, **stacked, **errors, flags=flags, notes=notes, interval=interval)
    return flag_scale_contradiction(replace(joined, check=_join_checks(parts) if first.check is not None else None))


def _join_checks(parts: Sequence[RunLoads]) -> CheckErrors:
    """Return the errors over all tones: each part weighted by the size to which its own error is relative."""
    checks = [part.check for part in parts if part.check is not None]
    applied = np.concatenate([checks[0].applied[:1], *(check.applied[1:2] for check in checks)])
    added = [check.added_variance for check in checks if check.added_variance is not None]
    components = parts[0].components
    size = {name: np.abs(applied[1:, i]) for i, name in enumerate(components)}
    largest = np.array([max(float(size[name][k]) for name in check.load_error) for k, check in enumerate(checks)])
    applied_names, other_names = tuple(checks[0].load_error), tuple(checks[0].interaction)
    return CheckErrors(
        load_error={name: _pooled([check.load_error for check in checks], name, size[name]) for name in applied_names},
        interaction={name: _pooled([check.interaction for check in checks], name, largest) for name in other_names},
        load_noise={name: _pooled([check.load_noise for check in checks], name, size[name]) for name in applied_names},
        interaction_noise={
            name: _pooled([check.interaction_noise for check in checks], name, largest) for name in other_names
        },
        applied=applied,
        added_variance=np.concatenate([added[0][:1], *(each[1:2] for each in added)]),
    )


def _pooled(errors: Sequence[Mapping[str, float]], name: str, size: Array) -> float:
    """Return rms(error) / rms(size) of errors that are relative to `size` (k,) each."""
    absolute = np.array([error.get(name, np.nan) for error in errors]) * size
    return float(np.sqrt(np.nanmean(absolute**2) / np.mean(size**2)))
