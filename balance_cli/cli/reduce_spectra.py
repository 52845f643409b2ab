"""`balance reduce --band`: spectral densities of the hub loads."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.cli.common import Session
from balance_cli.cli.load_text import number_pair
from balance_cli.io.errors import UserError
from balance_cli.io.formats import SPECTRA_FORMAT
from balance_cli.io.formula_cells import text_cell
from balance_cli.io.result_view import plural

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.reduction.response_sources import ResponseSource
    from balance_cli.reduction.spectra_result import LoadSpectra, RunSpectra


OTHER_WAYS = ("rotor", "method", "zero", "frequencies", "harmonics", "history", "jobs", "executor", "shard", "survey")
"""Options that do not apply to spectra, which are reduced in one process."""


def check_band_options(band: tuple[float, float] | None, is_given: Callable[[str], bool]) -> None:
    """Raise UserError where a band does not rise from above zero, or an option of OTHER_WAYS is given, too."""
    if band is None:
        return
    if not (0.0 < band[0] < band[1] < math.inf):
        fault = f"{band[0]:g} to {band[1]:g} Hz is not a band"
        raise UserError(fault, "--band", remedy="Give two frequencies above zero, the lower one first")
    for option in OTHER_WAYS:
        if is_given(option):
            raise UserError("does not go with --band", f"--{option}", remedy="Leave one of them out")


def reduce_to_spectra(
    session: Session,
    geometry: Geometry,
    source: ResponseSource,
    runs: Sequence[Run],
    band: tuple[float, float],
    skip_bad: bool,
    output: Path,
) -> None:
    """Reduce runs to spectral densities, write them and set the summary."""
    from balance_cli.reduction.load_spectra import load_spectra
    from balance_cli.reduction.spectra_result import LoadSpectra

    results: dict[str, RunSpectra] = {}
    with session.collect_messages():
        for run in session.progress(runs, "runs", len(runs)):
            with session.skip_if_unusable(run, skip_bad):
                results[run.name] = load_spectra(run, geometry, source, band)
                for channel, reason in results[run.name].left_out.items():
                    session.warn_of_run(run.name, f"{run.name}: channel {channel} left out: {reason}")
    spectra = LoadSpectra(source.description, geometry, band, results)
    if output.suffix == ".h5":
        session.save(output, SPECTRA_FORMAT, spectra)
    else:
        table = spectra.to_frame()
        table["run"] = table["run"].map(text_cell)
        session.write_text(output, table.to_csv(index=False, lineterminator="\n"))
    session.finish(spectra_summary(spectra), spectra_text(spectra))


def spectra_summary(spectra: LoadSpectra) -> dict[str, Any]:
    """Return the summary of all runs (docs/json.md)."""
    return {
        "method": "band",
        "response": spectra.response,
        "band_hz": spectra.band,
        "runs": {name: _run_summary(run) for name, run in spectra.runs.items()},
    }


def _run_summary(run: RunSpectra) -> dict[str, Any]:
    return {
        "band_rms": {name: {"value": value, "sigma": sigma} for name, (value, sigma) in run.band_rms.items()},
        "peak_hz": run.peak_hz,
        "resolution_hz": run.resolution_hz,
        "averages": run.averages,
        "redundancy_max": float(run.redundancy.max()),
        "interval_s": run.interval,
        "channels_left_out": run.left_out,
        "trust": run.trust,
        "load_error": run.load_error,
        "not_steady": run.not_steady or (),
        "steadiness_note": run.steadiness_note,
    }


def spectra_text(spectra: LoadSpectra) -> Iterator[str]:
    """Yield the rms of each load within the band, with sigma, and whether to trust it."""
    low, high = spectra.band
    yield f"{plural(len(spectra.runs), 'run')} reduced to spectra from {low:g} to {high:g} Hz, {spectra.response}"
    for name, run in spectra.runs.items():
        yield f"{name}: bandwidth {run.resolution_hz:.3g} Hz, {run.averages:.0f} averages"
        if run.load_error is not None:
            errors = ", ".join(f"{component} {100 * value:.2f} %" for component, value in run.load_error.items())
            yield f"   error of the applied loads: {errors or 'none'}"
        yield f"   {'':8}{'rms':>12} {'sigma':>9} {'peak at':>12}"
        for component, (value, sigma) in run.band_rms.items():
            shown, spread = number_pair(value, sigma)
            yield f"   {f'{component} {UNIT_OF[component]}':8}{shown:>12} {spread:>9} {run.peak_hz[component]:>9.4g} Hz"
        if run.steadiness_note is not None:
            yield f"   {run.steadiness_note} (not steady: {', '.join(run.not_steady or ())})"
        flagged = sum(bool(flag) for flag in run.flags)
        yield f"   trust: {run.trust}; {flagged} of {len(run.flags)} frequencies are flagged"
