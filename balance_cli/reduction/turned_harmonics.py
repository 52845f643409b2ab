"""Wind runs whose loads are those of the run before, turned by one angle of azimuth or of the opposite sign.

Pulses from the other edge of a mark turn harmonic n of every load by n times one angle; channels that are all reversed
turn every load, whatever its harmonic, by half a cycle. Within a record nothing shows either, as some rotor makes such
loads. But two points of a test are seldom so alike, and turned.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.reduction.result import RunLoads, replace_runs

ComplexArray = NDArray[np.complex128]

LEAST_SIGNAL = 5.0
"""Amplitude of a load over its sigma from which its phase is compared."""
FEWEST_HARMONICS, FEWEST_LOADS = 3, 9
"""Compared at least: one or two phases always have an angle in common."""
FEWEST_MEANS = 5
"""Mean loads from which their signs are compared, where the harmonics are not alike."""
LEAST_CORRELATION = 0.9
"""Of the turned or reversed loads. Loads that differ by half of their size from those of the other run have 0.9 in the
median. Of 2000 pairs of loads with nothing in common none has it; of 10 000 pairs of six mean loads two have -0.9."""
SMALLEST_TURN = 3.0
"""[deg]. The angle of loads that differ by half of their size scatters by 0.6 deg."""
TIE = 1e-3
"""Difference of two correlations that rounding and steps make."""
LARGEST_TURN, STEP = 60.0, 0.25
"""[deg] that are tried: half of a sector of three marks, and steps below the scatter."""


@dataclass(frozen=True)
class RunComparison:
    """A wind run beside the wind run before it in the order of names.

    `turn` [deg]: by what the harmonics are turned, 0 where they are alike, None where they tell nothing. `sign`: 1
    where the loads are alike, -1 where they have the opposite sign, 0 where neither.
    """

    before: str
    after: str
    turn: float | None
    sign: int

    @property
    def warning(self) -> str:
        """What is to be known of the two runs, in words; empty where nothing is."""
        if self.sign < 0:
            return (
                f"{self.after}: its loads are those of {self.before} with the opposite sign: "
                "were all channels reversed in one of them?"
            )
        if self.turn:
            return (
                f"{self.after}: its harmonics n are those of {self.before} turned by n times {self.turn:+.1f} deg of "
                "azimuth: do the pulses come from another edge or mark, or was the model yawed?"
            )
        return ""


def compare_wind_runs(runs: Mapping[str, RunLoads]) -> tuple[RunComparison, ...]:
    """Compare each wind run with the one before it by name, where numbers count as such, whatever the order given."""
    in_order = (runs[name] for name in sorted(runs, key=_name_parts))
    return tuple(_compare(*pair) for pair in pairwise(run for run in in_order if run.kind == "wind"))


def _name_parts(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return the parts of a name, text and numbers in turn, and the name itself; a longer number is a larger one."""
    parts = re.split("([0-9]+)", name)
    return [(len(part.lstrip("0")), part.lstrip("0")) if i % 2 else (0, part) for i, part in enumerate(parts)], name


def turn_warnings(comparisons: Iterable[RunComparison]) -> Iterator[str]:
    """Yield a warning for each wind run whose loads are those of the wind run before, turned or reversed."""
    return (item.warning for item in comparisons if item.warning)


def flag_turned_runs(runs: Mapping[str, RunLoads], comparisons: Sequence[RunComparison]) -> Mapping[str, RunLoads]:
    """Return the loads with the harmonics of turned runs, and all loads of reversed runs, flagged.

    Of runs that are alike but for a turn or the sign, those that differ from most of them are flagged; all of them
    where no turn or sign is that of most.
    """
    signs = [(item.before, item.after, (1 - item.sign) * 90.0 if item.sign else None) for item in comparisons]
    turns = [(item.before, item.after, item.turn) for item in comparisons]
    of_other_sign = _differing_runs(signs)
    flagged = {name: runs[name].with_flag(MODEL_CONTRADICTED) for name in of_other_sign}
    for name in _differing_runs(turns) - of_other_sign:
        harmonics = np.arange(len(runs[name].amplitude))[:, None]
        flagged[name] = runs[name].with_flag(MODEL_CONTRADICTED, where=harmonics > 0)
    return replace_runs(runs, flagged)


def _compare(before: RunLoads, after: RunLoads) -> RunComparison:
    sign = _common_sign(before, after)
    turn = common_turn(before, after) if sign >= 0 else None
    if turn is not None and abs(turn) <= SMALLEST_TURN:
        turn = 0.0
    return RunComparison(before.run, after.run, turn, sign)


def _differing_runs(changes: Iterable[tuple[str, str, float | None]]) -> set[str]:
    """Return the runs that differ from most of the runs in their chain, by (run, next run, angle [deg] between them).

    A chain ends where an angle is None.
    """
    differing: set[str] = set()
    chain: dict[str, float] = {}
    for before, after, angle in changes:
        if angle is None:
            differing |= _minority(chain)
            chain = {}
        else:
            chain.setdefault(before, 0.0)
            chain[after] = (chain[before] + angle) % 360.0
    return differing | _minority(chain)


def _minority(angles: Mapping[str, float]) -> set[str]:
    """Return the runs whose angle [deg] is not that of most; all where there is no such angle, none where all agree."""
    if not angles:
        return set()
    values = np.array(list(angles.values()))
    distinct = np.unique(np.round(values))
    agrees = np.abs((values - distinct[:, None] + 180.0) % 360.0 - 180.0) <= SMALLEST_TURN
    usual = agrees[np.argmax(agrees.sum(axis=1))]
    has_majority = 2 * usual.sum() > len(usual)
    return {name for name, agreeing in zip(angles, usual, strict=True) if not (agreeing and has_majority)}


def common_turn(before: RunLoads, after: RunLoads) -> float | None:
    """Return the angle [deg] by which all harmonics of a run are turned to be those of the other; None without one.

    Each load counts alike, whatever its size and unit.
    """
    products = _harmonic_products(before, after)
    if products is None:
        return None
    turns = np.arange(-LARGEST_TURN, LARGEST_TURN + STEP, STEP)
    correlation = (np.exp(-1j * np.outer(np.radians(turns), np.arange(1, len(products) + 1))) @ products).real
    # Where only multiples of the blades are clear, several angles explain the same; the smallest one is meant.
    equal = turns[correlation > correlation.max() - TIE]
    return float(equal[np.argmin(np.abs(equal))]) if correlation.max() > LEAST_CORRELATION else None


def _common_sign(before: RunLoads, after: RunLoads) -> int:
    """Return 1 where the harmonics of a run, or its mean loads, are those of the other, -1 where reversed, else 0.

    The harmonics decide where they are alike; those of another phase tell nothing, and mean loads keep their sign.
    """
    products = _harmonic_products(before, after)
    correlation = 0.0 if products is None else float(products.sum().real)
    if abs(correlation) <= LEAST_CORRELATION:
        clear, likeness = _likeness(before, after)
        decides = clear[0].sum() >= FEWEST_MEANS
        correlation = float(likeness[0, clear[0]].real.mean()) if decides else 0.0
    return int(np.sign(correlation)) if abs(correlation) > LEAST_CORRELATION else 0


def _harmonic_products(before: RunLoads, after: RunLoads) -> ComplexArray | None:
    """Return the part (n,) of each harmonic in the correlation of two runs; None where too few loads are clear."""
    clear, likeness = (values[1:] for values in _likeness(before, after))
    if clear.any(axis=1).sum() < FEWEST_HARMONICS or clear.sum() < FEWEST_LOADS:
        return None
    return np.asarray(np.where(clear, likeness, 0.0).sum(axis=1) / clear.sum())


def _likeness(before: RunLoads, after: RunLoads) -> tuple[NDArray[np.bool_], ComplexArray]:
    """Return which loads (n+1, m) are clear in two runs, and the product of each over the mean of its squares.

    None is clear where the loads are not of the same components and rotor.
    """
    count = min(len(before.amplitude), len(after.amplitude))
    if before.components != after.components or before.rotor != after.rotor:
        return np.zeros((count, 0), bool), np.zeros((count, 0), complex)
    first, second = before.amplitude[:count], after.amplitude[:count]
    with np.errstate(invalid="ignore", divide="ignore"):
        likeness = 2.0 * first.conj() * second / (np.abs(first) ** 2 + np.abs(second) ** 2)
    return _clear(before)[:count] & _clear(after)[:count], likeness


def _clear(run: RunLoads) -> NDArray[np.bool_]:
    """Return which loads (n+1, m) stand out of their sigma."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(run.amplitude) > LEAST_SIGNAL * np.hypot(run.sigma_cosine, run.sigma_sine))
