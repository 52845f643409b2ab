"""The wrong campaigns of the study of cross-checks, on the sample rig."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from balance_cli.campaign.recording.run import Run
from studies.consistency import (
    WrongCampaign,
    change_geometry,
    change_pulses,
    every,
    exchange_channels,
    exchange_loads,
    named,
    scale_channels,
    scale_loads,
)

POUND, INCH = 4.4482216, 0.0254
CABLES = (("z1.strain", "z2.strain"), ("z1.piezo", "z2.piezo"))
ONE = named("sweep-Fx-low")
STATICS, CHECKS = named("static"), named("check")


def _hub(content: dict[str, Any], shift: tuple[float, float, float]) -> None:
    content["hub"] = [float(x) for x in np.add(content["hub"], shift)]


def _axis(content: dict[str, Any]) -> None:
    content["cells"][3]["axis"] = [0.0, 0.0, -1.0]


def _stiffness(content: dict[str, Any], factor: float, *names: str) -> None:
    for cell in content["cells"]:
        if not names or cell["name"] in names:
            cell["stiffness"] *= factor


def _masses(content: dict[str, Any]) -> None:
    for body in content["bodies"]:
        body["mass"] *= 1e3


def _body_in_mm(content: dict[str, Any]) -> None:
    content["bodies"][3]["position"][2] *= 1e3


def _positions_in_mm(content: dict[str, Any]) -> None:
    content["hub"] = [1e3 * x for x in content["hub"]]
    for part in (*content["bodies"], *content["cells"]):
        part["position"] = [1e3 * x for x in part["position"]]


def _positions_exchanged(content: dict[str, Any]) -> None:
    first, third = content["cells"][3], content["cells"][5]
    first["position"], third["position"] = third["position"], first["position"]


def _cutoff(content: dict[str, Any]) -> None:
    content["acquisition"]["filter"]["cutoff"] = 100.0


def _torque(content: dict[str, Any]) -> None:
    content["channels"][-1]["sensitivity"] *= 1e-3


def _pulses(every_nth: int) -> Any:
    return change_pulses(lambda run: replace(run, pulse_times=_times(run)[::every_nth]))


def _times(run: Run) -> Any:
    assert run.pulse_times is not None
    return run.pulse_times


def _more_pulses(run: Run) -> Run:
    times = _times(run)
    steps = np.diff(times)[:, None] * np.arange(4) / 4
    return replace(run, pulse_times=(times[:-1, None] + steps).ravel())


def _half_covered(run: Run) -> Run:
    times = _times(run)
    return replace(run, pulse_times=times[: len(times) // 2])


def _rate(factor: float) -> Any:
    return change_pulses(lambda run: replace(run, sample_rate=factor * (run.sample_rate or 1.0)))


def _speed(factor: float) -> Any:
    return change_pulses(lambda run: replace(run, rotor_speed=factor * run.rotor_speed))


CHANNEL_CASES = (
    WrongCampaign(
        "two piezo channels exchanged in one sweep", "exchanged|.piezo|sweep-Fx", exchange_channels(ONE, CABLES[1])
    ),
    WrongCampaign(
        "two piezo channels exchanged in all runs",
        "z1.piezo and z2.piezo are exchanged|all",
        exchange_channels(every, CABLES[1]),
    ),
    WrongCampaign("both channels of two cells exchanged", "z1 and z2 are exchanged", exchange_channels(every, *CABLES)),
    WrongCampaign(
        "strain and piezo channels of two cells exchanged",
        "x.strain and z1.piezo are exchanged",
        exchange_channels(every, ("x.strain", "z1.piezo")),
    ),
    WrongCampaign(
        "two strain channels exchanged in a static run",
        "z1.strain and z3.strain are exchanged|static-bare",
        exchange_channels(named("static-bare"), ("z1.strain", "z3.strain")),
    ),
    WrongCampaign(
        "two strain channels exchanged in a check run",
        "z1.strain and z3.strain are exchanged|check-1",
        exchange_channels(named("check-1"), ("z1.strain", "z3.strain")),
    ),
    WrongCampaign(
        "one channel reversed in one sweep",
        "z1.strain is reversed|sweep-Fx-low",
        scale_channels(ONE, -1.0, "z1.strain"),
    ),
    WrongCampaign(
        "one channel reversed in all runs", "z1.strain is reversed|all", scale_channels(every, -1.0, "z1.strain")
    ),
    WrongCampaign(
        "both channels of a cell reversed",
        "z1.strain and z1.piezo are reversed",
        scale_channels(every, -1.0, "z1.strain", "z1.piezo"),
    ),
    WrongCampaign("all channels reversed in all runs", "all channels are reversed", scale_channels(every, -1.0)),
    WrongCampaign("all channels reversed in one sweep", "is reversed|sweep-Fx-low", scale_channels(ONE, -1.0)),
    WrongCampaign("torque channel reversed", "torque is reversed", scale_channels(every, -1.0, "torque")),
    WrongCampaign("all channels in mV in all runs", "in mV", scale_channels(every, 1e3)),
    WrongCampaign("all channels in mV in the static runs", "static-bare|mV", scale_channels(STATICS, 1e3)),
    WrongCampaign("one channel in mV in all runs", "z1.piezo|in mV|all", scale_channels(every, 1e3, "z1.piezo")),
    WrongCampaign(
        "one channel in mV in one sweep", "z1.piezo|in mV|sweep-Fx-low", scale_channels(ONE, 1e3, "z1.piezo")
    ),
    WrongCampaign(
        "amplifier of one channel set to 1.2 times its gain",
        "z1.piezo reads 1.2 times",
        scale_channels(every, 1.2, "z1.piezo"),
    ),
)
LOAD_CASES = (
    WrongCampaign("loads in kN and kN m in all runs", "in kN", scale_loads(every, 1e-3)),
    WrongCampaign("loads in kN in one sweep", "load Fx is|in kN|sweep-Fx-low", scale_loads(ONE, 1e-3)),
    WrongCampaign("forces in lbf", "Fx, Fy, Fz|in lbf", scale_loads(every, 1 / POUND, "Fx", "Fy", "Fz")),
    WrongCampaign("moments in kN m", "Mx, My, Mz|in kN m", scale_loads(every, 1e-3, "Mx", "My", "Mz")),
    WrongCampaign(
        "moments in inch pounds", "Mx, My, Mz|in in lbf", scale_loads(every, 1 / (POUND * INCH), "Mx", "My", "Mz")
    ),
    WrongCampaign("lift reversed in all runs", "load Fz is reversed|all", scale_loads(every, -1.0, "Fz")),
    WrongCampaign(
        "lift reversed in a static run",
        "load Fz is reversed|static-bare",
        scale_loads(named("static-bare"), -1.0, "Fz"),
    ),
    WrongCampaign("Fx and Fy exchanged in all runs", "Fx and Fy are exchanged", exchange_loads(every, "Fx", "Fy")),
    WrongCampaign(
        "Mx and My exchanged in the static runs",
        "Mx and My are exchanged|static-bare",
        exchange_loads(STATICS, "Mx", "My"),
    ),
    WrongCampaign("loads of the check runs reversed", "all loads|check-1", scale_loads(CHECKS, -1.0)),
    WrongCampaign("loads of the check runs in kN", "in kN|check-1", scale_loads(CHECKS, 1e-3)),
)
GEOMETRY_CASES = (
    WrongCampaign(
        "hub declared 0.1 m too low",
        "declared `hub`|+0.1",
        change_geometry(lambda content: _hub(content, (0, 0, -0.1))),
    ),
    WrongCampaign(
        "hub declared 0.1 m aside", "declared `hub`|-0.1", change_geometry(lambda content: _hub(content, (0.1, 0, 0)))
    ),
    WrongCampaign("axis of a cell reversed in the geometry", "axis of cell z1", change_geometry(_axis)),
    WrongCampaign(
        "positions of two cells exchanged in the geometry",
        "z1 and z3 are exchanged",
        change_geometry(_positions_exchanged),
    ),
    WrongCampaign("a body at 620 m (mm)", "bodies[3].position|mm", change_geometry(_body_in_mm)),
    WrongCampaign("all positions in mm", "mm", change_geometry(_positions_in_mm)),
    WrongCampaign(
        "stiffness of all cells in N/mm", "1000 times|N/mm", change_geometry(lambda content: _stiffness(content, 1e-3))
    ),
    WrongCampaign(
        "stiffness of one cell in N/mm",
        "stiffness of z1|N/mm",
        change_geometry(lambda content: _stiffness(content, 1e-3, "z1")),
    ),
    WrongCampaign(
        "stiffness of the x cell in N/mm",
        "stiffness of x|N/mm",
        change_geometry(lambda content: _stiffness(content, 1e-3, "x")),
    ),
    WrongCampaign("masses in g", "masses", change_geometry(_masses)),
    WrongCampaign("sensitivity of the torque meter per mV", "torque reads|in mV", change_geometry(_torque)),
    WrongCampaign("anti-alias cutoff of 100 Hz declared", "beyond the cutoff", change_geometry(_cutoff)),
)
ROTOR_CASES = (
    WrongCampaign("pulses every second revolution", "once in 2 revolutions", _pulses(2)),
    WrongCampaign("pulses every fourth revolution", "once in 4 revolutions", _pulses(4)),
    WrongCampaign("four pulses a revolution", "4 times in each revolution", change_pulses(_more_pulses)),
    WrongCampaign("pulses end at half of the record", "pulses cover", change_pulses(_half_covered)),
    WrongCampaign("sample rate 1 % too high", "lines at multiples", _rate(1.01)),
    WrongCampaign("sample rate doubled", "pulses cover", _rate(2.0)),
    WrongCampaign("rotor speed doubled", "once in 2 revolutions", _speed(2.0)),
    WrongCampaign("rotor speed in 1/min", "1/min", _speed(60.0)),
)
CASES = (*CHANNEL_CASES, *LOAD_CASES, *GEOMETRY_CASES, *ROTOR_CASES)
