"""Mishaps of a test day: plausible runs that went wrong, through the checks and the chain to the loads.

Each mishap changes the runs of a simulated campaign whose loads are known. The chain is that of the commands: what
is refused, what is warned of, which rows are flagged, and whether the intervals of the other rows cover the loads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import signal

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.gaps import bridge_gaps, describe_gaps
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency.severity import identified_anyway, known_anyway, measured_anyway
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.io.errors import UserError
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.result import RunLoads
from balance_cli.signals.rotor.pulse_consistency import pulse_faults
from balance_cli.simulation import Campaign, draw_rig, simulate_campaign
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.contradicted_loads import compare_static_response, flag_contradicted_runs
from balance_cli.steps.cross_checks import cross_check
from balance_cli.steps.identify import identify
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduction_inputs import zero_reference
from balance_cli.steps.trim_agreement import trim_findings
from studies.clean_campaigns import covered_share, rows_of_run
from tests.support.other_rigs import other_rig, short_campaign

Array = NDArray[np.float64]
Change = Callable[[Run], Run]

REVOLUTIONS, SWEEPS = 60, 40.0
RATE = 800.0
"""[Hz] of the sampled runs."""


def edit(change: Callable[[Array, Run], Array]) -> Change:
    """A change of the channels (n, c) of a run."""

    def apply(run: Run) -> Run:
        block = run.read()
        channels = change(block.channels.copy(), run)
        loads = None if block.loads is None else block.loads[: len(channels)]
        return replace(run, samples=len(channels), source=MemorySource(channels, loads))

    return apply


def edit_loads(change: Callable[[Array], Array]) -> Change:
    """A change of the loads (n, 6) of a run."""

    def apply(run: Run) -> Run:
        block = run.read()
        assert block.loads is not None
        return replace(run, source=MemorySource(block.channels, change(block.loads.copy())))

    return apply


def on(part: str, change: Change) -> Callable[[Sequence[Run]], list[Run]]:
    """The change made to the runs whose names contain `part`."""
    return lambda runs: [change(run) if part in run.name else run for run in runs]


def at(run: Run, name: str) -> list[int]:
    """Columns of the channels whose names end so."""
    return [k for k, channel in enumerate(run.channel_names) if channel.endswith(name)]


def with_columns(name: str, change: Callable[[Array], Array]) -> Change:
    """A change of the channels (n, k) whose names end so."""

    def apply(channels: Array, run: Run) -> Array:
        channels[:, at(run, name)] = change(channels[:, at(run, name)])
        return channels

    return edit(apply)


def exchange(first: str, second: str) -> Change:
    """Two plugs exchanged."""

    def apply(channels: Array, run: Run) -> Array:
        i, j = at(run, first)[0], at(run, second)[0]
        channels[:, [i, j]] = channels[:, [j, i]]
        return channels

    return edit(apply)


def drop_block(run: Run) -> Run:
    """A buffer of 100 samples is lost in the middle, in channels, loads and tachometer alike; zeros fill the end."""
    block, first = run.read(), run.samples // 2
    kept = np.r_[0:first, first + 100 : run.samples]
    pulses = run.pulse_times
    if pulses is not None:
        gone = 100 / RATE
        pulses = np.r_[pulses[pulses < first / RATE], pulses[pulses >= first / RATE + gone] - gone]
    loads = None if block.loads is None else block.loads[kept]
    return replace(run, samples=len(kept), source=MemorySource(block.channels[kept], loads), pulse_times=pulses)


def delay(samples: float) -> Callable[[Array], Array]:
    """Channels that are late by so many samples, whole or not."""

    def apply(x: Array) -> Array:
        frequency = np.fft.rfftfreq(len(x))
        shifted = np.fft.rfft(x, axis=0) * np.exp(-2j * np.pi * frequency * samples)[:, None]
        return np.fft.irfft(shifted, len(x), axis=0)

    return apply


def fast_clock(share: float) -> Callable[[Array], Array]:
    """Channels of a box whose clock is fast."""
    return lambda x: np.stack([np.interp(np.arange(len(x)) * (1 + share), np.arange(len(x)), c) for c in x.T], 1)


def wrap(x: Array) -> Array:
    """Integers of 16 bits that overflow: the range is 80 % of the peak."""
    limit = 0.8 * np.abs(x).max(axis=0)
    return np.mod(x + limit, 2 * limit) - limit


def clip(x: Array) -> Array:
    """Channels that stop at 80 % of their peak."""
    limit = 0.8 * np.abs(x).max(axis=0)
    return np.clip(x, -limit, limit)


def mains(x: Array) -> Array:
    """A broken cable: 50 Hz and noise only."""
    time = np.arange(len(x)) / RATE
    hum = np.sin(2 * np.pi * 50.0 * time) + 0.02 * np.random.default_rng(1).standard_normal(len(x))
    return x.std(axis=0) * hum[:, None]


def spikes(x: Array) -> Array:
    """Ten spikes of ten times the rms."""
    places = np.random.default_rng(2).choice(len(x), 10, replace=False)
    x[places] += 10.0 * x.std(axis=0)
    return x


def low_pass(cutoff: float) -> Callable[[Array], Array]:
    """A filter that was set for another test."""
    b, a = signal.butter(4, cutoff, fs=RATE)
    return lambda x: np.asarray(signal.lfilter(b, a, x, axis=0))


def transfer_moments(loads: Array) -> Array:
    """Moments about the origin of the rig, with the hub 0.78 m above it."""
    loads[:, 3] -= 0.78 * loads[:, 1]
    loads[:, 4] += 0.78 * loads[:, 0]
    return loads


def scaled(factor: float, *names: str) -> Callable[[Array], Array]:
    """Loads (all where none is named) in another unit or direction."""

    def apply(loads: Array) -> Array:
        loads[:, [COMPONENTS.index(name) for name in names or COMPONENTS]] *= factor
        return loads

    return apply


def swapped(first: str, second: str) -> Callable[[Array], Array]:
    """Two loads exchanged."""

    def apply(loads: Array) -> Array:
        i, j = COMPONENTS.index(first), COMPONENTS.index(second)
        loads[:, [i, j]] = loads[:, [j, i]]
        return loads

    return apply


def twice(run: Run) -> Run:
    """Every load point entered twice, as a table that was pasted again."""
    block = run.read()
    assert block.loads is not None
    source = MemorySource(np.repeat(block.channels, 2, axis=0), np.repeat(block.loads, 2, axis=0))
    return replace(run, samples=2 * run.samples, source=source)


def without_a_load(loads: Array) -> Array:
    """One load that was not read."""
    loads[7, 2] = np.nan
    return loads


def earlier_pulses(run: Run) -> Run:
    """The tachometer triggers on the other edge of a mark of 10 degrees."""
    assert run.pulse_times is not None
    return replace(run, pulse_times=run.pulse_times + 10.0 / 360.0 * float(np.median(np.diff(run.pulse_times))))


def irregular_pulses(run: Run) -> Run:
    """A worn mark: pulse times scatter by 5 degrees."""
    assert run.pulse_times is not None
    period = float(np.median(np.diff(run.pulse_times)))
    scatter = np.random.default_rng(3).standard_normal(len(run.pulse_times)) * 5.0 / 360.0 * period
    return replace(run, pulse_times=np.sort(run.pulse_times + scatter))


def backwards(run: Run) -> Run:
    """A record that was written last sample first."""
    block = run.read()
    loads = None if block.loads is None else block.loads[::-1].copy()
    pulses = None if run.pulse_times is None else np.sort((run.samples - 1) / RATE - run.pulse_times)
    return replace(run, source=MemorySource(block.channels[::-1].copy(), loads), pulse_times=pulses)


def gain(factor: float) -> Callable[[Array], Array]:
    """An amplifier at another gain."""
    return lambda x: factor * x


def drifted(x: Array) -> Array:
    """A strain channel that was zeroed again after the wind-off record."""
    return x + 0.1 * np.abs(x).max()


MISHAPS: dict[str, Callable[[Sequence[Run]], list[Run]]] = {
    "nothing wrong": lambda runs: list(runs),
    "wind: a buffer of 100 samples lost": on("wind", drop_block),
    "wind: channels lose a buffer, pulses do not": on(
        "wind", lambda run: replace(drop_block(run), pulse_times=run.pulse_times)
    ),
    "wind: piezo box one sample late": on("wind", with_columns("piezo", delay(1.0))),
    "wind: strain box 5 ms late": on("wind", with_columns("strain", delay(0.005 * RATE))),
    "wind: clock of the strain box 0.1 % fast": on("wind", with_columns("strain", fast_clock(1e-3))),
    "wind: clock of the strain box 0.005 % fast": on("wind", with_columns("strain", fast_clock(5e-5))),
    "wind: one piezo gain x10": on("wind", with_columns("z2.piezo", gain(10.0))),
    "wind: one piezo gain 1.15": on("wind", with_columns("z2.piezo", gain(1.15))),
    "wind: one strain gain x10": on("wind", with_columns("z2.strain", gain(10.0))),
    "wind: all channels in mV": on("wind", edit(lambda x, run: 1e3 * x)),
    "wind: one piezo reversed": on("wind", with_columns("z2.piezo", gain(-1.0))),
    "wind: both channels of a cell reversed": lambda runs: on("wind", with_columns("z2.piezo", gain(-1.0)))(
        on("wind", with_columns("z2.strain", gain(-1.0)))(runs)
    ),
    "wind: two piezo plugs exchanged": on("wind", exchange("z1.piezo", "z3.piezo")),
    "wind: a piezo wraps at 16 bits": on("wind", with_columns("z2.piezo", wrap)),
    "wind: all piezos clip": on("wind", with_columns("piezo", clip)),
    "wind: a piezo has 50 Hz only": on("wind", with_columns("z2.piezo", mains)),
    "wind: a piezo is constant": on("wind", with_columns("z2.piezo", lambda x: 0 * x + 0.3)),
    "wind: a piezo repeats another": on("wind", edit(lambda x, run: _copied(x, run, "z1.piezo", "z2.piezo"))),
    "wind: spikes in a piezo": on("wind", with_columns("z2.piezo", spikes)),
    "wind: all channels through a filter of 60 Hz": on("wind", edit(lambda x, run: low_pass(60.0)(x))),
    "wind: piezo box through a filter of 60 Hz": on("wind", with_columns("piezo", low_pass(60.0))),
    "wind: written backwards": on("wind", backwards),
    "wind: pulses of the other edge, 10 deg": on("wind", earlier_pulses),
    "wind: pulses scatter by 5 deg": on("wind", irregular_pulses),
    "wind: a strain channel zeroed anew": on("wind", with_columns("z2.strain", drifted)),
    "sweep Fx: a buffer of 100 samples lost": on("sweep-Fx", drop_block),
    "sweep Fx: piezo box one sample late": on("sweep-Fx", with_columns("piezo", delay(1.0))),
    "sweep Fx: all channels one sample late": on("sweep-Fx", edit(lambda x, run: delay(1.0)(x))),
    "sweep Fx: written backwards": on("sweep-Fx", backwards),
    "sweep Fx: labeled Fy": on("sweep-Fx", lambda run: replace(edit_loads(swapped("Fx", "Fy"))(run), excited=("Fy",))),
    "sweep Fx: one piezo gain x10": on("sweep-Fx", with_columns("z2.piezo", gain(10.0))),
    "sweep Fx: channels through a filter of 60 Hz": on("sweep-Fx", edit(lambda x, run: low_pass(60.0)(x))),
    "sweep Fx: load cell of the exciter reads 5 % less": on("sweep-Fx", edit_loads(scaled(0.95))),
    "statics: loads in kg": on("static", edit_loads(scaled(1 / 9.80665))),
    "statics: Fz positive downward": on("static", edit_loads(scaled(-1.0, "Fz"))),
    "statics: moments about the origin": on("static", edit_loads(transfer_moments)),
    "statics: every row twice": on("static", twice),
    "statics: one load is not a number": on("static", edit_loads(without_a_load)),
    "statics: a cell replaced afterwards, 8 % less": on("static", with_columns("z2.strain", gain(1.08))),
    "statics of the trim on another day": on("static-trim", with_columns("strain", lambda x: x + 0.02 * x.std(axis=0))),
    "statics of the trim through another amplifier, 3 %": on("static-trim", with_columns("strain", gain(1.03))),
}


def _copied(x: Array, run: Run, source: str, target: str) -> Array:
    x[:, at(run, target)] = x[:, at(run, source)]
    return x


@dataclass(frozen=True)
class TestDay:
    """A simulated campaign of rig D, and what its sound runs give."""

    campaign: Campaign
    geometry: Geometry

    @cached_property
    def calibration(self) -> Calibration:
        """Of the sound static runs."""
        return calibrate([run for run in self.campaign.runs if run.kind == "static"], self.geometry)

    @cached_property
    def model(self) -> IdentifiedModel:
        """Of the sound sweeps and static runs."""
        return identify(measured_spectra(self.campaign.runs, self.geometry), self.geometry)


def test_day(seed: int = 1) -> TestDay:
    """Return the campaign of this seed."""
    geometry = other_rig("D")
    rig = draw_rig(geometry, np.random.default_rng([seed, 23]))
    return TestDay(simulate_campaign(rig, short_campaign("D", SWEEPS, REVOLUTIONS), seed=seed), geometry)


def mishap_row(day: TestDay, name: str) -> dict[str, object]:
    """Return what `check` says, which steps refuse or warn, and what becomes of the loads."""
    runs = [bridge_gaps(run) for run in MISHAPS[name](day.campaign.runs)]
    said, refused, warned = _check(day.geometry, runs), [], []
    calibration, model = day.calibration, day.model
    touched = {run.kind for run, sound in zip(runs, day.campaign.runs, strict=True) if run is not sound}
    said = said or next((f"{run.name}: {describe_gaps(run)}" for run in runs if describe_gaps(run)), "")
    kinds = {"calibrate": ("static",), "identify": ("static", "sweep"), "reduce": ("check", "wind")}
    rules = {"calibrate": measured_anyway, "identify": identified_anyway, "reduce": known_anyway}
    loads: dict[str, RunLoads] = {}
    for step, own in kinds.items():
        used = [run for run in runs if run.kind in own]
        if not touched & set(own) and step != "reduce":
            continue
        try:
            findings = cross_check(day.geometry, used, rules[step])
            warned += [step] if findings else []
            if step == "calibrate":
                calibration = calibrate(used, day.geometry)
                warned += [step] if trim_findings(calibration) and step not in warned else []
            elif step == "identify":
                model = identify(measured_spectra(used, day.geometry), day.geometry)
            else:
                at_rest = compare_static_response(calibration, model_source(model), model.geometry)
                warned += [step] if at_rest and step not in warned else []
                loads = flag_contradicted_runs(_reduce(day, runs, calibration, model), (*at_rest, *findings))
        except UserError as error:
            refused.append(step)
            said = said or str(error)
            break
    row = {"mishap": name, "check": said[:200], "refused": " ".join(refused), "warned": " ".join(warned)}
    return {**row, "chi2/dof": round(model.quality.chi2_per_dof, 2), **_judge(day, loads)}


def _reduce(day: TestDay, runs: Sequence[Run], calibration: Calibration, model: IdentifiedModel) -> dict[str, RunLoads]:
    """Return the loads of the check and wind runs."""
    zero, source = zero_reference([run for run in runs if run.kind == "zero"], calibration), model_source(model)
    used = [run for run in runs if run.kind in ("check", "wind")]
    return {run.name: reduce_run(run, day.geometry, calibration, source, zero) for run in used}


def _check(geometry: Geometry, runs: Sequence[Run]) -> str:
    """Return the first thing that `check` says of the runs; empty where nothing."""
    try:
        findings = cross_check(geometry, [run for run in runs if run.kind != "zero"], lambda finding: True)
    except UserError as error:
        return str(error)
    said = [finding.sentence for finding in findings]
    for run in runs:
        said += [fault.fault for fault in pulse_faults(run)]
        said += [f"{run.name}: {name} {why}" for name, why in live_channels(run, geometry).left_out.items()]
    return said[0] if said else ""


def _judge(day: TestDay, loads: dict[str, RunLoads]) -> dict[str, object]:
    """Return rows, rows with a flag, coverage of the others, and their largest error in sigma."""
    rows = []
    for run, truth in zip(day.campaign.runs, day.campaign.truths, strict=True):
        if run.name in loads:
            rows += list(rows_of_run(loads[run.name], truth))
    if not rows:
        return {}
    table = pd.DataFrame(rows)
    plain = table[table["flag"] == ""]
    words = sorted({word for flag in table["flag"] for word in flag.split("; ") if word})
    worst = np.nanmax(np.abs(plain[["z_cosine", "z_sine"]].to_numpy(float)), initial=0.0) if len(plain) else np.nan
    left_out = {channel for item in loads.values() for channel in item.left_out}
    return {
        "rows": len(table),
        "flagged": len(table) - len(plain),
        "flags": ", ".join(words),
        "coverage": covered_share(plain) if len(plain) else np.nan,
        "worst": round(float(worst), 1),
        "left out": " ".join(sorted(left_out)),
        "notes": "; ".join(dict.fromkeys(note for item in loads.values() for note in item.notes))[:160],
    }


def mishap_table(names: Sequence[str], seed: int) -> pd.DataFrame:
    """Return one row for each mishap."""
    day = test_day(seed)
    return pd.DataFrame([mishap_row(day, name) for name in names])
