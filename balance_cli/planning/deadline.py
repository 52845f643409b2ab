"""The time after which a plan is finished with what it has."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class Deadline:
    """So many `seconds` after it was made; never, without them. `was_reached` says whether anybody found it over."""

    seconds: float | None
    clock: Callable[[], float] = time.monotonic
    was_reached: bool = False
    _start: float = field(init=False)

    def __post_init__(self) -> None:
        """Start the clock."""
        self._start = self.clock()

    @property
    def is_over(self) -> bool:
        """Whether the time is over."""
        if self.seconds is not None and self.clock() - self._start >= self.seconds:
            self.was_reached = True
        return self.was_reached


NO_DEADLINE = Deadline(None)
