"""The top of the page: what was made from what, and the verdict in numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.report.blocks import Block, Figures, Points, Section, Warn
from balance_cli.report.check_errors import checked, overall_error
from balance_cli.report.diagnosis import verdict_words
from balance_cli.report.frequencies import CONSIDERABLE, deviation, reference
from balance_cli.report.load_figures import wind_runs
from balance_cli.report.number_format import listed, percent, sentence, significant
from balance_cli.report.parameters import describes
from balance_cli.report.sources import Sources
from balance_cli.report.wind_on import preferred, unexplained


def section(sources: Sources) -> Section:
    """What there is, and what came out of it."""
    blocks: list[Block] = [Points(tuple(_made_from(sources)))]
    figures = tuple(_figures(sources))
    if figures:
        blocks.append(Figures(figures))
    blocks += _verdict(sources)
    return Section("summary", "Summary", tuple(blocks))


def rig(sources: Sources) -> str:
    """Name of the rig, or of the rigs, for the title; empty where no artefact says."""
    return listed(list(dict.fromkeys(geometry.rig for geometry in sources.geometries)))


def _made_from(sources: Sources) -> Iterator[str]:
    for geometry in sources.geometries:
        yield _rig_words(geometry)
    for calibration in sources.calibrations:
        trims = calibration.content.trims
        rows = sum(trim.rows for trim in trims.values())
        yield f"Calibration {calibration.file}: {rows} load points, trims {listed(list(trims))}."
    for transfer in sources.transfers:
        runs = dict.fromkeys(name for response in transfer.content.responses for name in response.run.split("+"))
        yield f"Measured responses {transfer.file}: {len(runs)} runs."
    if sources.models:
        yield f"Models: {listed([f'{source.label} ({source.file})' for source in sources.models])}."
    for diagnosis in sources.diagnoses:
        made = diagnosis.content
        yield f"Diagnosis {diagnosis.file}: {made.candidates} candidates, {len(made.hold_out)} runs held out."
    if sources.loads:
        runs = dict.fromkeys(name for source in sources.loads for name in source.content.runs)
        labels = listed([f"{source.label} ({source.file})" for source in sources.loads])
        yield f"Hub loads of {len(runs)} runs ({', '.join(runs)}), by {labels}."


def _rig_words(geometry: Geometry) -> str:
    parts = [f"{len(geometry.cells)} load cell{'s' if len(geometry.cells) > 1 else ''}"]
    if geometry.torque_meter:
        parts.append("a torque meter")
    parts.append(f"{len(geometry.channels)} channel{'s' if len(geometry.channels) > 1 else ''}")
    return f"Rig {geometry.rig}, geometry {geometry.name}: {listed(parts)}."


def _figures(sources: Sources) -> Iterator[tuple[str, str, str]]:
    for source in checked(sources):
        error = overall_error(source.content, "load_error")
        if error is not None:
            yield f"{percent(error.value)} %", f"hub-load error, {source.label}", "good" if error.is_noise else ""
    noise = [overall_error(source.content, "load_error") for source in checked(sources)]
    if any(noise):
        least = min(error.noise for error in noise if error is not None)
        yield f"{percent(least)} %", "of it noise alone (least of all methods)", "quiet"
    yield from _model_figures(sources)
    having = [source for source in sources.loads if wind_runs(source.content)]
    if having:
        shown = preferred(having)
        runs = wind_runs(shown.content).values()
        total = sum(int(np.isfinite(run.redundancy).sum()) for run in runs)
        failing = sum(len(unexplained(run)) for run in runs)
        mark = "bad" if failing else "good"
        yield f"{failing} of {total}", f"wind-on harmonics beyond the redundancy limit, {shown.label}", mark


def _model_figures(sources: Sources) -> Iterator[tuple[str, str, str]]:
    best = reference(sources.models)
    if best is None:
        return
    quality = best.content.quality
    mark = "good" if describes(best.content) else "bad"
    yield significant(quality.chi2_per_dof), f"chi2/dof, {best.label}", mark
    computed = next((source for source in sources.models if source.rank == "computed"), None)
    if computed is not None:
        found = deviation(computed.content, best.content)
        words = f"computed eigenfrequencies more than {100 * CONSIDERABLE:.0f} % off"
        count = len(found.considerable)
        yield f"{count} of {found.count}", words, "bad" if count else "good"


def _verdict(sources: Sources) -> Iterator[Block]:
    if sources.diagnoses:
        yield Points(tuple(verdict_words(source) for source in sources.diagnoses))
    best = reference(sources.models)
    if best is not None and not describes(best.content):
        yield Warn(
            f"{sentence(best.label)} does not describe the data within their noise: chi2/dof is "
            f"{significant(best.content.quality.chi2_per_dof)}, the responses are off by "
            f"{percent(best.content.quality.frf_error)} % rms. Something is missing in it."
        )
    elif best is not None:
        yield Points((f"{sentence(best.label)} describes the data within their noise.",))
    ranking = _ranking(sources)
    if ranking:
        yield Points((ranking,))


def _ranking(sources: Sources) -> str:
    """Which method leaves least, in one sentence."""
    found = [
        (error.value, error.noise, source.label)
        for source in checked(sources)
        if (error := overall_error(source.content, "load_error")) is not None
    ]
    if len(found) < 2:
        return ""
    value, noise, label = min(found)
    others = "; ".join(f"{other} {percent(error)} %" for error, _, other in found if other != label)
    factor = f", {significant(value / noise, 2)} times what noise alone would leave" if noise > 0 else ""
    return f"Least hub-load error on the check runs: {label}, {percent(value)} %{factor} ({others})."
