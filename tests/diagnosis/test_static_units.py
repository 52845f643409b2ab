"""Static loads in other units than the file says, of rigs that are only calibrated: named, and sound loads are not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.equilibrium import equilibrium
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.diagnosis.consistency.findings import LOAD_FACTOR, WARNING
from balance_cli.io.units import FOOT, INCH, POUND_FORCE, STANDARD_GRAVITY
from balance_cli.simulation import Noise, draw_rig, simulate_campaign
from tests.support.other_rigs import RIGS, other_rig, short_campaign

UNITS = {
    "kgf and kgf m": (STANDARD_GRAVITY, STANDARD_GRAVITY, "are they in kgf"),
    "lbf and in lbf": (POUND_FORCE, POUND_FORCE * INCH, "are they in lbf"),
    "lbf and ft lbf": (POUND_FORCE, POUND_FORCE * FOOT, "are they in lbf"),
    "kN and kN m": (1e3, 1e3, "are they in kN"),
    "N declared as kN": (1e-3, 1e-3, "in N under a head of kN"),
    "N and N mm": (1.0, 1e-3, "are they in N mm"),
    "N and in lbf": (1.0, POUND_FORCE * INCH, "are they in in lbf"),
    "N and ft lbf": (1.0, POUND_FORCE * FOOT, "are they in ft lbf"),
    "lbf and N m": (POUND_FORCE, 1.0, "are they in lbf"),
}
"""N and N m of the units of forces and moments, and what is to be said."""
SHARES = np.array([0.95, 1.05, 1.0, 0.93, 1.02, 1.06])
"""Of the rated loads, to which balances are loaded."""


@cache
def statics(letter: str, seed: int = 1) -> tuple[Run, ...]:
    """Static runs of one of RIGS, drawn from its tolerances."""
    plan = short_campaign(letter)
    names = [run.run for run in plan.runs if run.kind == "static"]
    rig = draw_rig(other_rig(letter), np.random.default_rng([seed, 5]))
    return simulate_campaign(rig, plan.select_runs(names), Noise(), seed).runs


def calibrated_only(letter: str, sensitivity: dict[str, float] | None = None) -> Geometry:
    """Cells with places and sensitivities, some `sensitivity` times as large, but no mechanics."""
    content = geometry_to_dict(other_rig(letter))
    del content["bodies"], content["damping_ratio"]
    for cell in content["cells"]:
        cell.pop("stiffness", None)
        cell.pop("series", None)
    for channel in content["channels"]:
        channel["sensitivity"] *= (sensitivity or {}).get(channel.get("cell"), 1.0)
    return geometry_from_dict(content)


def rated_only(letter: str, runs: tuple[Run, ...], shares: np.ndarray) -> Geometry:
    """Channels of which nothing is known, and rated loads of which the runs have these shares."""
    largest = np.max([np.abs(run.read().loads).max(axis=0) for run in runs], axis=0)
    names = other_rig(letter).channel_names
    head = {"format": "balance-geometry/1", "name": "bridges", "rig": other_rig(letter).rig}
    return geometry_from_dict(
        {
            **head,
            "components": list(COMPONENTS),
            "channels": [{"name": name} for name in names],
            "rated_loads": dict(zip(COMPONENTS, (largest / shares).tolist(), strict=True)),
        }
    )


def in_units(runs: tuple[Run, ...], force: float, moment: float) -> tuple[Run, ...]:
    """The runs with loads in units of so many N and N m."""
    divisor = np.repeat([force, moment], 3)
    blocks = [run.read() for run in runs]
    return tuple(
        replace(run, source=MemorySource(block.channels, block.loads / divisor))
        for run, block in zip(runs, blocks, strict=True)
    )


@pytest.mark.parametrize("letter", ["A", "D"])
@pytest.mark.parametrize("unit", UNITS)
def test_declared_sensitivities_name_the_unit(unit: str, letter: str) -> None:
    force, moment, words = UNITS[unit]
    findings = campaign_findings(calibrated_only(letter), in_units(statics(letter), force, moment))
    assert findings and all(item.severity == WARNING and item.kind == LOAD_FACTOR for item in findings)
    assert words in findings[0].text, findings
    wrong = {name for name in COMPONENTS if (force if name[0] == "F" else moment) != 1.0}
    assert set().union(*(item.components for item in findings)) == wrong - ({"Mz"} if letter == "D" else set())
    for item in findings:
        assert item.factor == pytest.approx(1.0 / (force if item.components[0][0] == "F" else moment), rel=0.05)


@pytest.mark.parametrize("letter", RIGS)
def test_sound_loads_are_not_named(letter: str) -> None:
    for seed in (1, 2):
        runs = statics(letter, seed)
        assert campaign_findings(calibrated_only(letter), runs) == ()
        assert campaign_findings(rated_only(letter, runs, SHARES), runs) == ()


@pytest.mark.parametrize("factor", [1.0 / STANDARD_GRAVITY, POUND_FORCE, 1e3])
def test_one_cell_with_a_wrong_sensitivity_is_no_unit(factor: float) -> None:
    for letter in ("A", "D"):
        for cell in other_rig(letter).cell_names:
            assert campaign_findings(calibrated_only(letter, {cell: factor}), statics(letter)) == ()


def test_a_gain_of_all_channels_that_is_no_unit_is_none() -> None:
    gain = dict.fromkeys(other_rig("A").cell_names, 1.356)
    assert campaign_findings(calibrated_only("A", gain), statics("A")) == ()


@pytest.mark.parametrize("letter", ["A", "E"])
@pytest.mark.parametrize("unit", ["kgf and kgf m", "lbf and ft lbf", "kN and kN m", "lbf and in lbf"])
def test_rated_loads_name_the_unit_where_all_components_agree(unit: str, letter: str) -> None:
    force, moment, words = UNITS[unit]
    runs = statics(letter)
    (finding,) = campaign_findings(rated_only(letter, runs, SHARES), in_units(runs, force, moment))
    assert finding.severity == WARNING and words in finding.text
    shares = SHARES * [1.0, 1.0, 0.7, 1.0, 1.0, 1.0]
    assert campaign_findings(rated_only(letter, runs, shares), in_units(runs, force, moment)) == ()


@pytest.mark.parametrize(
    ("component", "factor", "words"),
    [
        (2, POUND_FORCE, "Fz was loaded to 0.225 of its rated load and the other components to 1"),
        (4, POUND_FORCE * INCH, "(loads in in lbf, not in N m?)"),
        (0, STANDARD_GRAVITY, "(loads in kgf, not in N?)"),
        (1, 1.0 / POUND_FORCE, "(a rated load in lbf, not in N?)"),
    ],
)
def test_rated_loads_name_the_unit_of_one_component(component: int, factor: float, words: str) -> None:
    """A component in lbf throughout is consistent with itself: its loads were 4.4 times too small in silence."""
    runs = statics("A")
    shares = np.array([0.99, 1.02, 1.0, 0.98, 1.0, 1.01])
    shares[component] = 1.0 / factor
    (finding,) = campaign_findings(rated_only("A", runs, shares), runs)
    assert finding.severity == WARNING and words in finding.text and finding.components == (COMPONENTS[component],)
    for sound in (0.25, 0.5, 0.7, 2.0):
        shares[component] = sound
        assert campaign_findings(rated_only("A", runs, shares), runs) == ()
    assert campaign_findings(rated_only("A", runs, np.array([0.9, 0.4, 0.6, 0.3, 0.1126, 0.7])), runs) == ()


def test_rated_loads_count_only_where_cells_do_not_tell() -> None:
    """A tenth of the rated loads is no unit where equilibrium says that it is right."""
    rig, runs = calibrated_only("A"), statics("A")
    rated = rated_only("A", runs, SHARES / STANDARD_GRAVITY)
    assert campaign_findings(rated, runs)
    assert campaign_findings(rig.model_copy(update={"rated_loads": rated.rated_loads}), runs) == ()


@pytest.mark.parametrize("letter", RIGS)
@pytest.mark.parametrize("unit", UNITS)
def test_with_mechanics_the_unit_is_named_too(unit: str, letter: str) -> None:
    """Of lbf with in lbf or ft lbf, of ft lbf and of kgf m some or all rigs had no finding, or a wrong torque meter."""
    force, moment, words = UNITS[unit]
    findings = campaign_findings(other_rig(letter), in_units(statics(letter), force, moment))
    assert any(words in item.text for item in findings), findings
    assert campaign_findings(other_rig(letter), statics(letter)) == ()


@pytest.mark.parametrize("factor", [0.0, 1e-300, 1e300])
def test_readings_without_meaning_have_no_unit(factor: float) -> None:
    for run in statics("A"):
        block = run.read()
        spoiled = replace(run, source=MemorySource(block.channels * factor, block.loads))
        assert campaign_findings(calibrated_only("A"), (spoiled,)) == ()


def test_equilibrium_needs_all_cells_of_a_load_and_sums_of_cells_serve() -> None:
    rig = calibrated_only("D")
    names = rig.channel_names
    assert equilibrium(rig, names).components == COMPONENTS[:5]
    without_x = equilibrium(rig, [name for name in names if name != "x.strain"])
    assert "Fx" not in without_x.components and "Fz" in without_x.components
    content = geometry_to_dict(calibrated_only("B"))
    cells = [cell["name"] for cell in content["cells"]]
    content["channels"] = [
        {"name": axis, "cells": {name: 1.0 for name in cells if name.endswith(axis)}, "sensitivity": 0.002}
        for axis in "xyz"
    ]
    sums = equilibrium(geometry_from_dict(content), "xyz")
    assert sums.components == ("Fx", "Fy", "Fz")
    np.testing.assert_allclose(sums.loads_per_reading, 500.0 * np.eye(3), atol=1e-9)
