"""Reduction by harmonics against reading: the processor time of one run of a batch, in the same process.

Reading is the least that any program does with a run: all samples of all channels as an array of float64. A batch is
timed as it is reduced, file by file, without the start of the program; every file is another recording.

What a run costs at least: five FFTs of its length for each channel (two spectra that show other lines, one each for the
pulses, the lines beside the harmonics and the noise), a spline, 50 products for each sample and channel (regression on
azimuth), and some twenty passes over its samples. For 30 s of 15 channels at 800 Hz these are 66 and 46 million
operations and 120 MB: in bare numpy 10 ms with the digest of the file, 2.4 times reading. Of 70 ms here 32 are in 25
lines that take half a millisecond or more: samples and digest 5, transforms 8, sums of lines and their kernel 5,
regression 4, medians and sorts 4, splines 2. The other 38 ms are 25000 calls of Python, numpy and h5py: tests and flags
by small matrices, and the header, read twice at 1.8 ms. A run that its response does not explain takes 8 ms more, for
the mistakes in its channels.
"""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np

from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run_file import open_matching_run, open_run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli.batch.executors import keep_freed_memory
from balance_cli.cli.batch.work import Item, pickle_reduction, reduce_file, survey_run
from balance_cli.cli.reduce_runs import MethodOptions, Reduction
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.harmonic_loads import harmonic_response
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.steadiness import examine_steadiness
from balance_cli.reduction.suspect_channels import explain_residuals
from balance_cli.reduction.weighted_least_squares import solve_loads
from balance_cli.signals.rotor.harmonics import estimate_harmonics
from balance_cli.signals.rotor.pulse_consistency import line_spacing
from balance_cli.signals.rotor.unmodelled_lines import unmodelled_lines
from balance_cli.signals.transient_end import find_transient_end
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import identify
from benchmarks.comparison import Comparison, program_with_version
from studies.wind_runs import write_wind_runs

ROOT = Path(__file__).parents[1]
RUNS = 24
STAGES: dict[str, Callable[..., object]] = {
    "file, checks, digest": open_matching_run,
    "health of channels": live_channels,
    "pulses against lines": line_spacing,
    "transient end": find_transient_end,
    "regression, lines beside": estimate_harmonics,
    "response": harmonic_response,
    "least squares": solve_loads,
    "mistakes in channels": explain_residuals,
    "other lines": unmodelled_lines,
    "steadiness": examine_steadiness,
}
"""Stages of a reduction, and the function whose time is theirs."""


def run() -> str:
    """Return the ratios and the stages as text."""
    read, opened, reduced, stages = _measure()
    lines = [
        f"samples as float64  {1e3 * read:6.1f} ms",
        f"opened and checked  {1e3 * opened:6.1f} ms, {opened / read:.1f} times that",
        f"surveyed, reduced   {1e3 * reduced:6.1f} ms, {reduced / read:.1f} times reading, "
        f"{reduced / opened:.1f} times opening",
    ]
    return "\n".join(lines + [f"  {stage:<25} {100 * share:3.0f} %" for stage, share in stages.items()])


def compare() -> list[Comparison]:
    """Return reduction beside reading."""
    read, _, reduced, stages = _measure()
    largest = sorted(stages, key=lambda stage: -stages[stage])[:3]
    shares = ", ".join(f"{stage} {100 * stages[stage]:.0f} %" for stage in largest)
    note = f"run of 30 s, 15 channels at 800 Hz, surveyed, checked, reduced; {shares}"
    program = program_with_version("h5py", "all samples read as float64")
    return [Comparison("`reduce` by harmonics", "run", reduced, program, read, note)]


def _measure() -> tuple[float, float, float, dict[str, float]]:
    """Time reading, opening and reduction of a run [s] side by side, then the shares of the stages."""
    keep_freed_memory()
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    sweeps = [open_run(path) for path in sorted((ROOT / "sample_data").glob("sweep-*-low.h5"))]
    statics = [open_run(path) for path in sorted((ROOT / "sample_data").glob("static-*.h5"))]
    source = model_source(identify(measured_spectra(sweeps, geometry, means=True), geometry))
    options = MethodOptions("harmonic", None, None, 8)
    data = pickle_reduction(Reduction(options, geometry, calibrate(statics, geometry), source, None, None))
    with TemporaryDirectory() as folder:
        paths = write_wind_runs(Path(folder), geometry, RUNS, system=source.system)
        read, opened, reduced = _times_per_run(
            [
                _read_samples,
                lambda path: open_run(path, hold=True),
                lambda path: (survey_run(Item(path, data)), reduce_file(Item(path, data))),
            ],
            paths,
        )
        stages = _time_of_stages(lambda path: reduce_file(Item(path, data)), paths)
    return read, opened, reduced, stages


def _read_samples(path: Path) -> object:
    with h5py.File(path) as file:
        return np.asarray(file["channels"][()], np.float64)


def _times_per_run(calls: Sequence[Callable[[Path], object]], paths: Sequence[Path]) -> list[float]:
    """Return the processor times of a run [s], medians of all runs, on each of which the calls take turns.

    The first run is called once before: it loads what is loaded once.
    """
    times = []
    for path in (paths[0], *paths):
        clock = [time.process_time()]
        for call in calls:
            call(path)
            clock.append(time.process_time())
        times.append(np.diff(clock))
    return [float(seconds) for seconds in np.median(times[1:], axis=0)]


def _time_of_stages(call: Callable[[Path], object], paths: Sequence[Path]) -> dict[str, float]:
    """Return the share of each stage in the processor time of all runs, and what is left."""
    profile = cProfile.Profile(time.process_time)
    profile.enable()
    for path in paths:
        call(path)
    profile.disable()
    stats = pstats.Stats(profile)
    cumulative = {name: entry[3] for (_, _, name), entry in stats.stats.items()}  # type: ignore[attr-defined]
    total = cumulative["reduce_file"]
    shares = {stage: cumulative[function.__name__] / total for stage, function in STAGES.items()}
    return shares | {"flags, trust, the rest": 1.0 - sum(shares.values())}
