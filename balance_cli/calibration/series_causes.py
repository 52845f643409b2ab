"""What seems to be wrong with a whole load series.

Its loads are in another unit or of the other sign, exchanged, in reverse order, about another point or at an angle, or
two channels are exchanged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations, product

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_mean
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.io.units import FOOT, INCH, POUND_FORCE, STANDARD_GRAVITY

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_LEFT_SHARE = 0.15
"""Share of the error of a load series that an explanation may leave, as amplitude, as of a row."""
SAME_FACTOR = 0.02
"""Relative difference of two factors that count as equal: the nearest two of the table are 4 % apart or more."""
NEAR_FACTOR = 0.1
"""The same for a factor that nonlinearity may have shifted: it is named beside the number."""
MIN_OTHER_LOAD = 0.02
"""Share of the calibrated range by which two columns of loads must differ to be exchanged."""

UNIT_FACTORS = {
    -1.0: "of the other sign",
    1e3: "in units of a thousand (kN, kN m)",
    1e-3: "in thousandths (mN, N mm)",
    POUND_FORCE: "in lbf",
    STANDARD_GRAVITY: "in kgf or kgf m",
    POUND_FORCE * INCH: "in in-lbf",
    POUND_FORCE * FOOT: "in ft-lbf",
}
"""What the true loads are of the stated ones, and what the stated ones then seem to be."""


def series_cause(model: CalibrationModel, points: CalibrationPoints, rows: Mask) -> str | None:
    """What single mistake explains the readings in some rows (m,), by a model that was fitted without them.

    In words that are stored in artefacts; None where no single one does.
    """
    loads, sigma = points.loads[rows], np.sqrt(np.diag(model.residual_covariance))
    change = subtract_mean(points.channels[rows]) / sigma

    def left(other: Array) -> float:
        return float(np.linalg.norm(change - subtract_mean(model.readings(other)) / sigma))

    stated = left(loads)
    explained = [(left(other), words) for other, words in _other_loads(model, loads, change * sigma, sigma)]
    explained += _exchanged_channels(points.channel_names, change * sigma, subtract_mean(model.readings(loads)), sigma)
    least, words = min(explained, key=lambda pair: pair[0], default=(np.inf, ""))
    return words if least <= MAX_LEFT_SHARE * stated else None


def _exchanged_channels(names: Sequence[str], change: Array, predicted: Array, sigma: Array) -> list[tuple[float, str]]:
    """What is left of the readings with each two channels exchanged, and the mistake in words."""
    causes = []
    for i, j in combinations(range(len(names)), 2):
        restored = change.copy()
        restored[:, [i, j]] = change[:, [j, i]]
        left = float(np.linalg.norm((restored - predicted) / sigma))
        causes.append((left, f"its channels {names[i]} and {names[j]} seem to be exchanged"))
    return causes


def _other_loads(model: CalibrationModel, loads: Array, change: Array, sigma: Array) -> Iterator[tuple[Array, str]]:
    """Loads (r, k) that the series could have had, and the mistake in words."""
    yield loads[::-1], "its loads seem to stand in reverse order"
    predicted = subtract_mean(model.readings(loads)) / sigma
    power = float(np.sum(predicted**2))
    if power > 0:
        factor = float(np.sum(predicted * change / sigma)) / power
        yield factor * loads, factor_words(factor)
    for i, j in combinations(range(loads.shape[1]), 2):
        if np.max(np.abs(loads[:, i] - loads[:, j])) > MIN_OTHER_LOAD * max(model.calibrated_range[[i, j]]):
            other = loads.copy()
            other[:, [i, j]] = loads[:, [j, i]]
            yield other, f"its loads {model.components[i]} and {model.components[j]} seem to be exchanged"
    yield from _wrong_load(model, loads)
    yield from _accompanied_loads(model, loads, change / sigma - predicted, sigma)


def _wrong_load(model: CalibrationModel, loads: Array) -> Iterator[tuple[Array, str]]:
    """Loads (r, k) of which one alone of several has the other sign or another unit.

    Other factors are not tried: where loads change in proportion, a share of one in another looks the same.
    """
    moved = np.flatnonzero(np.ptp(loads, axis=0) > MIN_OTHER_LOAD * model.calibrated_range)
    factors = (*UNIT_FACTORS, *(1.0 / known for known in UNIT_FACTORS if known > 0.0))
    for j, factor in product(moved.tolist() if len(moved) > 1 else [], factors):
        other = loads.copy()
        other[:, j] *= factor
        yield other, factor_words(factor, model.components[j])


def _accompanied_loads(
    model: CalibrationModel, loads: Array, error: Array, sigma: Array
) -> Iterator[tuple[Array, str]]:
    """Loads (r, k) with a share of one in another that explains an `error` (r, c), as of another moment center."""
    stated = model.readings(loads)
    for i, j in permutations(range(loads.shape[1]), 2):
        extra = np.zeros_like(loads)
        extra[:, j] = loads[:, i]
        effect = subtract_mean(model.readings(loads + extra) - stated) / sigma
        power = float(np.sum(effect**2))
        if power > 0:
            share = float(np.sum(effect * error)) / power
            cause = f"{share:.3g} times its {model.components[i]} seems to be missing in its {model.components[j]}"
            yield loads + share * extra, f"{cause}, as of another moment center or a load at an angle"


def factor_words(factor: float, component: str = "") -> str:
    """What loads, or those of one component, are whose true values are the stated ones times a factor."""
    its, those = (f"its {component} seems", f"{component} of the other series seems") if component else ("", "")
    its, those = its or "its loads seem", those or "the loads of the other series seem"
    for known, words in UNIT_FACTORS.items():
        if abs(factor / known - 1.0) < SAME_FACTOR:
            return f"{its} to be {words}, unlike those of the other series"
        if abs(factor * known - 1.0) < SAME_FACTOR and known != -1.0:
            return f"{those} to be {words}, unlike its own"
    near = {words: abs(np.log(factor / known)) for known, words in UNIT_FACTORS.items() if factor / known > 0.0}
    nearest = min(near, key=lambda words: near[words], default="")
    about = f", about as if {nearest}" if nearest and near[nearest] < NEAR_FACTOR else ""
    return f"{its} to be {factor:.3g} times as large as stated{about}"
