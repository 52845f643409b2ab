"""What contradicts the static loads of points.

Loads that are known beside them, zeros in another unit, and a calibration that does not describe its own loads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.large_residual import describe_large_residuals, large_residuals
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.series_causes import SAME_FACTOR, UNIT_FACTORS
from balance_cli.calibration.trim_model import WITHOUT_ZEROS
from balance_cli.io.percent import percent_text
from balance_cli.reduction.flags import MODEL_CONTRADICTED, SEPARATOR
from balance_cli.reduction.trust import MODEL_ERROR_SHARE
from balance_cli.steps.point_loads import PointLoads
from balance_cli.steps.point_zeros import PointReadings

Array = NDArray[np.float64]

SIGNIFICANT = 5.0
"""Rms error of known loads over rms sigma from which they contradict: a zero that moved is in all rows alike."""
MIN_LIKENESS = 0.95
"""Cosine of the applied and the computed loads of a component from which one is a multiple of the other."""
FAR_ZERO = 10.0
"""Standard deviations of the zeros between load series by which a zero must differ from none to tell its unit."""
MIN_FAR_CHANNELS = 3
"""Channels whose zeros all tell the same unit: of one or two, one may have been repaired."""
THOUSAND, SAME_THOUSAND = 1000.0, 0.2
"""Ratio of units such as mV/V and uV/V, and the relative difference within which the zeros show it."""


def flag_contradicted(
    runs: Sequence[PointLoads], readings: Sequence[PointReadings], calibration: Calibration
) -> tuple[list[PointLoads], list[str]]:
    """Return the loads of runs, with those flagged that something contradicts, and what that is, in sentences."""
    large = large_residuals(calibration.all_trims)
    flagged, sentences = [], [*filter(None, [describe_large_residuals(large)])]
    for loads, rows in zip(runs, readings, strict=True):
        unit, wrong = _unit_of_zeros(rows, calibration), _wrong_components(loads)
        named = {*loads.components} if unit else {*wrong, *(each.component for each in large)}
        names = tuple(name for name in loads.components if name in named)
        flags = tuple(_with_names(flag, names) for flag in loads.flags) if names else loads.flags
        flagged.append(replace(loads, flags=flags))
        sentences += [*filter(None, [unit]), *wrong.values()]
    return flagged, sentences


def _wrong_components(loads: PointLoads) -> dict[str, str]:
    """Components whose known loads contradict the computed ones by a tenth and five sigma, each with a sentence."""
    if loads.applied is None:
        return {}
    rows = np.isfinite(loads.loads).all(axis=1) & np.isfinite(loads.applied).all(axis=1)
    found, known, sigma = loads.loads[rows], loads.applied[rows], loads.sigma[rows]
    size, error, chance = (np.sqrt(np.sum(values**2, axis=0)) for values in (known, found - known, sigma))
    wrong = np.flatnonzero((error > MODEL_ERROR_SHARE * size) & (error > SIGNIFICANT * chance) & (size > 0.0))
    return {
        loads.components[j]: (
            f"{loads.run}: the loads differ from the known {loads.components[j]} by "
            f"{percent_text(error[j] / size[j], 3)} % of it: {_cause(loads.components[j], found[:, j], known[:, j])}"
        )
        for j in wrong.tolist()
    }


def _cause(component: str, found: Array, known: Array) -> str:
    """What is probably wrong with known loads (n,) where others (n,) were found."""
    likeness = float(found @ known) / max(float(np.linalg.norm(found) * np.linalg.norm(known)), np.finfo(float).tiny)
    factor = float(found @ known) / float(known @ known)
    if abs(likeness) < MIN_LIKENESS:
        return "the calibration, the channels or the order of its rows is wrong there"
    words = next((words for unit, words in UNIT_FACTORS.items() if abs(factor / unit - 1.0) < SAME_FACTOR), None)
    seems = words or f"{1.0 / factor:.3g} times the true one"
    return f"the known {component} seems to be {seems}, or the calibration is wrong"


def _unit_of_zeros(readings: PointReadings, calibration: Calibration) -> str | None:
    """A sentence where all zeros far from none are a thousandth, or a thousand times, those of the calibration."""
    all_trims = calibration.all_trims
    if all_trims is None or not readings.is_zero.any() or all_trims.model.load_series == (WITHOUT_ZEROS,):
        return None
    model = all_trims.model
    here = [i for i, name in enumerate(model.channel_names) if name in readings.channel_names]
    at = [readings.channel_names.index(model.channel_names[i]) for i in here]
    own, zeros = readings.channels[readings.is_zero][:, at].mean(axis=0), model.zeros[:, here]
    scatter = np.hypot(zeros.std(axis=0), np.sqrt(np.diag(model.residual_covariance))[here])
    far = np.abs(zeros.mean(axis=0)) > FAR_ZERO * scatter
    if np.count_nonzero(far) < MIN_FAR_CHANNELS:
        return None
    ratio = own[far] / zeros.mean(axis=0)[far]
    for factor, words in ((1.0 / THOUSAND, "a thousandth of"), (THOUSAND, "a thousand times")):
        if np.all(np.abs(ratio / factor - 1.0) < SAME_THOUSAND):
            return (
                f"{readings.run}: the zeros of its channels are {words} those of the calibration: the unit of its "
                "readings is probably wrong (uV/V for mV/V, or the reverse), and with it all loads"
            )
    return None


def _with_names(flag: str, names: tuple[str, ...]) -> str:
    """A flag with components that are contradicted, beside those that it names."""
    words = flag.split(SEPARATOR) if flag else []
    named = [name for word in words if word.startswith(MODEL_CONTRADICTED) for name in word.split(" ")[2:]]
    others = [word for word in words if not word.startswith(MODEL_CONTRADICTED)]
    return SEPARATOR.join([*others, " ".join([MODEL_CONTRADICTED, *dict.fromkeys([*named, *names])])])
