"""From runs to the data of the estimators: lines of the sweeps and points of the static runs, with their noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.placed_effects import needs_mean
from balance_cli.signals.channel_shares import add_channel_shares
from balance_cli.signals.early_taps import prepend_rest
from balance_cli.signals.impact import use_hammer_record
from balance_cli.signals.local.nonperiodic_spectrum import nonperiodic_spectrum
from balance_cli.signals.nyquist_noise import RunNoise, UsualNoise, measure_nyquist_noise, usual_noise
from balance_cli.signals.periodic import has_whole_periods, periodic_record
from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints
from balance_cli.signals.single_force import single_force
from balance_cli.signals.static_noise import static_points
from balance_cli.signals.transient_decay import FEWEST_PERIODS
from balance_cli.signals.waveforms import (
    append_mean_and_waveform,
    nonperiodic_spectrum_with_waveform,
)


@dataclass(frozen=True)
class Spectra:
    """Lines and static points of a campaign.

    `unused` {run: why}: runs that an identification cannot use; `channels_left_out` {run: {channel: why}}: channels
    that were dead, clipped, absent or not finite. `usual_noise`: of the channels near half the sample rate, which the
    sweeps have in common. `responses`: names of those lines that are measured responses.
    """

    lines: tuple[RunSpectrum, ...]
    statics: tuple[StaticPoints, ...]
    unused: dict[str, str]
    channels_left_out: dict[str, dict[str, str]]
    usual_noise: tuple[UsualNoise, ...] = ()
    responses: tuple[str, ...] = ()

    def in_band(self, band: tuple[float, float] | None) -> Spectra:
        """Return the spectra without the lines outside a band [Hz]; means and static points stay.

        Raises UserError where no line of a sweep is left.
        """
        if band is None:
            return self
        kept = tuple(_lines_in_band(run, band) for run in self.lines)
        lines = tuple(run for run in kept if np.any(run.frequency > 0))
        if self.lines and not lines:
            fault = f"no line of the sweeps lies between {band[0]:g} and {band[1]:g} Hz"
            raise UserError(fault, "--band", remedy="Give a band that the sweeps excite")
        return replace(self, lines=lines)


def measured_spectra(runs: Iterable[Run], geometry: Geometry, means: bool | None = None) -> Spectra:
    """Compute lines of every sweep and points of every static run; all other runs are listed as unused.

    A static run with too few rows to estimate its own noise is unused too: the sweeps suffice without it. Periodic
    records give the lines of their steady periods; others, and two periods with a transient, the independent lines of a
    local rational model. With `means`
    (by default, where an effect of the geometry needs them) records also give their means and waveforms, and static
    runs the nonlinear part of their rows. Raises UserError where a run has no usable channel.
    """
    means = needs_mean(geometry) if means is None else means
    lines: list[RunSpectrum] = []
    statics: list[StaticPoints] = []
    unused: dict[str, str] = {}
    left_out: dict[str, dict[str, str]] = {}
    levels: list[RunNoise | None] = []
    for run in runs:
        if run.kind not in ("sweep", "static"):
            unused[run.name] = f"a {run.kind} run is not used in a fit"
            continue
        health = live_channels(run, geometry)
        if health.left_out:
            left_out[run.name] = health.left_out
        if not health.live and not health.left_out:
            unused[run.name] = "no channel measures at rest"
            continue
        if not health.live:
            raise UserError("no usable channel", run.file, "channels", "Repair this run or leave it out")
        if run.kind == "static":
            try:
                points = static_points(run, health.live)
                statics.append(add_channel_shares(points, geometry) if means else points)
            except UserError as error:
                unused[run.name] = error.fault
        else:
            lines.append(_sweep_lines(run, health.live, geometry, means))
            levels.append(measure_nyquist_noise(run, geometry.channel_names))
    common = usual_noise(levels, geometry.channel_names)
    return Spectra(tuple(lines), tuple(statics), unused, left_out, common)


def _sweep_lines(run: Run, channel_names: tuple[str, ...], geometry: Geometry, means: bool) -> RunSpectrum:
    run = prepend_rest(use_hammer_record(run))
    force = single_force(run)
    if force is not None:
        return force.expand(_sweep_lines(force.run, channel_names, geometry, means))
    record = periodic_record(run, channel_names) if has_whole_periods(run) else None
    # The model itself describes what three and more periods contain of a transient; two do not tell its noise.
    if record is not None and not (record.rings and record.periods < FEWEST_PERIODS):
        return append_mean_and_waveform(run, record.spectrum, geometry) if means else record.spectrum
    if means:
        return nonperiodic_spectrum_with_waveform(run, channel_names, geometry)
    return nonperiodic_spectrum(run, channel_names)


def _lines_in_band(run: RunSpectrum, band: tuple[float, float]) -> RunSpectrum:
    """The mean and the lines inside the band; the same object where all are."""
    keep = (run.frequency == 0) | ((run.frequency >= band[0]) & (run.frequency <= band[1]))
    return run if keep.all() else run.select(keep)
