"""The identified model: the result of `identify`, which `reduce`, `simulate` and the report use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.paper.result import PaperFit
from balance_cli.estimation.response_error import ResponseError
from balance_cli.io.result_view import ResultView, plural, warning_lines
from balance_cli.model.balance import balance_model
from balance_cli.model.system import System
from balance_cli.signals.nyquist_noise import UsualNoise

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CONTRADICTS_OTHERS = "does not agree with the others"
"""Why a diagnosis left a channel out of the fit: no other data need an effect without it."""


@dataclass(frozen=True)
class ParameterTable:
    """Parameters of a fit, in the model's order.

    `value`, `sigma`, `declared` and `declared_sigma` (p,) in `units`; `informed_by` is `data`, `prior` (more than half
    of the variance comes from the declared tolerances), or `exact` (declared without tolerance, not fitted).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    sigma: Array
    declared: Array
    declared_sigma: Array
    informed_by: tuple[str, ...] = field(metadata={"stored_as": "rests_on"})


@dataclass(frozen=True)
class ModeTable:
    """Oscillatory modes: frequency [Hz], damping ratio, their sigma (m,); shape (m, n) over `coordinates`."""

    coordinates: tuple[str, ...]
    frequency: Array
    damping_ratio: Array
    sigma_frequency: Array
    sigma_damping_ratio: Array
    shape: ComplexArray


STATIC_SHARE = 0.5
"""Of the lowest eigenfrequency: below it a response exceeds that at rest by a third at most, as in any model."""


@dataclass(frozen=True)
class RunFit:
    """Fit of one run: chi-square, its degrees of freedom, relative error of the response and its noise floor.

    `worst_channel`: that whose residuals are largest over their noise; None where that is not known.
    """

    chi2: float
    dof: float
    frf_error: float
    frf_noise_floor: float = field(metadata={"stored_as": "frf_noise"})
    worst_channel: str | None = field(default=None, metadata={"omit_if_none": True})


@dataclass(frozen=True)
class FitQuality:
    """Chi-square against the measured noise, its degrees of freedom, and the relative error of all responses.

    `frf_band` [Hz]: that of the relative errors.
    """

    chi2: float
    dof: float
    frf_error: float
    runs: dict[str, RunFit]
    frf_band: tuple[float, float] | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def chi2_per_dof(self) -> float:
        """Chi-square per degree of freedom; NaN where nothing was fitted."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")

    @property
    def worst_run(self) -> str:
        """The run whose chi-square per degree of freedom is largest; empty where none has one."""
        ratios = {name: run.chi2 / run.dof for name, run in self.runs.items() if run.dof > 0 and run.chi2 > 0}
        return max(ratios, key=lambda name: ratios[name], default="")


@dataclass(frozen=True, repr=False)
class IdentifiedModel(ResultView):
    """A balance model, computed or identified.

    `form` is `physical` or `paper`; `method` is `computed`, `ls`, `ml` or `ls+ml`; `start` names the start of the
    maximum likelihood; `covariance` (p, p) is that of all parameters, with zero rows for exact ones; `unidentifiable`
    describes the directions that the data alone do not determine; `channels_left_out` {run: {channel: why}};
    `consistency` is what the cross-checks said of the runs, None where nothing. `usual_noise` is that of the channels
    near half the sample rate, which the sweeps have in common; None where they have none. `gain_error`: what all
    channels may read too much or too little in wind-on runs, relative, of which a diagnosis could not tell the cause.
    `channels_may_lag`: whether a lag of all exciters' loads may be one of all channels, in wind-on runs too.
    `band` [Hz]: that of the lines that were fitted; None where all were. `excited_band` [Hz]: that of the lines of the
    sweeps; None without any, and in artefacts that were written without it. `contradicted` {component: relative error}:
    known loads of check runs, which no fit has used, that the model misses by more than its sigma; None without any.
    """

    form: str
    method: str
    start: str
    geometry: Geometry
    parameters: ParameterTable
    covariance: Array
    modes: ModeTable
    quality: FitQuality
    unidentifiable: tuple[str, ...] = field(metadata={"stored_as": "undetermined"})
    channels_left_out: dict[str, dict[str, str]]
    iterations: int
    converged: bool
    paper: PaperFit | None = None
    response_error: ResponseError | None = field(default=None, metadata={"omit_if_none": True})
    consistency: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    usual_noise: tuple[UsualNoise, ...] | None = field(default=None, metadata={"omit_if_none": True})
    gain_error: float | None = field(default=None, metadata={"omit_if_none": True})
    channels_may_lag: bool | None = field(default=None, metadata={"omit_if_none": True})
    band: tuple[float, float] | None = field(default=None, metadata={"omit_if_none": True})
    contradicted: dict[str, float] | None = field(default=None, metadata={"omit_if_none": True})
    excited_band: tuple[float, float] | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def untrusted_channels(self) -> dict[str, str]:
        """Channels that a diagnosis has left out of the fit because the others contradict them: {channel: reason}."""
        reasons = (item for channels in self.channels_left_out.values() for item in channels.items())
        return {name: reason for name, reason in reasons if reason == CONTRADICTS_OTHERS}

    @property
    def swept_band(self) -> tuple[float, float] | None:
        """Band [Hz] in which the sweeps tell of the response; from zero where they reach down to that at rest."""
        if self.excited_band is None:
            return None
        low, high = self.excited_band
        at_rest = STATIC_SHARE * float(self.modes.frequency.min(initial=np.inf))
        return (low if low > at_rest else 0.0), high

    @property
    def misfit_scale(self) -> float:
        """Factor (Birge ratio) on every sigma where the model does not fit: sqrt(chi2/dof), at least 1."""
        ratio = self.quality.chi2_per_dof
        return float(np.sqrt(ratio)) if self.iterations and ratio > 1.0 else 1.0

    def summary_lines(self) -> Iterator[str]:
        """Form, method, modes, quality of the fit, effects."""
        frequency = self.modes.frequency
        yield f"{self.form.capitalize()} model of {self.geometry.rig} ({self.method})"
        if len(frequency):
            yield f"  {plural(len(frequency), 'mode')} from {frequency.min():.2f} to {frequency.max():.2f} Hz"
        if self.quality.runs:
            error = 100 * self.quality.frf_error
            yield f"  chi2/dof {self.quality.chi2_per_dof:.4g}, error of all responses {error:.3g} %"
            if self.quality.chi2_per_dof > GOOD_FIT_CHI2_PER_DOF:
                yield "  the model does not describe the data to within their noise"
        if not self.converged:
            yield "  not converged"
        if self.geometry.effects:
            yield f"  effects: {', '.join(effect.name for effect in self.geometry.effects)}"
        yield from warning_lines(self.consistency)

    def to_frame(self) -> pd.DataFrame:
        """One row for each parameter, then two for each mode (`kind` is `parameter` or `mode`)."""
        import pandas as pd

        table, modes = self.parameters, self.modes
        parameters = zip(table.names, table.value, table.sigma, table.units, table.informed_by, strict=True)
        rows = [("parameter", *row) for row in parameters]
        for i in range(len(modes.frequency)):
            frequency, damping = f"mode {i + 1} frequency", f"mode {i + 1} damping ratio"
            rows.append(("mode", frequency, modes.frequency[i], modes.sigma_frequency[i], "Hz", ""))
            rows.append(("mode", damping, modes.damping_ratio[i], modes.sigma_damping_ratio[i], "1", ""))
        return pd.DataFrame(rows, columns=["kind", "name", "value", "sigma", "unit", "rests_on"])


def identified_system(model: IdentifiedModel) -> System:
    """The system of a model at its estimate, with derivatives by the parameters in its covariance."""
    model_of_all = balance_model(model.geometry).with_sigma(model.parameters.declared_sigma)
    return model_of_all.system(model.parameters.value)
