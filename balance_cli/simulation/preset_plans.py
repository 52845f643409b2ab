"""Two campaigns ready made, with the loads of the recorded one."""

from __future__ import annotations

from typing import get_args

import numpy as np

from balance_cli.simulation.plans import CampaignPlan, Component, LoadStep, RotorPlan, StaticPlan, SweepPlan

HARMONIC_SHAPE = (1.0, 0.4, 0.5, 2.0, 0.3, 0.15, 0.2, 0.6)
"""Amplitudes of harmonics 1 to 8 relative to the first, similar to the recorded check runs (four blades)."""
STATIC_LOAD_LIMITS: dict[Component, float] = dict(
    zip(get_args(Component), (800.0, 800.0, 3500.0, 400.0, 400.0, 450.0), strict=True)
)
HIGH_SWEEP_LEVELS: dict[Component, float] = dict(
    zip(get_args(Component), (40.0, 40.0, 80.0, 15.0, 15.0, 12.0), strict=True)
)
FIRST_HARMONIC_AMPLITUDES: dict[Component, float] = dict(
    zip(get_args(Component), (33.0, 30.0, 60.0, 8.0, 15.0, 8.0), strict=True)
)
WIND_ON_LOADS: dict[Component, float] = {"Fx": 100.0, "Fy": -55.0, "Fz": 2700.0, "Mx": 90.0, "My": -20.0, "Mz": 275.0}


def blade_loads(*components: Component) -> dict[Component, tuple[float, ...]]:
    """Amplitudes of harmonics 1 to 8 of the given components, similar to the recorded check runs."""
    return {
        name: tuple(float(x) for x in FIRST_HARMONIC_AMPLITUDES[name] * np.array(HARMONIC_SHAPE)) for name in components
    }


def static_plans() -> tuple[StaticPlan, ...]:
    """The two static runs: about the unloaded rig, and about lift and torque with 0.35 of the range."""
    small = {name: 0.35 * largest for name, largest in STATIC_LOAD_LIMITS.items()}
    return (
        StaticPlan(run="static-bare", largest=STATIC_LOAD_LIMITS),
        StaticPlan(run="static-trim", trim="trim", trim_loads={"Fz": 2500.0, "Mz": 250.0}, largest=small),
    )


def standard_plan(rotor_speed: float = 17.5) -> CampaignPlan:
    """The recorded campaign: two static runs, twelve sweeps at two levels, three checks and three wind-on runs."""
    sweeps = tuple(
        SweepPlan(run=f"sweep-{name}-{label}", excited=(name,), level=(factor * level,))
        for name, level in HIGH_SWEEP_LEVELS.items()
        for label, factor in (("high", 1.0), ("low", 0.4))
    )
    pairs: tuple[tuple[float, Component, Component], ...] = (
        (0.97, "Fz", "My"),
        (1.02, "Fx", "Mx"),
        (1.0, "Fy", "Mz"),
    )
    checks = tuple(
        RotorPlan(run=f"check-{i}", rotor_speed=factor * rotor_speed, harmonics=blade_loads(first, second))
        for i, (factor, first, second) in enumerate(pairs, 1)
    )
    return CampaignPlan(runs=(*static_plans(), *sweeps, *checks, *_wind_plans(rotor_speed)))


def _wind_plans(rotor_speed: float) -> tuple[RotorPlan, ...]:
    collective = LoadStep(time=12.0, loads={"Fz": 700.0, "Mz": 60.0})
    settings = ((1.0, 0.004, None), (0.985, 0.004, None), (1.015, 0.03, collective))
    return tuple(
        RotorPlan(
            run=f"wind-{i}",
            kind="wind",
            rotor_speed=factor * rotor_speed,
            duration=30.0,
            harmonics=blade_loads(*get_args(Component)),
            steady=WIND_ON_LOADS,
            drift=drift,
            step=step,
        )
        for i, (factor, drift, step) in enumerate(settings, 1)
    )


def short_plan(rotor_speed: float = 17.5) -> CampaignPlan:
    """A small campaign for tests: the static runs in two steps, six sweeps of 4 periods of 2 s, a check, a wind."""
    sweeps = tuple(
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=2.0, periods=4)
        for name, level in HIGH_SWEEP_LEVELS.items()
    )
    bare, trim = (plan.model_copy(update={"steps": 2}) for plan in static_plans())
    every = get_args(Component)
    check = RotorPlan(run="check-1", rotor_speed=rotor_speed, duration=8.0, harmonics=blade_loads("Fz", "My"))
    wind = RotorPlan(
        run="wind-1",
        kind="wind",
        rotor_speed=rotor_speed,
        duration=8.0,
        harmonics=blade_loads(*every),
        steady=WIND_ON_LOADS,
    )
    return CampaignPlan(runs=(bare, trim, *sweeps, check, wind))


PRESETS = {"standard": standard_plan, "short": short_plan}


def campaign_plan(name: str, rotor_speed: float = 17.5) -> CampaignPlan:
    """A campaign ready made: `standard` or `short`, at the rotor's nominal speed [Hz]. Raises KeyError."""
    return PRESETS[name](rotor_speed)
