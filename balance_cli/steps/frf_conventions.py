"""Signs and phases of measured responses: the direction of the excitation, and which way the phase turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.frf_map import MappedReference
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.importers.frf.functions import Terminal
from balance_cli.io.errors import UserError
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]

AXIS_OF = {"Fx": "X", "Fy": "Y", "Fz": "Z", "Mx": "RX", "My": "RY", "Mz": "RZ"}
"""Direction of a universal file that is along each component, where its axes are those of the rig."""
ROUNDING = 1e-9
"""Of the largest share of a force in a load, below which it is rounding."""
CLEAR_SIGMAS = 8.0
"""Standard deviations of noise by which the sense of the phase must be known to contradict what is stated."""
LEAST_TURN = 1e-3
"""Mean turn [rad] from line to line, weighted by power, below which a response tells no sense: a stiff rig far
below its modes."""


def load_multiples(name: str, mapped: MappedReference, terminal: Terminal, hub: Sequence[float]) -> tuple[Array, str]:
    """Return the hub loads (6,) for one N (or N m) of a reference, and a note where its sign is that of the file.

    Raises UserError where the direction in the file is not that of the map, which states no sign.
    """
    if mapped.component is not None:
        multiples = np.zeros(len(COMPONENTS))
        multiples[COMPONENTS.index(mapped.component)] = 1.0
        along = AXIS_OF[mapped.component]
    else:
        assert mapped.position is not None and mapped.direction is not None
        direction = np.asarray(mapped.direction, float) / np.linalg.norm(mapped.direction)
        moment = np.cross(np.asarray(mapped.position, float) - np.asarray(hub, float), direction)
        multiples = np.concatenate([direction, moment])
        multiples[np.abs(multiples) < ROUNDING * np.abs(multiples).max()] = 0.0
        along = "XYZ"[int(np.argmax(np.abs(direction)))]
    if mapped.sign is not None or not terminal.direction:
        return (mapped.sign or 1) * multiples, ""
    stated, axis = terminal.direction[0], terminal.direction[1:]
    if axis != along:
        fault = f"the force of `{terminal.name}` is along {terminal.direction}, that of the map along {along}"
        remedy = "Where the axes of the file are other ones, state `sign` of the reference in the map"
        raise UserError(fault, place=f"references.{name}", remedy=remedy)
    if mapped.component is not None:
        note = f"the force of `{terminal.name}` is along {terminal.direction}: taken as -{mapped.component}"
        return (-multiples, note) if stated == "-" else (multiples, "")
    if (stated == "-") != (multiples["XYZ".index(along)] < 0.0):
        fault = f"the force of `{terminal.name}` is along {terminal.direction}, its `direction` in the map is opposite"
        raise UserError(fault, place=f"references.{name}", remedy="Reverse `direction`, or state `sign`")
    return multiples, ""


def require_causal(responses: Sequence[FrequencyResponse], convention: str) -> None:
    """Raise UserError where the phases rise with frequency on the whole: those of the other time convention.

    The mean delay of a causal response, weighted by its power, is positive: its integral over frequency is that of
    t h(t)^2 over time, by Parseval. Each peak turns the phase by half a revolution.
    """
    turn = variance = power = 0.0
    for item in responses:
        value, beside = item.response[:-1], item.response[1:]
        sigma = np.diagonal(item.channel_covariance, axis1=1, axis2=2).real[:, :, None] * item.load_covariance.real
        # Channels count alike, whatever their unit.
        weight = 1.0 / np.maximum(np.mean(np.abs(item.response) ** 2, axis=0), np.finfo(float).tiny)
        turn += float(np.sum(weight * (value.conj() * beside).imag))
        variance += float(np.sum(weight**2 * (np.abs(value) ** 2 * sigma[1:] + np.abs(beside) ** 2 * sigma[:-1]))) / 2.0
        power += float(np.sum(weight * np.abs(value) ** 2))
    if turn > max(CLEAR_SIGMAS * np.sqrt(variance), LEAST_TURN * power):
        other = "exp(-jwt)" if convention == "exp(+jwt)" else "exp(+jwt)"
        fault = f"the phases of the responses rise with frequency, which those of {convention} of a rig cannot"
        remedy = f"Are they of {other}, or conjugated? State `time_convention: {other}`, or exchange output and input"
        raise UserError(fault, place="time_convention", remedy=remedy)
