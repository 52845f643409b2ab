"""The time after which a search is finished with what it has."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class Deadline:
    """So many `seconds` of computing after it was made; never, without them.

    The clock that has run least since then counts. Time in which other programs have the processor is none, so that a
    busy machine finds what an idle one finds; threads that compute at once count once. `was_reached` says whether
    anybody found it over. Fits take `hurried_iterations` after it.
    """

    seconds: float | None
    clocks: tuple[Callable[[], float], ...] = (time.monotonic, time.process_time)
    was_reached: bool = False
    hurried_iterations: int = 3
    _start: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        """Start the clocks."""
        self._start = tuple(clock() for clock in self.clocks)

    @property
    def is_over(self) -> bool:
        """Whether the time is over."""
        elapsed = min(clock() - start for clock, start in zip(self.clocks, self._start, strict=True))
        if self.seconds is not None and elapsed >= self.seconds:
            self.was_reached = True
        return self.was_reached


NO_DEADLINE = Deadline(None)
