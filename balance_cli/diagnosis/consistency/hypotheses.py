"""What may have happened to the readings or the loads of a run: order, sign, factor; and how each is undone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.consistency.evidence import Evidence
from balance_cli.diagnosis.consistency.exchanges import Exchanges
from balance_cli.diagnosis.consistency.residuals import Residuals, Weights, residuals

ComplexArray = NDArray[np.complex128]

EXCHANGE_CHANNELS, EXCHANGE_LOADS = "exchange channels", "exchange loads"
SCALE_CHANNELS, SCALE_LOADS = "scale channels", "scale loads"
TURN_LOADS = "turn loads"


@dataclass(frozen=True)
class Hypothesis:
    """One mistake: channels or loads exchanged, or scaled by one real factor; or all loads in other axes.

    `indices` are those of the channels or components concerned; of exchanged ones, each with its partner next to it. Of
    other axes they are the loads of the file that the six are, from 1 on, negative where they are reversed.
    """

    kind: str
    indices: tuple[int, ...] = ()

    @property
    def has_factor(self) -> bool:
        """Whether a factor is estimated."""
        return self.kind in (SCALE_CHANNELS, SCALE_LOADS)


@dataclass(frozen=True)
class Corrected:
    """Forces (k, c) and loads (k, 6) of a run after a mistake has been undone."""

    forces: ComplexArray
    loads: ComplexArray


def undo(hypothesis: Hypothesis, run: Evidence, value: float) -> Corrected:
    """Return what a run would have recorded without the mistake.

    `value` is the multiplier of what was recorded. Channels that are exchanged keep
    their volts.
    """
    forces, loads = run.forces, run.loads
    index = list(hypothesis.indices)
    if hypothesis.kind == EXCHANGE_CHANNELS:
        forces = forces.copy()
        partners = np.array(index).reshape(-1, 2)[:, ::-1].ravel()
        volts = run.forces[:, partners] * run.gains[:, partners]
        gains = run.gains[:, index]
        forces[:, index] = np.divide(volts, gains, out=np.full_like(volts, np.nan), where=gains != 0)
    elif hypothesis.kind == SCALE_CHANNELS:
        forces = forces.copy()
        forces[:, index] *= value
    else:
        loads = loads.copy()
        if hypothesis.kind == EXCHANGE_LOADS:
            loads[:, index] = loads[:, index[::-1]]
        elif hypothesis.kind == TURN_LOADS:
            loads = np.sign(index) * loads[:, np.abs(index) - 1]
        else:
            loads[:, index] *= value
    return Corrected(forces, loads)


@dataclass(frozen=True)
class Effect:
    """Residuals of a run as recorded and with a mistake undone; of a factor, with what it concerns multiplied by 0."""

    recorded: Residuals
    undone: Residuals

    def with_factor(self, value: float) -> Residuals:
        """Return the residuals with what was recorded multiplied by `value`; they are linear in it."""
        return Residuals(
            *(
                nothing + value * (recorded - nothing)
                for recorded, nothing in zip(_parts(self.recorded), _parts(self.undone), strict=True)
            )
        )


def _parts(part: Residuals) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    return part.geometry, part.runs, part.pairs


def effect_of_mistake(hypothesis: Hypothesis, run: Evidence, weights: Weights, recorded: Residuals) -> Effect:
    """Return the residuals of a run, as `recorded` and without a mistake, as far as the weights compare them."""
    corrected = undo(hypothesis, run, 0.0)
    return Effect(recorded.with_weights(weights), residuals(run, corrected.forces, corrected.loads, weights))


def estimate_factor(effects: Sequence[Effect]) -> float:
    """Return the factor that leaves the smallest residuals in these runs."""
    product, power = 0.0, 0.0
    for effect in effects:
        nothing = effect.undone.vector
        part = effect.recorded.vector - nothing
        product -= float(np.vdot(part, nothing).real)
        power += float(np.vdot(part, part).real)
    return product / power if power > 0 else 1.0


def without_scaled_pairs(hypothesis: Hypothesis, run: Evidence, weights: Weights) -> Weights:
    """Return the weights without the pairs of which both channels are scaled: they agree whatever the factor."""
    if hypothesis.kind != SCALE_CHANNELS:
        return weights
    scaled = [set(pair) <= set(hypothesis.indices) for pair in run.pairs]
    return replace(weights, pairs=np.where(scaled, np.inf, weights.pairs))


def candidate_hypotheses(
    suspicious: Sequence[int], components: Sequence[int], exchanges: Exchanges, by_source: Sequence[tuple[int, ...]]
) -> list[Hypothesis]:
    """Return the mistakes to be tried, the simplest first, for channels and components that contradict something.

    `by_source` are the channels of each cell, which one wrong axis reverses together and one wrong position exchanges
    together; they need only be alike. Without components, nothing contradicts but
    channels of a cell each other.
    """
    sources = [group for group in by_source if len(group) > 1 and set(suspicious) & set(group)]
    channel_mistakes = [
        *(Hypothesis(SCALE_CHANNELS, (i,)) for i in suspicious),
        *(Hypothesis(EXCHANGE_CHANNELS, pair) for pair in combinations(suspicious, 2) if exchanges.possible[pair]),
    ]
    if not components:
        return channel_mistakes
    forces, moments = (tuple(j for j in components if (j < 3) == first) for first in (True, False))
    return [
        *channel_mistakes,
        *(Hypothesis(SCALE_LOADS, (j,)) for j in components),
        *(Hypothesis(EXCHANGE_LOADS, pair) for pair in combinations(components, 2)),
        *(Hypothesis(SCALE_CHANNELS, group) for group in sources),
        *(
            Hypothesis(EXCHANGE_CHANNELS, tuple(i for pair in zip(first, second, strict=True) for i in pair))
            for first, second in combinations(sources, 2)
            if len(first) == len(second) and all(exchanges.correlated[pair] for pair in zip(first, second, strict=True))
        ),
        *(Hypothesis(SCALE_LOADS, group) for group in (forces, moments) if len(group) > 1),
        Hypothesis(SCALE_CHANNELS, tuple(range(len(exchanges.correlated)))),
    ]
