"""The result of an identification in the form of the 1985 paper, and its options."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.paper.equations import (
    Coefficients,
    Mode,
    is_stable,
)
from balance_cli.estimation.paper.misfit import Misfit
from balance_cli.estimation.paper.output_error import NoiseForm
from balance_cli.estimation.paper.sensors import SensorRule

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

PAPER_BAND = (10.0, 125.0)
"""Band [Hz] of the paper's fits."""


@dataclass(frozen=True)
class PaperOptions:
    """Options of an identification in the paper's form.

    `method`: `ls` (equation error), `ml` (output error, from the geometry) or `ls+ml` (from least squares or the
    geometry, whichever fits better). `damping`: D `diagonal` (the paper's) or `full`. `band` [Hz] of the lines that are
    fitted, 10 to 125 Hz in the paper. `noise`: S `full` (the paper's), `diagonal` (independent sensors) or `equal`
    (sigma^2 I); where a full S finds no minimum the fit uses a diagonal one. `line_weighting` of the equation error:
    `plain` (the paper's), or `displacement`, divided by omega^2.
    """

    method: Literal["ls", "ml", "ls+ml"] = "ls+ml"
    damping: Literal["diagonal", "full"] = "diagonal"
    band: tuple[float, float] = PAPER_BAND
    noise: NoiseForm = "full"
    line_weighting: Literal["plain", "displacement"] = "plain"
    max_iterations: int = 80


@dataclass(frozen=True)
class PaperFit:
    """Eq. (6) identified: s'' + D s' + K s = B_F u for the sensors of `rule` and the `inputs`.

    `model` holds D (n, n) [1/s], K (n, n) [1/s2] and B_F (n, m) [1/s2, 1/(m s2)], `free` (n, 2n+m) which entries of
    [D, K, B_F] were fitted, `covariance` (p, p) theirs, in row order. `S` (n, n) is the residual covariance: estimated
    from the residuals themselves, so that chi2 against it is 1 by construction (output error [N2]; equation error
    [N2/s4] after `ls`); `noise` is the form of S that was finally used. `misfit` compares with the noise measured in
    the runs instead. `line_count` is the number of lines fitted, `start` names the start of the maximum likelihood;
    `cost` is N ln det S, NaN after `ls`.
    """

    rule: SensorRule
    inputs: tuple[str, ...]
    model: Coefficients
    free: NDArray[np.bool_]
    covariance: Array
    S: ComplexArray
    noise: NoiseForm
    modes: tuple[Mode, ...]
    misfit: Misfit
    options: PaperOptions
    line_count: int = field(metadata={"stored_as": "lines"})
    start: str
    cost: float
    iterations: int
    converged: bool

    @property
    def parameters(self) -> Array:
        """The fitted entries (p,) of [D, K, B_F], row by row."""
        return self.model.table[self.free]

    @property
    def sigma(self) -> Array:
        """One standard deviation (p,) of the parameters."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names such as `D[x,x]`, `K[x,y1]`, `B_F[x,Fx]`, in the order of `parameters`."""
        return tuple(name for name, _ in _parameter_labels(self))

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units in the order of `parameters`."""
        return tuple(unit for _, unit in _parameter_labels(self))

    @property
    def stable(self) -> bool:
        """Whether every mode is damped; after least squares some may not be."""
        return is_stable(self.model)


def _parameter_labels(fit: PaperFit) -> list[tuple[str, str]]:
    sensors = fit.rule.names
    columns = [("D", name, "1/s") for name in sensors] + [("K", name, "1/s2") for name in sensors]
    columns += [("B_F", name, "1/s2" if name.startswith("F") else "1/(m s2)") for name in fit.inputs]
    return [
        (f"{columns[column][0]}[{sensors[row]},{columns[column][1]}]", columns[column][2])
        for row, column in np.argwhere(fit.free)
    ]
