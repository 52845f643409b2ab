"""Frequency responses of one sweep beside those of pyFRF, from samples in memory.

pyFRF gives H1 of all channels over one load, without covariance, from segments of the record: of a periodic record the
whole periods without a window, of a random one segments of 2 s with Hann's window, half of which overlap. `sweep-tf`
gives responses of the same channels with the covariance of their noise; of a random record by local rational models,
which have no leakage. It also tests the channels and finds the end of the start transient.

What is beyond pyFRF costs most. Of 23 ms for 22400 samples of 15 channels in seven periods the periods and their FFTs
take 2.5, the noise covariance of 16 signals at 634 lines, robust against outliers, 6.5, that of the last periods,
against which the start transient is tested, 6, the tests of the channels 5.5, response, coherence and their covariance
1.5. pyFRF takes 5 in all. The same FFTs, products, inverses and passes in bare numpy take 7: no program with this
content is as fast as H1 alone. The cost of noise goes with the lines of a period, not with the periods.

A single FFT of a random record takes 1.5 ms, where three times the speed of pyFRF is 2.1 ms: nothing would be left for
any local model. Here 162 windows of 85 lines are fitted with seven sets of orders, up to three poles in up to ten
Gauss-Newton steps, in 1.3 s. The bare QR factorizations, projections, residuals and products of the steps take 0.4:
with 94 lines, 9 regressors and 15 channels some 0.6 million operations a window and step. Half of the windows hold no
mode; their poles fit noise, and take all of the steps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from balance_cli.campaign.recording.run import Run, hold_samples
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli.batch.executors import keep_freed_memory
from balance_cli.signals.response.choices import AUTO, LOCAL_RATIONAL
from balance_cli.simulation import simulate_run
from balance_cli.simulation.plans import SweepPlan
from balance_cli.simulation.rig import true_rig
from balance_cli.steps.sweep_tf import estimate_responses
from benchmarks.comparison import Comparison, alternate, program_with_version

ROOT = Path(__file__).parents[1]
REPETITIONS = 2
LEVEL = 20.0
"""[N] rms of the random load."""
SEGMENT = 2.0
"""[s] of a segment of H1 of a record that does not repeat."""


def compare() -> list[Comparison]:
    """Time a periodic record of the sample campaign and a simulated random one."""
    keep_freed_memory()  # as every command does
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    periodic = hold_samples(open_run(ROOT / "sample_data" / "sweep-Fz-low.h5"))
    plan = SweepPlan(run="random", kind="sweep", excited=("Fz",), excitation="random", level=(LEVEL,))
    random = hold_samples(simulate_run(true_rig(geometry), plan)[0])
    assert periodic.period is not None
    return [
        _comparison("periodic sweep", periodic, geometry, AUTO, periodic.period, "none"),
        _comparison("random sweep, local models", random, geometry, LOCAL_RATIONAL, SEGMENT, "hann"),
    ]


def _comparison(task: str, run: Run, geometry: Geometry, estimator: str, segment: float, window: str) -> Comparison:
    program = program_with_version("pyFRF", "H1")
    ours, theirs = alternate(
        lambda: estimate_responses([run], geometry, estimator),
        lambda: _with_pyfrf(run, segment, window),
        REPETITIONS,
    )
    million = 1e6 / (run.samples * len(run.channel_names))
    note = "with covariance of the noise, transient and channels tested; theirs without"
    return Comparison(f"`sweep-tf`, {task}", "10⁶ samples", ours * million, program, theirs * million, note)


def _with_pyfrf(run: Run, segment: float, window: str) -> object:
    from pyFRF import FRF

    assert run.sample_rate is not None
    block = run.read()
    assert block.loads is not None
    column, length = COMPONENTS.index(run.excited[0]), round(segment * run.sample_rate)
    overlap = 0 if window == "none" else length // 2
    frf = FRF(
        int(run.sample_rate),
        exc=np.ascontiguousarray(block.loads[:, column])[None, None],
        resp=np.ascontiguousarray(block.channels.T)[None],
        window=window,
        nperseg=length,
        noverlap=overlap,
        fft_len=length,
    )
    return frf.get_H1(), frf.get_coherence()
