"""`exciter-low-pass`: an exciter follows what is recorded as its load like a low-pass of first or second order.

    load of the exciter = recorded load / (1 + j f / f_c + (j f T)^2)

in sweeps and check runs, with f_c the cutoff and T the natural period, zero at first order. What is recorded is then
not the force but the command or the output of an amplifier. Weights of static runs hang, whatever the exciter does.

A low-pass of all channels makes the same sweeps. Here it is named as one of the exciters, because channels of several
kinds seldom have one undeclared filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, all_or_each_component, unit_components
from balance_cli.model.effects.search_hints import CommonAlternative, SearchHints, Start
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations

SMALL = 0.004
"""Change of the load that matters at the rig's modes: 0.2 degrees, or 0.4 % of its size."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    middle = rig_frequency(geometry)
    cutoff = "At first order the frequency of half the power; at second the natural one over twice the damping ratio."
    period = "Period of the natural frequency at second order."
    return (
        EffectParameter("cutoff", "Hz", np.inf, SMALL / middle, cutoff, lower=0.0, reciprocal=True),
        EffectParameter("natural_period", "s", 0.0, SMALL**0.5 / middle, period, lower=0.0, squared=True),
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    terms = stack([values["1/cutoff"] * (0.5 / np.pi), values["natural_period^2"] * (0.5 / np.pi) ** 2])
    at = unit_components(where)[:, None]
    return replace(equations, load_lag=equations.load_lag + at * terms)


def _whole_fit_starts(geometry: Geometry) -> tuple[Start, ...]:
    """None, and natural frequencies in the middle of the modes and below: others end in a wrong minimum."""
    periods = (1.0 / rig_frequency(geometry), 2.0 / rig_frequency(geometry))
    return ({}, *({"1/cutoff": period, "natural_period^2": period**2} for period in periods))


LAGGING_CHANNELS = CommonAlternative(
    "low-pass@all",
    "Record a force cell between exciter and hub. A low-pass of all channels attenuates the harmonics of wind-on "
    "loads, one of the exciters does not: if it is the former, fit `low-pass@all`",
)

EFFECT = Effect(
    name="exciter-low-pass",
    summary="The load recorded is a command that the exciter follows late and, at high frequencies, weaker.",
    validity="A low-pass of first or second order, the same at every level, in all sweeps and check runs.",
    reference="McConnell and Varoto, Vibration Testing: Theory and Practice, 2nd ed., 2008, chapter 6 (exciters).",
    signature="In the sweeps of one component, or of all, amplitude and phase of all channels fall together towards "
    "high frequencies.",
    separated_by="Record a force cell between exciter and hub. Unlike a delay, a low-pass also reduces the load.",
    place="a load component, or `all`",
    places=all_or_each_component,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(alike_in_all=LAGGING_CHANNELS, whole_fit_starts=_whole_fit_starts, in_every_set_up=True),
)
