"""Cross-checks of a campaign: mistakes are named, true effects and clean campaigns are not mistaken for them."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run, pick_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import geometry_faults
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.diagnosis.consistency.findings import ANTI_ALIAS, FAULT, HUB_POSITION, WARNING
from balance_cli.diagnosis.consistency.severity import findings_for_command, identified_anyway, measured_anyway
from balance_cli.diagnosis.consistency.units import MOMENT_UNITS, suggest_units
from balance_cli.simulation import CampaignPlan, Noise, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.plans import StaticPlan
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, STATIC_LOAD_LIMITS
from studies.consistency import (
    change_geometry,
    every,
    exchange_channels,
    exchange_loads,
    named,
    scale_channels,
    scale_loads,
)
from tests.support.rigs import rotor_balance

ONE_DOF = Path(__file__).parents[2] / "configs" / "one-dof.yaml"
Spoil = Callable[..., tuple[Geometry, tuple[Run, ...]]]


@cache
def campaign() -> tuple[Run, ...]:
    sweeps = [
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(HIGH_SWEEP_LEVELS[name],), period=2.0, periods=4)
        for name in ("Fx", "Fy", "Fz")
    ]
    low = sweeps[0].model_copy(update={"run": "sweep-Fx-low", "level": (16.0,)})
    static = StaticPlan(run="static-bare", largest=STATIC_LOAD_LIMITS, steps=2)
    plan = CampaignPlan(runs=(static, *sweeps, low))
    return simulate_campaign(true_rig(rotor_balance()), plan, Noise(), 3).runs


def hub_lowered(content: dict[str, object]) -> None:
    content["hub"] = [0.0, 0.0, 0.68]


def softened(content: dict[str, list[dict[str, float]]]) -> None:
    for cell in content["cells"]:
        cell["stiffness"] *= 1e-3


@pytest.mark.parametrize("name", ["static-bare", "sweep-Fz"])
def test_a_record_under_two_names_is_a_fault(name: str) -> None:
    run = next(run for run in campaign() if run.name == name)
    (finding,) = campaign_findings(rotor_balance(), (*campaign(), replace(run, name="copy", trim="other")))
    assert finding.is_fault and finding.runs == ("copy",) and f"those of {name} in every digit" in finding.sentence


def test_a_clean_campaign_has_no_finding() -> None:
    assert campaign_findings(rotor_balance(), campaign()) == ()


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (
            exchange_channels(named("low"), ("z1.piezo", "z2.piezo")),
            "z1.piezo and z2.piezo are exchanged in sweep-Fx-low",
        ),
        (scale_channels(every, -1.0, "z1.strain"), "z1.strain is reversed in all"),
        (scale_channels(every, 1e3), "are they in mV"),
        (scale_loads(every, -1.0, "Fz"), "the load Fz is reversed in all"),
        (scale_loads(named("low"), 1 / 4.4482216), "are they in lbf? in sweep-Fx-low"),
        (exchange_loads(named("static"), "Mx", "My"), "the loads Mx and My are exchanged in static-bare"),
        (change_geometry(softened), "given in N/mm"),
    ],
)
def test_a_mistake_is_a_fault_and_named(spoil: Spoil, text: str) -> None:
    findings = campaign_findings(*spoil(rotor_balance(), campaign()))
    assert len(findings) == 1
    assert findings[0].severity == FAULT
    assert text in findings[0].sentence


TURNS = {
    "z down": ((1, -2, -3, 4, -5, -6), "Fy, Fz, My, Mz of the rig are -Fy, -Fz, -My, -Mz"),
    "half a turn about z": ((-1, -2, 3, -4, -5, 6), "Fx, Fy, Mx, My of the rig are -Fx, -Fy, -Mx, -My"),
    "a quarter turn about z": ((2, -1, 3, 5, -4, 6), "Fx, Fy, Mx, My of the rig are -Fy, Fx, -My, Mx"),
    "lift and pitch reversed": ((1, 2, -3, 4, -5, 6), "Fz, My of the rig are -Fz, -My"),
}


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("select", [named("static"), every])
def test_loads_in_other_axes_are_named(turn: str, select: Callable[[Run], bool]) -> None:
    """Of static runs a quarter turn had no finding at all; the others were channels reversed or exchanged."""
    index, words = TURNS[turn]
    order, sign = np.abs(index) - 1, np.sign(index)

    def change(run: Run) -> Run:
        block = run.read()
        excited = tuple(COMPONENTS[int(np.flatnonzero(order == COMPONENTS.index(name))[0])] for name in run.excited)
        return replace(run, source=MemorySource(block.channels, sign * block.loads[:, order]), excited=excited)

    runs = tuple(change(run) if select(run) else run for run in campaign())
    findings = [finding for finding in campaign_findings(rotor_balance(), runs) if finding.is_fault]
    assert len(findings) == 1 and words in findings[0].sentence, findings


def test_a_gain_is_a_warning_with_its_factor() -> None:
    findings = campaign_findings(*scale_channels(every, 1.2, "z1.piezo")(rotor_balance(), campaign()))
    assert [(finding.severity, finding.channels) for finding in findings] == [(WARNING, ("z1.piezo",))]
    assert findings[0].factor == pytest.approx(1.2, rel=1e-2)


def test_the_hub_is_found_where_the_forces_act() -> None:
    (finding,) = campaign_findings(*change_geometry(hub_lowered)(rotor_balance(), campaign()))
    assert (finding.kind, finding.severity) == (HUB_POSITION, WARNING)
    assert np.allclose(finding.position, rotor_balance().hub, atol=0.01)


def test_the_hub_is_found_by_static_runs_alone() -> None:
    """Lowered by 0.1 m it had passed, as the moments of the forces are small beside the vertical loads of the cells."""
    geometry, runs = change_geometry(hub_lowered)(rotor_balance(), campaign())
    statics = [run for run in runs if run.kind == "static"]
    (finding,) = campaign_findings(geometry, statics)
    assert finding.kind == HUB_POSITION and np.allclose(finding.position, rotor_balance().hub, atol=0.01)
    assert campaign_findings(rotor_balance(), statics) == ()


def test_sweeps_of_loads_that_the_rig_does_not_feel_contradict_nothing() -> None:
    geometry = load_geometry(ONE_DOF)
    sweeps = tuple(
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(20.0,), period=1.0, periods=4)
        for name in ("Fx", "Fz", "Mz")
    )
    runs = simulate_campaign(true_rig(geometry), CampaignPlan(runs=sweeps), Noise(), 1).runs
    assert campaign_findings(geometry, runs) == ()


def test_sums_of_cells_that_cancel_contradict_nothing() -> None:
    # Both bridges read 7 % of what their cells feel of a vertical force, by errors of stiffness within the tolerance.
    names = [f"z{i}.strain" for i in (1, 2, 3, 4)]
    weights = {"pitch": (1.0, 1.0, -1.0, -1.0), "roll": (1.0, -1.0, -1.0, 1.0)}
    content = rotor_balance().model_dump(mode="json")
    content["channels"] = [
        {"name": name, "cells": {f"z{i + 1}": w for i, w in enumerate(row)}, "sensitivity": 0.002, "lowpass": 90.0}
        for name, row in weights.items()
    ]
    for cell, factor in zip(content["cells"][3:], (1.05, 0.93, 0.93, 1.08), strict=True):
        cell["stiffness"] *= factor
    runs = tuple(
        replace(run, channel_names=tuple(weights), source=MemorySource(values, run.read().loads))
        for run in campaign()
        for values in [pick_channels(run.read().channels, run.channel_names, names) @ np.array([*weights.values()]).T]
    )
    assert campaign_findings(Geometry.model_validate(content), runs) == ()


def test_what_a_command_measures_itself_is_no_fault_there() -> None:
    everywhere = campaign_findings(*scale_channels(every, 1e3, "z1.piezo")(rotor_balance(), campaign()))
    assert everywhere[0].is_fault
    for rule in (measured_anyway, identified_anyway):
        assert not findings_for_command(everywhere, rule)[0].is_fault
    loads = campaign_findings(*scale_loads(every, -1.0, "Fz")(rotor_balance(), campaign()))
    assert findings_for_command(loads, measured_anyway)[0].is_fault


def test_positions_in_millimeters_are_faults_of_the_geometry() -> None:
    content = rotor_balance().model_dump(mode="json")
    content["bodies"][3]["position"][2] *= 1e3
    (fault,) = geometry_faults(Geometry.model_validate(content))
    assert (fault.place, fault.remedy) == ("bodies[3].position", "Positions are in m")


def test_inch_pounds_are_recognized() -> None:
    assert "in lbf" in suggest_units(1.0 / 0.112985, MOMENT_UNITS)


def cutoff_halved(content: dict[str, dict[str, dict[str, float]]]) -> None:
    content["acquisition"]["filter"]["cutoff"] = 100.0


def test_sweeps_beyond_the_declared_cutoff_show_a_filter_that_is_not_there() -> None:
    """The sweeps go to 150 Hz. Through a filter of 100 Hz, a sixth of their loads would be left there."""
    geometry, runs = change_geometry(cutoff_halved)(rotor_balance(), campaign())
    (finding,) = campaign_findings(geometry, runs)
    assert (finding.kind, finding.severity) == (ANTI_ALIAS, WARNING)
    plan = CampaignPlan(runs=tuple(_sweep(name) for name in ("Fx", "Fy")))
    filtered = simulate_campaign(true_rig(geometry), plan, Noise(), 3).runs
    assert campaign_findings(geometry, filtered) == ()


def _sweep(name: str) -> SweepPlan:
    return SweepPlan(run=f"sweep-{name}", excited=(name,), level=(HIGH_SWEEP_LEVELS[name],), period=2.0, periods=4)
