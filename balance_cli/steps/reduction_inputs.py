"""What a reduction checks and prepares before its first run, and how it reports a reduction in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_digest
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.errors import UserError
from balance_cli.reduction.coarse_zero import coarse_zero, join_zeros
from balance_cli.reduction.loaded_zero import describe_loaded_zero
from balance_cli.reduction.measured_response import highest_frequency
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import RunLoads, TimeDomainResult
from balance_cli.reduction.wind_off import ZeroRecord, zero_record
from balance_cli.signals.rotor.harmonics import BELOW_NYQUIST
from balance_cli.signals.rotor.other_rotors import rotor_azimuth

if TYPE_CHECKING:
    from balance_cli.steps.reduce_in_time import TimeOptions, TimeReduction

LEAST_HARMONICS = 8
"""Harmonics 1 to 8 are compared in check runs, as the file contract has it."""
BLADE_MULTIPLES = 2
"""Multiples of the blade harmonic that are reduced at least: the second drives the cabin noise of a helicopter."""


FASTER_THAN_PULSES = 2.0
"""Speed of the rotor over the rate of its closest pulses, at most: pulses beside a missing one lie farther apart, and
between two pulses the speed departs by a few per cent from their rate. Within the band no spline is then needed."""


def default_harmonics(geometry: Geometry) -> int:
    """Return how many harmonics are reduced if nobody asks: whole multiples of the blades, at least two, at least 8.

    8 for two or four blades, 9 for three, 10 for five, 12 for six.
    """
    blades = geometry.rotor.blades if geometry.rotor else 1
    return blades * max(BLADE_MULTIPLES, ceil(LEAST_HARMONICS / blades))


def harmonics_within_band(run: Run, source: ResponseSource, harmonics: int, rotor: int = 1) -> int:
    """Return how many harmonics of a rotor lie below half the sample rate of a run and within the measured response."""
    if run.sample_rate is None:
        return harmonics
    highest = min(BELOW_NYQUIST * run.sample_rate / 2.0, highest_frequency(source))
    if rotor == 1 and harmonics * FASTER_THAN_PULSES * _fastest_pulse_rate(run) < highest:
        return harmonics
    try:
        azimuth = rotor_azimuth(run, rotor)
    except UserError:
        return harmonics  # the reduction reports it
    fastest = float(np.max(azimuth.speed(np.linspace(azimuth.first, azimuth.last, 2048))))
    return max(1, min(harmonics, int(highest / fastest)))


def fewer_harmonics_warning(name: str, harmonics: int, wanted: int) -> str:
    """Return that a run permits fewer harmonics than those wanted, in words."""
    return f"{name}: {harmonics} harmonics in place of {wanted}: those above are beyond its band"


def _fastest_pulse_rate(run: Run) -> float:
    """Return the rate [Hz] of the closest pulses, or the declared speed where that is higher; inf without pulses."""
    if run.pulse_times is None or len(run.pulse_times) < 2:
        return float("inf")
    closest = float(np.min(np.diff(run.pulse_times)))
    return max(1.0 / closest, run.rotor_speed) if closest > 0 else float("inf")


def require_same_geometry(geometry: Geometry, calibration: Calibration, file: str = "") -> None:
    """Raise UserError where the geometries of a response and a calibration differ in more than their effects."""
    digests = {geometry_digest(item.model_copy(update={"effects": ()})) for item in (geometry, calibration.geometry)}
    if len(digests) > 1:
        raise UserError(
            f"was made from another geometry (`{geometry.name}`) than the calibration (`{calibration.geometry.name}`)",
            file,
            "geometry",
            "Make both from the same geometry file",
        )
    if not load_components(calibration.geometry).are_hub_loads:
        names = ", ".join(load_components(calibration.geometry).names)
        fault = f"has the components {names}, where hub loads are needed"
        raise UserError(fault, "calibration", remedy="Calibrate with Fx to Mz; `apply` gives loads of other components")


def zero_reference(zeros: Sequence[Run], calibration: Calibration, record: Run | None = None) -> ZeroRecord | None:
    """Return the wind-off record that mean loads count from, None without one.

    Where too few channels move in it, a check or wind `record` shows whether it is the converter that is coarse. Raises
    UserError for several runs, for a run of another kind, and where too few channels of means can be used.
    """
    _require_one_zero(zeros)
    if not zeros:
        return None
    run, place = zeros[0], zeros[0].file
    health = live_channels(run, calibration.geometry)
    dc_channels = [channel.name for channel in calibration.geometry.channels if channel.measures_dc]
    live = [name for name in dc_channels if name in health.live]
    least = min(len(next(iter(calibration.trims.values())).components), len(dc_channels))
    if len(live) < least:
        others = [name for name in dc_channels if name not in live]
        coarse = None if record is None else coarse_zero(run, record, others)
        if coarse is not None and len(live) + len(coarse.channel_names) >= least:
            return join_zeros(zero_record(run, live), coarse)
        reasons = "; ".join(f"{name}: {reason}" for name, reason in health.left_out.items() if name in dc_channels)
        usable = (
            f"{len(live)} of {len(dc_channels)} strain and torque channels" if live else "no strain or torque channel"
        )
        fault = f"{usable} can be used ({reasons})"
        remedy = "Leave the run out: mean loads then count from the zero of the calibration"
        raise UserError(fault, place, "channels", remedy)
    return zero_record(run, live)


def compared_zero(zeros: Sequence[Run], calibration: Calibration, record: Run) -> tuple[ZeroRecord | None, str]:
    """Return `zero_reference`, and a warning: in its place where a check or wind `record` shows it to be loaded.

    The warning also names channels of means that the zero run alone lacks, without which the loads are computed.
    """
    _require_one_zero(zeros)
    loaded = loaded_zero_warning(zeros, record)
    if loaded:
        return None, loaded
    zero = zero_reference(zeros, calibration, record)
    return zero, "" if zero is None else _lost_channels_warning(zeros[0], zero, calibration)


def _lost_channels_warning(run: Run, zero: ZeroRecord, calibration: Calibration) -> str:
    """Return that mean loads do without channels that cannot be used in the zero run; empty where there are none."""
    used = [name for trim in calibration.trims.values() for name in trim.channel_names]
    lost = [name for name in dict.fromkeys(used) if name not in zero.channel_names]
    if not lost:
        return ""
    reasons = live_channels(run, calibration.geometry).left_out
    words = ", ".join(f"{name} ({reasons.get(name, 'not read')})" for name in lost)
    return f"mean loads do without {words} of {run.file or run.name}"


def _require_one_zero(zeros: Sequence[Run]) -> None:
    """Raise UserError for several runs, and for a run of another kind."""
    if len(zeros) > 1:
        names = ", ".join(run.name for run in zeros)
        raise UserError(f"more than one zero run: {names}", "RUN...", remedy="Choose one with --zero")
    for run in zeros:
        if run.kind != "zero":
            remedy = "Give a wind-off record of kind `zero`"
            raise UserError(f"is a {run.kind} run", run.file, "attribute `kind`", remedy)


def loaded_zero_warning(zeros: Sequence[Run], record: Run) -> str:
    """Return that the zero run was made under load, as a wind or check `record` shows; empty where it does not."""
    loaded = describe_loaded_zero(zeros[0], record) if zeros else ""
    if not loaded:
        return ""
    run = zeros[0]
    return f"{run.file or run.name} is no wind-off record and is not used: {loaded}; mean loads have no zero"


def loads_with_filter_tests(time_reduction: TimeReduction, options: TimeOptions) -> RunLoads:
    """Return the loads with the tests of the filter; a channel that was lost only for a time is not left out."""
    in_time = TimeDomainResult(
        load_model=options.load_model,
        lag=None if options.smooth else options.lag,
        innovations=time_reduction.innovations,
        track=time_reduction.track,
        noise=time_reduction.noise,
        gap_notes=time_reduction.gap_notes,
    )
    loads = time_reduction.loads
    left_out = {name: reason for name, reason in loads.left_out.items() if name not in time_reduction.noise}
    return replace(loads, in_time=in_time, left_out=left_out)
