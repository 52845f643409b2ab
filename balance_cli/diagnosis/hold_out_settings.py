"""Tuning constants of the tests of an updated model on runs that no fit has used, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FreeSimulationSettings:
    """Simulations by the loads alone, which test nonlinear effects."""

    max_samples: int = 8192
    """Samples of a run that are simulated: some seconds of computing, and tens of periods of the slowest mode."""
    max_hold_out: int = 2
    """Hold-out runs that are simulated."""
    max_sweeps: int = 3
    """Fitted sweeps that are simulated: the effect may not show in what the hold-out runs excite."""
    max_error_ratio: float = 1.02
    """Error with the effects over that without, above which they are rejected: noise changes it by less."""


@dataclass(frozen=True)
class HoldOutSettings:
    """Comparison of a model with its update on runs that no fit has seen."""

    max_error_ratio: float = 1.05
    """Error after over error before, above which a run contradicts the update: a right one leaves what it was."""
    min_noise_ratio: float = 1.5
    """Error after over that of the noise alone, below which the run cannot contradict: it is described."""
    undescribed_noise_ratio: float = 10.0
    """The same, above which a run is not described: fitted parameters leave up to three times the noise."""
    undescribed_expected_ratio: float = 4.0
    """Error over that expected of noise and parameters, above which a run is not described: where one parameter makes
    it, four of its standard deviations."""
    undescribed_error: float = 2e-3
    """Relative error below which a run is described: the accuracy class of good force cells."""
    needed_error_ratio: float = 2.0
    """Error of the loads before over after the update, above which the run needs it, whatever its worth by the sweeps:
    most of the squared error was that of the effects."""
