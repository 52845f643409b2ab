"""`load-gain`: the force cell of an exciter reads too much or too little by the same factor.

    recorded load = gain (load of the exciter)

in sweeps and check runs; the weights of static runs do not go through this force cell. Each exciter is a set-up of its
own: a gain of all channels in the sweeps of one component is the inverse gain of its load.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, each_component, unit_components
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return (EffectParameter("gain", "1", 1.0, 0.01, "Recorded load over the load of the exciter.", lower=0.1),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    at = unit_components(where)
    return replace(equations, load_gain=equations.load_gain * (1.0 + (values["gain"] - 1.0) * at))


EFFECT = Effect(
    name="load-gain",
    summary="The sensitivity of an exciter's force cell differs from the declared one, or changed between set-ups.",
    validity="One factor for all frequencies and levels, in all sweeps and check runs of the component.",
    reference="McConnell and Varoto, Vibration Testing: Theory and Practice, 2nd ed., 2008, chapter 4 (force cells).",
    signature="All channels read a fixed factor too little or too much in the sweeps of one component, and only there.",
    separated_by="Hang a weight on the force cell. A gain of channels shows in all sweeps and at rest.",
    place="a load component",
    places=each_component,
    parameters=_parameters,
    apply=_apply,
    is_load_gain=True,
)
