"""The top of the page: the loads of each run and whether to use them, then key figures, verdicts and inputs."""

from __future__ import annotations

import math
from collections.abc import Iterator

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.report.answer import answer_blocks
from balance_cli.report.before_after import before_after_blocks
from balance_cli.report.blocks import BulletList, Details, KeyFigures, PageBlock, Paragraph, Section, WarningText
from balance_cli.report.check_errors import loads_with_check_runs, overall_error
from balance_cli.report.diagnosis import verdict_sentence
from balance_cli.report.few_runs import condense
from balance_cli.report.frequencies import LARGE_FREQUENCY_DEVIATION, frequency_deviation, reference_model
from balance_cli.report.load_verdicts import residual_test_figure, verdict_blocks
from balance_cli.report.number_format import capitalize_first, format_percent, format_significant, join_names
from balance_cli.report.parameters import is_good_fit, is_noise_overstated
from balance_cli.report.recommendation import rank_methods
from balance_cli.report.source_roles import SourceRole
from balance_cli.report.sources import Sources

MOST_NAMES = 20
"""Runs that are named in the list of inputs."""


def section(sources: Sources) -> Section:
    """Loads of each run with their verdict, updating before and after, key figures, and the inputs."""
    blocks: list[PageBlock] = [
        *_several_rigs(sources),
        *answer_blocks(sources.loads),
        *before_after_blocks(sources),
    ]
    if not sources.loads:
        blocks.append(Paragraph(_without_loads(sources), "lead"))
    figures = (*_key_figures(sources), *(() if sources.loads else _calibration_key_figures(sources)))
    if figures:
        blocks.append(KeyFigures(figures))
    blocks += _verdict_blocks(sources)
    blocks += verdict_blocks(condense(sources)[0].loads)
    blocks.append(Details("Inputs of this page", (BulletList(tuple(_input_sentences(sources))),)))
    return Section("summary", "Hub loads" if sources.loads else "Summary", tuple(blocks))


def rig_title(sources: Sources) -> str:
    """Name of the rig, or of the rigs, for the title; empty without artefacts."""
    planned = [item.plan.rig for item in sources.plans if item.plan.rig]
    return join_names(list(dict.fromkeys([*(geometry.rig for geometry in sources.geometries), *planned])))


def page_title(sources: Sources) -> str:
    """Title of the page: a rotor balance, or whatever was calibrated where the inputs know no more than its loads."""
    rig = rig_title(sources)
    has_mechanics = any(geometry.bodies for geometry in sources.geometries)
    kind = "Rotor balance" if has_mechanics or not sources.calibrations else "Static calibration"
    return f"{kind} {rig}" if rig else kind


def _several_rigs(sources: Sources) -> Iterator[PageBlock]:
    rigs = list(dict.fromkeys(geometry.rig for geometry in sources.geometries))
    if len(rigs) > 1:
        yield WarningText(
            f"The inputs are of different rigs: {join_names(rigs)}. What this page compares holds within one rig only: "
            "make a page for each."
        )


def _input_sentences(sources: Sources) -> Iterator[str]:
    for geometry in sources.geometries:
        yield _rig_sentence(geometry)
    for calibration in sources.calibrations:
        trims = calibration.content.trims
        rows = sum(trim.rows for trim in trims.values())
        yield f"Calibration {calibration.file}: {rows} load points, trims {join_names(list(trims))}."
    for transfer in sources.transfers:
        runs = dict.fromkeys(name for response in transfer.content.responses for name in response.run.split("+"))
        yield f"Measured responses {transfer.file}: {len(runs)} runs."
    for planned in sources.plans:
        yield f"Plan {planned.file}: {len(planned.plan.runs)} runs in {planned.forecast.minutes:.0f} minutes."
    if sources.models:
        yield f"Models: {join_names([f'{source.label} ({source.file})' for source in sources.models])}."
    for diagnosis in sources.diagnoses:
        candidates, hold_out = diagnosis.content.candidate_count, len(diagnosis.content.hold_out)
        yield f"Diagnosis {diagnosis.file}: {candidates} candidates, {hold_out} runs held out."
    if sources.loads:
        runs = dict.fromkeys(name for source in sources.loads for name in source.content.runs)
        labels = join_names([f"{source.label} ({source.file})" for source in sources.loads])
        more = f" and {len(runs) - MOST_NAMES} more" if len(runs) > MOST_NAMES else ""
        yield f"Hub loads of {len(runs)} runs ({', '.join(list(runs)[:MOST_NAMES])}{more}), by {labels}."


def _rig_sentence(geometry: Geometry) -> str:
    parts = [f"{len(geometry.cells)} load cell{'s' if len(geometry.cells) > 1 else ''}"]
    if geometry.shaft_meters:
        several = len(geometry.shaft_meters) > 1
        parts.append(f"{len(geometry.shaft_meters)} torque meters" if several else "a torque meter")
    parts.append(f"{len(geometry.channels)} channel{'s' if len(geometry.channels) > 1 else ''}")
    return f"Rig {geometry.rig}, geometry {geometry.name}: {join_names(parts)}."


def _key_figures(sources: Sources) -> Iterator[tuple[str, str, str]]:
    """Yield the key figures of the recommended loads and of the best model; other methods are compared below."""
    for source in rank_methods(loads_with_check_runs(sources))[:1]:
        error = overall_error(source.content, "load_error")
        if error is not None:
            mark = "good" if error.is_noise else ""
            yield f"{format_percent(error.value)} %", f"hub-load error on known loads, {source.label}", mark
            if math.isfinite(error.noise):
                yield f"{format_percent(error.noise)} %", "noise floor of that error", "quiet"
    yield from _model_key_figures(sources)
    yield from residual_test_figure(sources.loads)


def _without_loads(sources: Sources) -> str:
    """What a page without hub loads is about."""
    parts = [
        (sources.calibrations, "the static calibration"),
        (sources.transfers, "measured responses"),
        (sources.models, "models" if len(sources.models) > 1 else "a model"),
        (sources.diagnoses, "a diagnosis"),
    ]
    given = join_names([words for is_present, words in parts if is_present])
    words = "No hub loads: no check or wind run was reduced."
    return f"{words} This page shows {given}." if given else words


def _calibration_key_figures(sources: Sources) -> Iterator[tuple[str, str, str]]:
    """Yield the largest residual of each trim; a small one tells of the fit, not of its errors."""
    for calibration in sources.calibrations:
        for name, trim in calibration.content.trims.items():
            percents = {component: value for component, value in trim.residual_percent_fs.items() if value == value}
            if percents:
                worst = max(percents, key=lambda component: percents[component])
                caption = f"of full scale: largest residual of the calibration, trim {name} ({worst})"
                yield f"{format_significant(percents[worst], 2)} %", caption, ""


def _model_key_figures(sources: Sources) -> Iterator[tuple[str, str, str]]:
    best = reference_model(sources.models)
    if best is None:
        return
    quality = best.content.quality
    mark = "bad" if not is_good_fit(best.content) else "" if is_noise_overstated(best.content) else "good"
    yield format_significant(quality.chi2_per_dof), f"chi2/dof, {best.label}", mark
    computed = next((source for source in sources.models if source.role is SourceRole.COMPUTED), None)
    if computed is not None:
        deviation = frequency_deviation(computed.content, best.content)
        caption = f"computed eigenfrequencies more than {100 * LARGE_FREQUENCY_DEVIATION:.0f} % off"
        count = len(deviation.large_deviations)
        yield f"{count} of {deviation.count}", caption, "bad" if count else "good"


def _verdict_blocks(sources: Sources) -> Iterator[PageBlock]:
    if sources.diagnoses:
        yield BulletList(tuple(verdict_sentence(source) for source in sources.diagnoses))
    best = reference_model(sources.models)
    if best is not None and not is_good_fit(best.content):
        yield WarningText(
            f"{capitalize_first(best.label)} does not describe the data to within their noise: chi2/dof is "
            f"{format_significant(best.content.quality.chi2_per_dof)}, the rms error of the responses is "
            f"{format_percent(best.content.quality.frf_error)} %. The model lacks at least one effect."
        )
    elif best is not None:
        words = f"The {best.label} describes the data to within their noise"
        if is_noise_overstated(best.content):
            chi2_text = format_significant(best.content.quality.chi2_per_dof)
            words += f", which is stated too large (chi2/dof is {chi2_text}, not 1): small effects would not be seen"
        yield BulletList((f"{words}.",))
    ranking = _ranking_sentence(sources)
    if ranking:
        yield BulletList((ranking,))


def _ranking_sentence(sources: Sources) -> str:
    """One sentence that names the method with the smallest error."""
    errors = [
        (error.value, error.noise, source.label)
        for source in loads_with_check_runs(sources)
        if (error := overall_error(source.content, "load_error")) is not None
    ]
    if len(errors) < 2:
        return ""
    value, noise, label = min(errors)
    others = "; ".join(f"{name} {format_percent(error)} %" for error, _, name in errors if name != label)
    factor = f", {format_significant(value / noise, 2)} times the noise floor" if noise > 0 else ""
    return f"Smallest hub-load error on the check runs: {label}, {format_percent(value)} %{factor} ({others})."
