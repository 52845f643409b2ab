"""What is wrong in a campaign as a whole: the geometry and its runs, cross-checked, and each fault named."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.loaded_tares import describe_loaded_tares
from balance_cli.campaign.recording.point_loads import points_beside_shaft
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.diagnosis.consistency.anti_alias import filter_findings
from balance_cli.diagnosis.consistency.copied_records import copied_record_findings
from balance_cli.diagnosis.consistency.delays import common_delay
from balance_cli.diagnosis.consistency.descriptions import describe_mistakes
from balance_cli.diagnosis.consistency.evidence import Evidence, gather_evidence, rig_size
from balance_cli.diagnosis.consistency.findings import (
    CHANNELS_FACTOR,
    DELAY,
    DIFFERENT_RIG,
    FAULT,
    FREQUENCIES,
    HUB_POSITION,
    LEVEL,
    LOAD_FACTOR,
    LOADED_TARE,
    STIFFNESS,
    WARNING,
    ConsistencyFinding,
)
from balance_cli.diagnosis.consistency.frequencies import FrequencyMismatch, frequency_mismatch, with_stiffness
from balance_cli.diagnosis.consistency.hub import hub_shift
from balance_cli.diagnosis.consistency.noise_levels import noise_findings
from balance_cli.diagnosis.consistency.search import find_mistakes
from balance_cli.diagnosis.consistency.silent_channels import silent_channels
from balance_cli.diagnosis.consistency.static_units import static_unit_findings
from balance_cli.diagnosis.consistency.units import FORCE_UNITS, MOMENT_UNITS, suggest_units
from balance_cli.model.balance import balance_model
from balance_cli.model.plate import moment_reference_length
from balance_cli.signals.nyquist_noise import UsualNoise
from balance_cli.signals.response_rows import ResponseRows, response_rows

LARGEST_LEVEL_RATIO = 3.0
"""Ratio of the rms of a load to its stated `level` that may be a matter of definition: rms or peak, pauses or none."""
LARGEST_DEVIATION = 0.6
"""Relative difference, at a typical line, of a check run from what the sweeps predict: a rig as in the sweeps stays
below a tenth, one that is loaded otherwise through a support or a hose below a third."""
FEWEST_LINES = 4
"""Lines in common from which a median over them is not that of one or two bad ones."""
BEYOND_TOLERANCES = float(np.log(10.0))
"""Logarithm of the ratio of measured to computed responses from which no effect, but only wrong numbers explain it."""


def campaign_findings(
    geometry: Geometry, runs: Iterable[Run], stored_noise: Sequence[UsualNoise] = ()
) -> tuple[ConsistencyFinding, ...]:
    """Cross-check the runs with known loads against the geometry and against each other; faults first.

    Of runs without loads only the noise is compared, also with `stored_noise` of sweeps that are not given. What the
    given runs cannot show has no finding; with a geometry without mechanics only labels and units of load points are
    judged.
    """
    runs = tuple(runs)
    arm = moment_reference_length(geometry.hub)
    tares = [_loaded_tare(run, text) for run in runs if (text := describe_loaded_tares(run, arm))]
    copies = copied_record_findings(runs)
    if missing_mechanics(geometry):
        return (*copies, *tares, *static_unit_findings(geometry, runs))
    rows = [part for run in runs for part in [_rows_with_level(run, geometry)] if part is not None]
    findings = findings_from_rows(geometry, [part for part, _ in rows], {part.run: level for part, level in rows})
    beside = {run.name: names for run in runs if (names := points_beside_shaft(run, geometry))}
    findings = tuple(_with_shaft_hint(finding, beside) for finding in findings)
    if not any(item.kind in (LOAD_FACTOR, CHANNELS_FACTOR) for item in findings):
        # Forces and moments in units of their own, lbf and in lbf, are several mistakes, none of which explains a run.
        findings = (*findings, *static_unit_findings(geometry, runs))
    return (*copies, *findings, *tares, *noise_findings(runs, geometry.channel_names, stored_noise))


def _with_shaft_hint(finding: ConsistencyFinding, beside: Mapping[str, tuple[str, ...]]) -> ConsistencyFinding:
    """Return a finding of runs with forces beside the shaft with the other way in which that may come about."""
    points = dict.fromkeys(name for run in finding.runs for name in beside.get(run, ()))
    if not points:
        return finding
    hint = (
        f"unless {', '.join(points)} {'is' if len(points) == 1 else 'are'} on the plate: a moment about the shaft is "
        "taken to go through the torque meter, so forces on the plate must be in line with the shaft"
    )
    return replace(finding, text=f"{finding.text} ({hint})")


def _loaded_tare(run: Run, text: str) -> ConsistencyFinding:
    return ConsistencyFinding(LOADED_TARE, WARNING, text, (run.name,))


def _rows_with_level(run: Run, geometry: Geometry) -> tuple[ResponseRows, tuple[float, ...]] | None:
    rows = response_rows(run, geometry.channel_names)
    return None if rows is None else (rows, run.level)


def findings_from_rows(
    geometry: Geometry, rows: Sequence[ResponseRows], levels: dict[str, tuple[float, ...]]
) -> tuple[ConsistencyFinding, ...]:
    """As `campaign_findings`, from the rows of the runs and the stated levels of the sweeps."""
    if not rows:
        return ()
    system = balance_model(geometry).system()
    runs = gather_evidence(rows, geometry, system)
    mismatch = frequency_mismatch(runs, geometry, system)
    if mismatch is not None and mismatch.factor is not None:
        geometry = with_stiffness(geometry, mismatch.cells, mismatch.factor)
        system = balance_model(geometry).system()
        runs = gather_evidence(rows, geometry, system)
    groups: dict[str | None, list[int]] = {}
    for index, channel in enumerate(geometry.channels):
        if channel.cell is not None:
            groups.setdefault(channel.cell, []).append(index)
    by_source = tuple(map(tuple, groups.values()))
    mistakes, corrected = find_mistakes(runs, by_source)
    # Loads in other axes leave cells silent that others would load.
    silent, heard = silent_channels(corrected, geometry.channel_names)
    if silent:
        silent, heard = silent_channels(runs, geometry.channel_names)
        mistakes, corrected = find_mistakes(heard, by_source)
    if mistakes and _is_moved_hub(rows, runs, geometry, by_source):
        mistakes, corrected = [], runs
    findings = [*silent, *describe_mistakes(mistakes, geometry)]
    if mismatch is None or mismatch.factor is None:  # the mistakes may have hidden it, or been taken for it
        mismatch = frequency_mismatch(corrected, geometry, system) if mistakes else mismatch
    findings += _frequency_findings(mismatch)
    if not any(finding.is_fault for finding in findings):
        findings += _hub_findings(corrected, geometry)
        findings += _level_findings(rows, levels)
        findings += filter_findings(rows, geometry)
    findings += _deviating_runs(corrected)
    return tuple(sorted(findings, key=lambda finding: finding.severity != FAULT))


def _is_moved_hub(
    rows: Sequence[ResponseRows], runs: Sequence[Evidence], geometry: Geometry, by_source: tuple[tuple[int, ...], ...]
) -> bool:
    """Whether a hub elsewhere explains all that looks like mistakes: a force beside it loads cells by other shares."""
    shift = hub_shift(runs, rig_size(geometry))
    if shift is None:
        return False
    moved = geometry.model_copy(update={"hub": tuple(np.asarray(geometry.hub) + shift)})
    mistakes, _ = find_mistakes(gather_evidence(rows, moved, balance_model(moved).system()), by_source)
    return not mistakes


def _frequency_findings(mismatch: FrequencyMismatch | None) -> list[ConsistencyFinding]:
    if mismatch is None:
        return []
    shown = mismatch.runs
    if mismatch.factor is None:
        text = f"computed and measured responses differ by a factor of {np.exp(mismatch.difference):.3g} on average"
        severity = FAULT if mismatch.difference > BEYOND_TOLERANCES else WARNING
        return [
            ConsistencyFinding(FREQUENCIES, severity, f"{text}: check masses, stiffness and positions", shown, True)
        ]
    cells = ", ".join(mismatch.cells)
    quantity = f"stiffness of {cells}" if cells else "ratio of stiffness to mass"
    hint = _unit_hint(mismatch.factor, bool(cells))
    text = f"the {quantity} is {mismatch.factor:.4g} times what the geometry declares{hint}"
    kind = STIFFNESS if mismatch.cells or abs(np.log10(mismatch.factor)) > 2.5 else FREQUENCIES
    return [ConsistencyFinding(kind, FAULT, text, shown, True, cells=mismatch.cells, factor=mismatch.factor)]


def _unit_hint(factor: float, only_stiffness: bool) -> str:
    """Return the unit that explains a factor of stiffness, or of its ratio to mass, of which either may be wrong."""
    if abs(np.log10(factor) - 3.0) < 0.15:
        return ": given in N/mm? It is in N/m" if only_stiffness else ": masses in g, or stiffness in N/mm?"
    return ": masses in t, or stiffness multiplied twice?" if abs(np.log10(factor) + 3.0) < 0.15 else ""


def _hub_findings(runs: Sequence[Evidence], geometry: Geometry) -> list[ConsistencyFinding]:
    shift = hub_shift(runs, rig_size(geometry))
    if shift is None:
        return []
    position = tuple(float(x) for x in np.asarray(geometry.hub) + shift)
    shown = ", ".join(f"{x:.2f}" for x in position)
    moved = ", ".join(f"{x:+.2f}" for x in shift)
    text = f"the forces act at ({shown}) m, ({moved}) m from the declared `hub`, by the moments that they make"
    names = tuple(run.run for run in runs if any(j < 3 for j in run.applied))
    return [ConsistencyFinding(HUB_POSITION, WARNING, text, names, True, position=position)]


def _level_findings(rows: Sequence[ResponseRows], levels: dict[str, tuple[float, ...]]) -> list[ConsistencyFinding]:
    """Sweeps whose loads are not of their stated level, where a unit explains it."""
    findings = []
    for run in rows:
        for name, level in zip(run.excited, levels.get(run.run, ()), strict=False):
            j = COMPONENTS.index(name)
            rms = float(np.sqrt(0.5 * np.sum(np.abs(run.loads[run.reference == j, j]) ** 2))) * 2.0
            ratio = rms / level if level > 0 else 1.0
            if rms == 0.0 or 1.0 / LARGEST_LEVEL_RATIO < ratio < LARGEST_LEVEL_RATIO:
                continue
            hint = suggest_units(ratio, FORCE_UNITS if j < 3 else MOMENT_UNITS)
            drift = " on the lines of the response, where a drift of the record does not count" if ratio < 1.0 else ""
            text = f"{name} has {ratio:.4g} times its stated `level`" + (f": {hint}" if hint else drift)
            findings.append(
                ConsistencyFinding(LEVEL, WARNING, text, (run.run,), components=(name,), factor=float(ratio))
            )
    return findings


def _deviating_runs(runs: Sequence[Evidence]) -> list[ConsistencyFinding]:
    """Check runs that are late, or respond otherwise than the sweeps at most lines, though no mistake explains it."""
    findings = []
    for run in runs:
        columns = list(run.applied)
        if run.rows.kind != "check" or not columns:
            continue
        predicted = np.einsum("kcj,kj->kc", run.reference[:, :, columns], run.loads[:, columns])
        known = np.isfinite(predicted).all(axis=1)
        measured = np.nan_to_num(run.forces[known])
        if known.sum() < FEWEST_LINES:
            continue
        delay = common_delay(run.rows.frequency[known], measured, predicted[known])
        if delay is not None:
            findings.append(_describe_delay(run.run, delay))
            continue
        size = np.linalg.norm(predicted[known], axis=1)
        deviation = float(np.median(np.linalg.norm(measured - predicted[known], axis=1) / np.maximum(size, 1e-300)))
        if deviation > LARGEST_DEVIATION:
            text = f"the channels differ by {100 * deviation:.0f} % from what the sweeps predict: another geometry?"
            findings.append(ConsistencyFinding(DIFFERENT_RIG, WARNING, text, (run.run,)))
    return findings


def _describe_delay(run: str, delay: float) -> ConsistencyFinding:
    when = "later" if delay > 0 else "earlier"
    text = f"the channels come {1e3 * abs(delay):.3g} ms {when} after the loads than in the sweeps"
    return ConsistencyFinding(DELAY, WARNING, f"{text}: another filter or clock of channels or loads?", (run,))
