"""Wind runs whose mean loads are those of a trim with the opposite sign.

Channels that are reversed in all wind runs make loads of the opposite sign, and a torque meter that is reversed makes a
torque that no other channel contradicts. But a trim of the static calibration is made for the loads of a test: mean
loads of its size and the opposite sign are seldom meant.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.reduction.result import RunLoads, replace_runs

Array = NDArray[np.float64]

SMALLEST_TRIM_SHARE = 0.2
"""Of the calibrated range, from which the mean load of a trim is meant as a load of the test."""
LARGEST_SIZE_RATIO = 2.0
"""Of a mean load and that of the trim. In the sample campaign, at three wind speeds, it is 1.0 to 1.3."""
LEAST_SIGNAL = 5.0
"""Mean load over its sigma from which its sign is known."""


@dataclass(frozen=True)
class OppositeMeans:
    """Mean loads of a run on `components` that have the sizes of a trim and the opposite sign.

    `is_all`: whether the trim has no other loads.
    """

    run: str
    trim: str
    components: tuple[str, ...]
    is_all: bool

    @property
    def warning(self) -> str:
        """What is to be known of the run, in words."""
        names = ", ".join(self.components)
        cause = "all channels" if self.is_all else "the channels that measure it"
        return (
            f"{self.run}: mean {names} of the size of trim `{self.trim}` and the opposite sign: were {cause} reversed, "
            "or is the load meant?"
        )


def opposite_means(runs: Iterable[RunLoads], calibration: Calibration | None) -> Iterator[OppositeMeans]:
    """Yield the wind runs whose mean loads resemble a trim but for signs, and no trim with its signs."""
    loaded = [] if calibration is None else [trim for trim in calibration.trims.values() if _loaded(trim).any()]
    for run in runs if loaded else ():
        if run.kind != "wind":
            continue
        candidates = [item for trim in loaded if (item := _compare(run, trim)) is not None]
        if candidates and all(item.components for item in candidates):
            yield min(candidates, key=lambda item: len(item.components))


def flag_opposite_means(runs: Mapping[str, RunLoads], opposite: Sequence[OppositeMeans]) -> Mapping[str, RunLoads]:
    """Return the loads with those of reversed components flagged, of all where all are reversed."""
    flagged = {item.run: _flag(runs[item.run], item) for item in opposite}
    return replace_runs(runs, flagged)


def _flag(run: RunLoads, item: OppositeMeans) -> RunLoads:
    hit = [item.is_all or name in item.components for name in run.components]
    return run.with_flag(MODEL_CONTRADICTED, where=hit)


def _compare(run: RunLoads, trim: TrimCalibration) -> OppositeMeans | None:
    """Return the components of opposite sign, maybe none; None where a load has another size or is not known."""
    names = [name for name, is_loaded in zip(trim.components, _loaded(trim), strict=True) if is_loaded]
    if not set(names) <= set(run.components):
        return None
    at = [run.components.index(name) for name in names]
    mean, sigma = run.amplitude[0, at].real, run.sigma_cosine[0, at]
    with np.errstate(invalid="ignore"):
        ratio = mean / trim.mean_load[[trim.components.index(name) for name in names]]
        size = np.abs(ratio)
        is_comparable = (
            (size < LARGEST_SIZE_RATIO) & (size > 1.0 / LARGEST_SIZE_RATIO) & (np.abs(mean) > LEAST_SIGNAL * sigma)
        )
    if not is_comparable.all():
        return None
    opposite = tuple(name for name, value in zip(names, ratio, strict=True) if value < 0.0)
    return OppositeMeans(run.run, trim.trim, opposite, len(opposite) == len(names))


def _loaded(trim: TrimCalibration) -> NDArray[np.bool_]:
    """Return which components (k,) of a trim have a mean load that is meant."""
    return np.asarray(np.abs(trim.mean_load) > SMALLEST_TRIM_SHARE * np.nan_to_num(trim.calibrated_range, nan=np.inf))
