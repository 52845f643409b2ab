"""Tuning constants of the fits of a diagnosis, and when they must end."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from balance_cli.estimation.deadline import Deadline


@dataclass(frozen=True)
class FitSettings:
    """Fits on the few lines of the search, and fits on all lines."""

    target_lines: int = 300
    """Lines of all sweeps together that a fit of the search takes: few, so that many candidates can be fitted."""
    min_run_lines: int = 20
    """Lines that each sweep keeps at least, so that none of its modes is lost."""
    trial_steps: int = 3
    """Steps from each start, to tell a good start from a bad one."""
    search_steps: int = 12
    """Steps of a fit of the search between two estimates of the model error."""
    search_rounds: int = 8
    """Rounds of fit and model error: a bound for errors that shrink slowly."""
    search_min_step_gain: float = 4.0
    """Decrease of chi-square that a step of the search must promise: below it no decision changes."""
    min_error_decrease: float = 0.1
    """Relative decrease of the model error by which a round is worth another one."""
    start_steps: int = 10
    """First steps of a fit on all lines, with every parameter held near its start."""
    max_start_scales: float = 3.0
    """Scales by which these steps may move a parameter without a prior."""
    min_step_gain: float = 0.3
    """Decrease of chi-square that a first step on all lines must promise: below it starts are equally good."""
    coarse_lines: int = 2000
    """Lines of the first steps of a fit on all lines, where these are twice as many: of 6774 a third leaves the fit 5
    steps of 14."""
    steps_before_valley: int = 8
    """Steps on all lines after which a fit counts as one along a valley: all others have converged by then."""
    contender_steps: int = 12
    """Steps after which compared fits that cannot reach the best are given up: all but those along valleys are done."""
    comparison_tolerance: float = 0.1
    """Tolerance of chi-square of fits that are compared: well below `indistinguishable_chi2`."""
    max_noise_chi2_per_dof: float = 1.05
    """chi2/dof that the uncertainty of the measured noise alone can make."""

    @property
    def deadline(self) -> Deadline | None:
        """When fits hurry to their end, while a diagnosis runs."""
        return None

    @property
    def is_over(self) -> bool:
        """Whether the time is over."""
        return self.deadline is not None and self.deadline.is_over

    def without_deadline(self) -> FitSettings:
        """Return the settings as they are stored."""
        return FitSettings(**{item.name: getattr(self, item.name) for item in fields(FitSettings)})


@dataclass(frozen=True)
class TimedFitSettings(FitSettings):
    """Settings while a diagnosis runs, until a `deadline`, which is not stored."""

    deadline: Deadline | None = field(default=None, compare=False)


@dataclass(frozen=True)
class LateChannelSettings:
    """Delays of channels from the phases of their responses."""

    min_signal_to_noise: float = 10.0
    """Amplitude of a line over its noise from which its phase counts: known to 6 degrees."""
    min_lines: int = 20
    """Lines of a channel below which chance alone finds a delay that turns them all."""
    step: float = 0.05
    """[cycles] of the highest line between the delays that are tried: J falls off over a quarter of a cycle."""
    min_coherence: float = 0.6
    """J at the delay: resonances and their damping take less than that away; a filter, or noise, leaves less."""
    min_gain: float = 0.2
    """What J gains by the delay: below it a fit finds the delay from zero."""
