"""Signals of periodic sweeps without noise, kept for shorter sweeps and other levels of the same excitation.

A rig without nonlinear forces answers twice the level with twice the volts, and the first periods of a long record are
a short one. So many sweeps of a plan need one integration in time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.simulation.acquisition import RecordingSetup, sweep_record
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.campaign import simulate_run
from balance_cli.simulation.load_signals import attached_exciters
from balance_cli.simulation.noise import NO_NOISE, Noise
from balance_cli.simulation.plans import AnyPlan, SweepPlan
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]

MOST_BYTES = 2**28
"""Of all signals that are kept: a dozen records of a minute at 800 Hz with 20 channels take half of it."""


@dataclass(frozen=True)
class _Signals:
    """Channels (n, c) [V] and loads (n, 6) of a sweep simulated at one level."""

    level: float
    volts: Array
    loads: Array


@dataclass(frozen=True)
class SignalStore:
    """The signals of a `rig`, simulated for at least `longest` periods at first."""

    rig: TrueRig
    longest: int = 1
    _kept: dict[object, _Signals] = field(default_factory=dict, repr=False)

    def record(self, plan: AnyPlan, noise: Noise, seed: int) -> Run:
        """One simulated record; that of `simulate_run` but for rounding in the last digits."""
        if not isinstance(plan, SweepPlan) or not _is_repeatable(plan):
            return simulate_run(self.rig, plan, noise, seed)[0]
        signals = self._signals(plan)
        samples = round(plan.duration * plan.sample_rate)
        factor = plan.level[0] / signals.level
        volts, loads = factor * signals.volts[:samples], factor * signals.loads[:samples]
        return sweep_record(self.rig, plan, volts, loads, RecordingSetup(noise, seed))

    def _signals(self, plan: SweepPlan) -> _Signals:
        key = self._key(plan)
        cached = self._kept.get(key)
        if cached is not None and len(cached.volts) >= round(plan.duration * plan.sample_rate):
            return cached
        long = plan.model_copy(update={"periods": max(plan.periods, self.longest)})
        truth = simulate_run(self.rig, long, NO_NOISE, 0)[1]
        signals = _Signals(plan.level[0], truth.channels, truth.recorded_loads)
        while self._kept and self._bytes() + signals.volts.nbytes + signals.loads.nbytes > MOST_BYTES:
            self._kept.pop(next(iter(self._kept)))
        self._kept[key] = signals
        return signals

    def _bytes(self) -> int:
        return sum(item.volts.nbytes + item.loads.nbytes for item in self._kept.values())

    def _key(self, plan: SweepPlan) -> object:
        """What two sweeps have in common whose signals are multiples of one another."""
        same = plan.model_dump(mode="json", exclude={"run", "periods", "level"})
        mechanics = equations_of_motion(self.rig, plan.rotor_speed, attached_exciters(plan))
        level = plan.level if plan.steady or mechanics.forces else tuple(np.array(plan.level) / plan.level[0])
        return str(same), tuple(level)


def _is_repeatable(plan: SweepPlan) -> bool:
    """Whether the excitation is periodic, and does not depend on the name of the run."""
    return plan.excitation in ("sine-sweep", "impact") or (plan.excitation == "multisine" and plan.phases != "random")
