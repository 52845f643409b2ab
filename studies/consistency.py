"""Campaigns that are plausible and wrong: what the cross-checks notice, name, and do with the loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import geometry_faults
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
from balance_cli.diagnosis.consistency.severity import (
    findings_for_command,
    identified_anyway,
    known_anyway,
    measured_anyway,
)
from balance_cli.signals.rotor.pulse_consistency import pulse_faults

Array = NDArray[np.float64]
Campaign = tuple[Geometry, tuple[Run, ...]]
COMMANDS = {
    "calibrate": (("static",), measured_anyway),
    "sweep-tf": (("sweep",), measured_anyway),
    "identify": (("static", "sweep"), identified_anyway),
    "reduce": (("check",), known_anyway),
}


@dataclass(frozen=True)
class WrongCampaign:
    """What was done to a campaign, the words that should name it, and how it is done."""

    name: str
    expected: str
    spoil: Callable[[Geometry, tuple[Run, ...]], Campaign]


def every(run: Run) -> bool:
    """All runs."""
    return True


def named(*parts: str) -> Callable[[Run], bool]:
    """Runs whose name has one of these parts."""
    return lambda run: any(part in run.name for part in parts)


def _with_samples(run: Run, channels: Array | None = None, loads: Array | None = None) -> Run:
    block = run.read()
    source = MemorySource(block.channels if channels is None else channels, block.loads if loads is None else loads)
    return replace(run, source=source)


def scale_channels(select: Callable[[Run], bool], factor: float, *names: str) -> Callable[..., Campaign]:
    """Multiply channels (all where none is named) of the selected runs."""

    def spoil(geometry: Geometry, runs: tuple[Run, ...]) -> Campaign:
        def change(run: Run) -> Run:
            values = run.read().channels.copy()
            columns = [i for i, name in enumerate(run.channel_names) if not names or name in names]
            values[:, columns] *= factor
            return _with_samples(run, channels=values)

        return geometry, tuple(change(run) if select(run) else run for run in runs)

    return spoil


def exchange_channels(select: Callable[[Run], bool], *pairs: tuple[str, str]) -> Callable[..., Campaign]:
    """Exchange pairs of channels in the selected runs, as exchanged plugs do."""

    def spoil(geometry: Geometry, runs: tuple[Run, ...]) -> Campaign:
        def change(run: Run) -> Run:
            values = run.read().channels.copy()
            for first, second in pairs:
                if {first, second} <= set(run.channel_names):
                    i, j = run.channel_names.index(first), run.channel_names.index(second)
                    values[:, [i, j]] = values[:, [j, i]]
            return _with_samples(run, channels=values)

        return geometry, tuple(change(run) if select(run) else run for run in runs)

    return spoil


def scale_loads(select: Callable[[Run], bool], factor: float, *names: str) -> Callable[..., Campaign]:
    """Multiply load components (all where none is named) of the selected runs."""

    def spoil(geometry: Geometry, runs: tuple[Run, ...]) -> Campaign:
        def change(run: Run) -> Run:
            loads = run.read().loads
            assert loads is not None
            columns = [COMPONENTS.index(name) for name in names or COMPONENTS]
            changed = loads.copy()
            changed[:, columns] *= factor
            return _with_samples(run, loads=changed)

        return geometry, tuple(change(run) if select(run) and run.has_loads else run for run in runs)

    return spoil


def exchange_loads(select: Callable[[Run], bool], first: str, second: str) -> Callable[..., Campaign]:
    """Exchange two load components of the selected runs, and what the sweeps say is excited."""

    def spoil(geometry: Geometry, runs: tuple[Run, ...]) -> Campaign:
        swap = {first: second, second: first}

        def change(run: Run) -> Run:
            loads = run.read().loads
            assert loads is not None
            order = [COMPONENTS.index(swap.get(name, name)) for name in COMPONENTS]
            excited = tuple(swap.get(name, name) for name in run.excited)
            return replace(_with_samples(run, loads=loads[:, order]), excited=excited)

        return geometry, tuple(change(run) if select(run) and run.has_loads else run for run in runs)

    return spoil


def change_geometry(change: Callable[[dict[str, Any]], None]) -> Callable[..., Campaign]:
    """Declare something else; the runs remain."""

    def spoil(geometry: Geometry, runs: tuple[Run, ...]) -> Campaign:
        content = geometry.model_dump(mode="json")
        change(content)
        return Geometry.model_validate(content), runs

    return spoil


def change_pulses(change: Callable[[Run], Run]) -> Callable[..., Campaign]:
    """Change the check runs."""

    def spoil(geometry: Geometry, runs: tuple[Run, ...]) -> Campaign:
        return geometry, tuple(change(run) if run.kind == "check" else run for run in runs)

    return spoil


@dataclass(frozen=True)
class Outcome:
    """What the commands do: `said` in words, and of each command `refused`, `warned` or nothing."""

    said: str
    commands: dict[str, str]


def judge(geometry: Geometry, runs: Sequence[Run]) -> Outcome:
    """Pass a campaign to the checks of all commands."""
    faults = list(geometry_faults(geometry))
    if faults:
        refused = dict.fromkeys(("check", *COMMANDS), "refused")
        return Outcome(f"{faults[0].place} {faults[0].fault}", refused)
    findings = campaign_findings(geometry, runs)
    pulses = [fault.fault for run in runs for fault in pulse_faults(run)]
    said = "; ".join([*pulses[:1], *(finding.sentence for finding in findings)])
    commands = {"check": "refused" if pulses else _word(findings)}
    for command, (kinds, rule) in COMMANDS.items():
        own = [run for run in runs if run.kind in kinds]
        word = _word(findings_for_command(campaign_findings(geometry, own), rule))
        commands[command] = "refused" if command == "reduce" and pulses else word
    return Outcome(said, commands)


def _word(findings: Sequence[ConsistencyFinding]) -> str:
    if any(finding.is_fault for finding in findings):
        return "refused"
    return "warned" if findings else ""


def consistency_table(geometry: Geometry, runs: tuple[Run, ...], cases: Sequence[WrongCampaign]) -> pd.DataFrame:
    """One row for each wrong campaign."""
    rows = []
    for case in cases:
        outcome = judge(*case.spoil(geometry, runs))
        right = bool(case.expected) and all(word in outcome.said for word in case.expected.split("|"))
        rows.append(
            {"campaign": case.name, "named": "yes" if right else "no", "said": outcome.said, **outcome.commands}
        )
    return pd.DataFrame(rows)


MARKER, END = "<!-- table: consistency -->", "<!-- end of table -->"
LONGEST_TEXT = 150


def table_in_page(table: pd.DataFrame, page: Path) -> None:
    """Write the table between the markers of a page."""
    text = page.read_text(encoding="utf-8")
    head, _, rest = text.partition(MARKER)
    lines = ["", "| campaign | named | what is said first | check | calibrate | sweep-tf | identify | reduce |"]
    lines.append("|" + "---|" * 8)
    for row in table.to_dict("records"):
        said = str(row["said"]).split("; ")[0]
        shown = said if len(said) <= LONGEST_TEXT else said[:LONGEST_TEXT].rsplit(" ", 1)[0] + " ..."
        cells = [row["campaign"], row["named"], shown, *(row[command] for command in ("check", *COMMANDS))]
        lines.append("| " + " | ".join(str(cell).replace("|", "/") for cell in cells) + " |")
    page.write_text(head + MARKER + "\n".join([*lines, ""]) + END + rest.partition(END)[2], encoding="utf-8")
