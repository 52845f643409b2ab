"""What the runs of a campaign share at one parameter vector: a system is solved once for runs of the same frequencies.

Batches that are split by run have the same frequencies and windows again and again.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.exciter_loads import attach_exciters
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, solve
from balance_cli.model.transient_modes import TransientModes, transient_modes

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Value = TypeVar("Value")

MAX_KEPT = 4
"""Solutions kept at once: two kinds of run, on two threads; more would hold memory for runs that are done."""


class SharedSolutions:
    """Solutions and transient modes of one system, each computed when it is first asked for.

    Two threads may compute the same one at the same time: they get equal values.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._solutions: dict[Hashable, Solution] = {}
        self._modes: dict[Hashable, TransientModes] = {}

    def solution(self, frequency: Array, spin: float) -> Solution:
        """The system solved at these frequencies (f,) [Hz] and this rotor speed [Hz]."""
        key = (spin, frequency.tobytes())
        cached = self._solutions.get(key)
        return _keep(self._solutions, key, solve(self._system, frequency, spin)) if cached is None else cached

    def transient_modes(
        self, spin: float, highest: float, fastest_decay: float, derivatives: bool, attached: Mask
    ) -> TransientModes:
        """The modes of `model.transient_modes.transient_modes` of this system with the exciters `attached` (6,)."""
        system = attach_exciters(self._system, attached)
        key = (spin, highest, fastest_decay, derivatives, None if system is self._system else attached.tobytes())
        cached = self._modes.get(key)
        if cached is not None:
            return cached
        return _keep(self._modes, key, transient_modes(system, spin, highest, fastest_decay, derivatives))


def _keep(cache: dict[Hashable, Value], key: Hashable, value: Value) -> Value:
    """Store a value, the oldest one giving way."""
    for oldest in list(cache)[: max(len(cache) - MAX_KEPT + 1, 0)]:
        cache.pop(oldest, None)
    cache[key] = value
    return value
