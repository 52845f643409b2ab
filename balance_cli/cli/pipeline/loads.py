"""The end of a chain: the loads of each run by the best response, and whether to trust them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from balance_cli.cli.load_text import load_lines
from balance_cli.cli.pipeline.steps import BEST_FIRST
from balance_cli.reduction.choices import FREQUENCIES
from balance_cli.reduction.flags import SEPARATOR, trust_word
from balance_cli.reduction.run_verdict import run_verdict

if TYPE_CHECKING:
    from balance_cli.reduction.result import HubLoads


def best_loads(results: Path, outputs: list[Path]) -> tuple[Path, HubLoads] | None:
    """Return the loads by the best response that were made, with their file; None where there are none."""
    from balance_cli.io.artefacts import load_artefact
    from balance_cli.io.formats import LOADS_FORMAT
    from balance_cli.reduction.result import HubLoads

    for name in BEST_FIRST:
        path = results / f"loads-{name}.h5"
        if path in outputs:
            return path, load_artefact(path, {LOADS_FORMAT: HubLoads}).content
    return None


def loads_text(best: tuple[Path, HubLoads] | None) -> Iterator[str]:
    """Yield the loads of each run with its verdict."""
    if best is None:
        yield "no harmonic loads were reduced"
        return
    path, loads = best
    yield f"hub loads by {loads.response}, {path}:"
    for name, run in loads.runs.items():
        yield f"{name} ({run.kind}, 1/rev at {run.frequency_hz[1]:.4g} Hz)"
        yield from load_lines(run, loads.geometry, loads.method == FREQUENCIES)
        yield f"   {run_verdict(run).sentence}"


def spectra_lines(results: Path, outputs: list[Path]) -> Iterator[str]:
    """Yield the loads of records without pulses, where their spectra were made."""
    from balance_cli.cli.reduce_spectra import spectra_text
    from balance_cli.io.artefacts import load_artefact
    from balance_cli.io.formats import SPECTRA_FORMAT
    from balance_cli.reduction.spectra_result import LoadSpectra

    path = results / "spectra.h5"
    if path in outputs:
        yield from spectra_text(load_artefact(path, {SPECTRA_FORMAT: LoadSpectra}).content)


def loads_summary(best: tuple[Path, HubLoads] | None) -> dict[str, Any]:
    """Return the keys `loads`, `response` and `trust` {run: word} of the summary."""
    if best is None:
        return {"loads": None, "response": None, "trust": {}}
    path, loads = best
    words = {
        name: trust_word(SEPARATOR.join(word for row in run.flags for word in row)) for name, run in loads.runs.items()
    }
    return {"loads": path, "response": loads.response, "trust": words}
