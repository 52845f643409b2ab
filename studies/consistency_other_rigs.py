"""The wrong campaigns on rigs without a second channel in each cell: six inclined cells, and piezo channels alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from studies.consistency import (
    WrongCampaign,
    change_geometry,
    every,
    exchange_channels,
    named,
    scale_channels,
)
from studies.consistency_cases import GEOMETRY_CASES, LOAD_CASES, ONE, ROTOR_CASES, STATICS

OTHER_RIGS = ("inclined", "piezo")
OF_THE_SAMPLE_RIG = ("cell", "a body at", "torque meter", "cutoff")
"""Words of the cases of a geometry that name parts of the sample rig."""


def _shifted_body(content: dict[str, Any]) -> None:
    content["bodies"][-1]["position"][2] *= 1e3


def _reversed_axis(index: int) -> Any:
    def change(content: dict[str, Any]) -> None:
        content["cells"][index]["axis"] = [-x for x in content["cells"][index]["axis"]]

    return change_geometry(change)


def _exchanged_positions(first: int, second: int) -> Any:
    def change(content: dict[str, Any]) -> None:
        cells = content["cells"]
        for key in ("position", "axis"):
            cells[first][key], cells[second][key] = cells[second][key], cells[first][key]

    return change_geometry(change)


def _soft_cell(index: int) -> Any:
    def change(content: dict[str, Any]) -> None:
        content["cells"][index]["stiffness"] *= 1e-3

    return change_geometry(change)


def single_channel_cases(a: str, b: str, suffix: str, index: int, other: int) -> tuple[WrongCampaign, ...]:
    """Cases of cells `a` and `b`, numbers `index` and `other` of the geometry, with one channel each."""
    first, second = f"{a}.{suffix}", f"{b}.{suffix}"
    pair = f"{first} and {second} are exchanged"
    return (
        WrongCampaign(
            "two channels exchanged in one sweep", f"{pair}|sweep-Fx", exchange_channels(ONE, (first, second))
        ),
        WrongCampaign(
            "two channels exchanged in all runs", f"{a}|{b}|exchanged", exchange_channels(every, (first, second))
        ),
        WrongCampaign(
            "two channels exchanged in a check run",
            f"{pair}|check-1",
            exchange_channels(named("check-1"), (first, second)),
        ),
        WrongCampaign(
            "one channel reversed in one sweep", f"{first} is reversed|sweep-Fx", scale_channels(ONE, -1.0, first)
        ),
        WrongCampaign("one channel reversed in all runs", f"{first} is reversed", scale_channels(every, -1.0, first)),
        WrongCampaign("all channels reversed in all runs", "all channels are reversed", scale_channels(every, -1.0)),
        WrongCampaign("all channels reversed in one sweep", "is reversed|sweep-Fx", scale_channels(ONE, -1.0)),
        WrongCampaign("all channels in mV in all runs", "in mV|channels", scale_channels(every, 1e3)),
        WrongCampaign("one channel in mV in all runs", f"{first}|in mV", scale_channels(every, 1e3, first)),
        WrongCampaign("one channel in mV in one sweep", f"{first}|in mV|sweep-Fx", scale_channels(ONE, 1e3, first)),
        WrongCampaign(
            "amplifier of one channel set to 1.5 times its gain", f"{first} reads 1.", scale_channels(every, 1.5, first)
        ),
        WrongCampaign("axis of a cell reversed in the geometry", f"{a}|reversed", _reversed_axis(index)),
        WrongCampaign("two cells exchanged in the geometry", f"{a}|{b}|exchanged", _exchanged_positions(index, other)),
        WrongCampaign("stiffness of one cell in N/mm", f"stiffness of {a}|N/mm", _soft_cell(index)),
        WrongCampaign("a body 1000 times as high (mm)", ".position|mm", change_geometry(_shifted_body)),
    )


def other_cases(rig: str) -> tuple[WrongCampaign, ...]:
    """Cases of one of OTHER_RIGS."""
    if rig == "inclined":
        own = single_channel_cases("c1", "c4", "strain", 0, 3)
        own += (WrongCampaign("all channels in mV in the static runs", "static-bare|mV", scale_channels(STATICS, 1e3)),)
    else:
        own = single_channel_cases("z1", "z3", "piezo", 3, 5)
    shared = [case for case in GEOMETRY_CASES if not any(word in case.name for word in OF_THE_SAMPLE_RIG)]
    shared += [case for case in GEOMETRY_CASES if "all cells" in case.name]
    loads = [case for case in LOAD_CASES if rig == "inclined" or "static" not in case.name]
    if rig == "piezo":  # only two of its runs have a vertical force
        loads = [replace(case, expected=case.expected.replace("|all", "|sweep-Fz")) for case in loads]
    return (*own, *loads, *shared, *ROTOR_CASES)
