"""A response source that is the truth of a simulated rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.model.system import System
from balance_cli.reduction.response_sources import ChannelCombination, select_channels
from balance_cli.simulation.rig import TrueRig
from tests.support.truth import true_response

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class TruthSource:
    """The true response, as `reduce` would use it if the balance were known exactly."""

    rig: TrueRig
    slowest_decay: float
    description: str = "true response"

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Rows are the channels."""
        return select_channels(self.rig.geometry.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """T of the rig that was simulated."""
        return true_response(self.rig, frequency)

    @property
    def swept_band(self):
        return None

    @property
    def response_error(self):
        return None

    @property
    def is_contradicted(self):
        return False

    @property
    def untrusted_channels(self):
        return {}

    @property
    def system(self) -> System | None:
        """None: the truth is known at frequencies only."""
        return None

    @property
    def poles(self) -> tuple[complex, ...]:
        """None: the truth is known at frequencies only."""
        return ()

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run itself."""
        return run

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Nothing is uncertain."""
        count = 2 * len(self.rig.geometry.channels)
        return np.zeros((len(frequency), count, count))
