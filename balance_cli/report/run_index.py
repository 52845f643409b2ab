"""The index of many runs: a table that sorts and filters, a small curve for each, and its loads on demand."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.choices import FREQUENCIES
from balance_cli.reduction.flags import NOT_MEASURED, NOT_TESTED, SEPARATOR, trust_text
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.run_verdict import DO_NOT_USE, USE, run_verdict, untested_loads
from balance_cli.report.azimuth import waveform
from balance_cli.report.blocks import Row, RunIndex, Table, TableCell
from balance_cli.report.number_format import MISSING_VALUE, value_and_sigma_text
from balance_cli.report.plot_data import script_json
from balance_cli.report.recommendation import Recommendation

MARKS = {USE: "good", DO_NOT_USE: "bad"}
CURVE_WIDTH, CURVE_HEIGHT = 100.0, 24.0
CURVE_STEP = 6
"""Steps of two degrees between the points of a small curve."""
FLAG_DIGITS = 2
"""Letters of the number of a flag text, base 36: 1296 different texts."""


def run_index(recommendations: Sequence[Recommendation]) -> RunIndex:
    """Return the index of all runs: verdict, trust, speed, mean and blade harmonic of each component."""
    runs = [(item.source.content, run) for item in recommendations for run in item.runs.values()]
    names = [name for name in COMPONENTS if any(name in run.components for _, run in runs)]
    head = [
        TableCell("run"),
        TableCell("verdict", mark="text"),
        TableCell("trust", mark="text"),
        TableCell("1/rev [Hz]"),
    ]
    for name in names:
        head += [TableCell(f"{name} mean [{UNIT_OF[name]}]"), TableCell(f"{name} blade harmonic")]
    strongest = _strongest_component(runs, names)
    title = f"{strongest} over azimuth" if strongest else ""
    head.append(TableCell(title))
    rows = tuple(_row(loads, run, names) for loads, run in runs)
    caption = f"All {len(runs)} runs. Click a heading to sort, a run for its loads."
    curves = tuple(_curve(loads, run, strongest) for loads, run in runs)
    return RunIndex(Table(caption, (tuple(head),), rows, sortable=True), curves, _data(runs))


def _row(loads: HubLoads, run: RunLoads, names: Sequence[str]) -> Row:
    verdict = run_verdict(run)
    worst = trust_text(SEPARATOR.join(word for row in run.flags for word in row))
    cells = [
        TableCell(run.run, mark="name"),
        TableCell(verdict.word, mark=f"text {MARKS.get(verdict.word, '')}".strip()),
        TableCell(worst, ", ".join(untested_loads(run)) if worst == NOT_TESTED else "", "text"),
        TableCell(f"{run.frequency_hz[1]:.4g}" if len(run.frequency_hz) > 1 else ""),
    ]
    blade = _blade_row(loads.geometry, run)
    sigma = polar_sigma(run.amplitude, run.sigma_cosine, run.sigma_sine)[0]
    for name in names:
        if name not in run.components:
            cells += [TableCell(""), TableCell("")]
            continue
        m = run.components.index(name)
        mean, _ = value_and_sigma_text(float(run.amplitude[0, m].real), float(run.sigma_cosine[0, m]))
        size, _ = value_and_sigma_text(abs(complex(run.amplitude[blade, m])), float(sigma[blade, m]))
        unmeasured = NOT_MEASURED in run.flags[0][m].split(SEPARATOR)
        cells += [TableCell(MISSING_VALUE if unmeasured else mean), TableCell(size)]
    return tuple(cells)


def _blade_row(geometry: Geometry, run: RunLoads) -> int:
    blades = geometry.rotor.blades if geometry.rotor else 1
    last = len(run.frequency_hz) - 1
    return blades if blades <= last else min(1, last)


def _strongest_component(runs: Sequence[tuple[HubLoads, RunLoads]], names: Sequence[str]) -> str:
    """The force with the largest harmonics over all runs (a moment where no force is known): the curve of the index."""
    forces = [name for name in names if name.startswith("F")] or list(names)
    sizes = {
        name: sum(
            float(np.nansum(np.abs(run.amplitude[1:, run.components.index(name)])))
            for _, run in runs
            if name in run.components
        )
        for name in forces
    }
    return max(sizes, key=lambda name: sizes[name]) if sizes else ""


def _curve(loads: HubLoads, run: RunLoads, name: str) -> str:
    """The path of the load without its mean over one revolution; empty for loads that are no harmonics."""
    if loads.method == FREQUENCIES or name not in run.components or len(run.frequency_hz) < 2:
        return ""
    values = waveform(np.nan_to_num(run.amplitude[:, run.components.index(name)]), mean=False)[::CURVE_STEP]
    extent = float(np.ptp(values)) or 1.0
    y = (values.max() - values) / extent * (CURVE_HEIGHT - 4.0) + 2.0
    x = np.linspace(0.0, CURVE_WIDTH, len(values))
    return "M" + "L".join(f"{a:.0f} {b:.0f}" for a, b in zip(x, y, strict=True))


def _data(runs: Sequence[tuple[HubLoads, RunLoads]]) -> str:
    """The loads of every run for the page's script: cosine, sine and their sigmas as float32, flags as numbers."""
    flags: dict[str, int] = {}
    sentences: dict[str, int] = {}
    items = []
    for loads, run in runs:
        values = np.stack([run.amplitude.real, -run.amplitude.imag, run.sigma_cosine, run.sigma_sine], axis=-1)
        words = [flags.setdefault(word, len(flags)) for row in run.flags for word in row]
        with np.errstate(over="ignore"):
            packed = base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")
        items.append(
            {
                "n": run.run,
                "c": [[name, UNIT_OF.get(name, "")] for name in run.components],
                "f": [round(float(value), 4) for value in run.frequency_hz[: None if _tones(loads) else 2]],
                "d": packed,
                "w": "".join(np.base_repr(number, 36).zfill(FLAG_DIGITS) for number in words),
                "s": sentences.setdefault(run_verdict(run).sentence, len(sentences)),
            }
        )
    return script_json(json.dumps({"flags": list(flags), "sentences": list(sentences), "runs": items}))


def _tones(loads: HubLoads) -> bool:
    return loads.method == FREQUENCIES
