"""Reduction by harmonics against reading: the processor time of one run of a batch, in the same process.

The limit is the time to read a run file (decompress, check, digest). What is left beyond it: real matrix products for
the lines beside the harmonics (a quarter), medians of their power, spectra and splines.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.steps.identify import identify
from balance_cli.steps.reduce import reduce_run
from studies.wind_runs import write_wind_runs

ROOT = Path(__file__).parents[1]
REPEATS = 7


def run() -> str:
    """Time both, and say the ratio."""
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    sweeps = [open_run(path) for path in sorted((ROOT / "sample_data").glob("sweep-*-low.h5"))]
    source = model_source(identify(measured_spectra(sweeps, geometry, means=True), geometry))
    with TemporaryDirectory() as folder:
        (path,) = write_wind_runs(Path(folder), geometry, 1)
        raw = _shortest(lambda: _read_samples(path))
        opened = _shortest(lambda: open_run(path, hold=True))
        held = open_run(path, hold=True)
        reduced = _shortest(lambda: reduce_run(held, geometry, None, source))
    return (
        f"samples alone {1e3 * raw:6.1f} ms\n"
        f"open, checked {1e3 * opened:6.1f} ms, {opened / raw:.1f} times that\n"
        f"reduction     {1e3 * reduced:6.1f} ms, {reduced / opened:.1f} times opening"
    )


def _read_samples(path: Path) -> None:
    with h5py.File(path) as file:
        file["channels"][()]


def _shortest(call: Callable[[], object]) -> float:
    """Return the least processor time of several calls [s], which others on the machine disturb least."""
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)
