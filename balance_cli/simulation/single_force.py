"""One nonlinear force of few records, integrated in blocks of steps: numbers take less time than such small arrays.

Within a block the linear rig is known in advance but for the forces of the block itself: what the state at its begin
causes in all of its steps is one product, and each force acts on the later steps by the response to an impulse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import mul

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Correct = Callable[[float, float], float]

BLOCK_STEPS = 16
"""Steps of a block. The work of a step is least between 12 and 16: few have their products for themselves, and in many
each force is multiplied more often."""


@dataclass(frozen=True)
class ForceBlocks:
    """L steps of the linear rig at once, from a state (s,), for q motions: an elongation, or that and its rate.

    `motion` (s, L q) are the motions that the state causes and `end` (s, s) the state after them; `impulse` (L, q) are
    the motions 1, 2, ... steps after a force of 1 N, and `carried` (L, s) the end state by the force of each step.
    """

    motion: Array
    end: Array
    impulse: Array
    carried: Array

    @classmethod
    def from_step(cls, step: Array, ahead: Array, size: int) -> ForceBlocks:
        """The block of a step: `step` (s, s+q) is that of a state and its motions, `ahead` (1, s) that of a force."""
        turn, seen = step[:, :size], step[:, size:]
        motions, states, power = [], [], np.eye(size)
        for _ in range(BLOCK_STEPS):
            motions.append(power @ seen)
            states.append(ahead[0] @ power)
            power = power @ turn
        impulse = np.array([state @ seen for state in states])
        return cls(np.hstack(motions), power, impulse, np.array(states[::-1]))


def integrate_blocks(blocks: ForceBlocks, state: Array, linear: Array, correct: list[Correct]) -> Array:
    """The force (n, runs) of records from `state` (runs, s), under their `linear` motions (n, runs, q).

    `correct` are functions, one for each run, of the motions of a step without its own force, that return this force.
    """
    n, runs, q = linear.shape
    padding = -n % BLOCK_STEPS
    padded = np.pad(linear, ((0, padding), (0, 0), (0, 0)), "edge").swapaxes(0, 1)
    padded = padded.reshape(runs, -1, BLOCK_STEPS * q)
    # For each step the impulses of the steps before it, from the first of the block on.
    before = [[blocks.impulse[:i, each][::-1].tolist() for each in range(q)] for i in range(BLOCK_STEPS)]
    result = np.empty((padded.shape[1], runs, BLOCK_STEPS))
    for k in range(padded.shape[1]):
        free = (np.dot(state, blocks.motion) + padded[:, k]).tolist()
        forces = [_block_forces(*each, before) for each in zip(free, correct, strict=True)]
        result[k] = forces
        state = np.dot(state, blocks.end) + np.dot(result[k], blocks.carried)
    return result.swapaxes(1, 2).reshape(-1, runs)[:n]


def _block_forces(free: list[float], correct: Correct, before: list[list[list[float]]]) -> list[float]:
    """The forces of a run in the steps of a block, under the motions `free` (L q) of all that came before it."""
    forces: list[float] = []
    if len(before[0]) == 1:
        for d, (of_elongation,) in zip(free, before, strict=True):
            forces.append(correct(d + sum(map(mul, forces, of_elongation)), 0.0))
        return forces
    for d, rate, (of_elongation, of_rate) in zip(free[::2], free[1::2], before, strict=True):
        motion = d + sum(map(mul, forces, of_elongation)), rate + sum(map(mul, forces, of_rate))
        forces.append(correct(*motion))
    return forces
