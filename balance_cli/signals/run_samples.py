"""Samples of a dynamic run as the spectral estimators need them: selected channels, measured load components."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_LOAD_CONDITION = 1e3
"""Condition number of the loads of several runs, from which their noise is amplified a thousandfold."""
SMALL_SHARE = 0.05
"""Of the largest load of a combination: smaller ones are not worth a word."""


def sample_rate(run: Run) -> float:
    """Return the sample rate [Hz]. Raises UserError where the run declares none."""
    if run.sample_rate is None:
        raise run_error(run, "there is no `sample_rate`", "Give a dynamic run; a static run has no spectrum")
    return run.sample_rate


def run_error(run: Run, text: str, remedy: str = "", place: str = "") -> UserError:
    """Return a user error that names the file of the run, or the run where it has no file."""
    return UserError(text, str(run.path) if run.path else f"run {run.name}", place, remedy)


def channel_columns(run: Run, channel_names: Sequence[str]) -> list[int]:
    """Return the columns of the named channels. Raises UserError where the run lacks one."""
    missing = [name for name in channel_names if name not in run.channel_names]
    if missing:
        raise run_error(run, f"there is no channel `{missing[0]}`", "Leave the channel out for this run", "channels")
    return [run.channel_names.index(name) for name in channel_names]


def read_samples(
    run: Run, channel_names: Sequence[str], start: int = 0, stop: int | None = None
) -> tuple[Array, Array]:
    """Read channels (n, c) [V] and all six loads (n, 6) [N, N m] of samples start to stop.

    Raises UserError where the run has no loads.
    """
    block = run.read(start, stop)
    if block.loads is None:
        raise run_error(run, "there are no `loads`", "Record the loads that the exciter applies", "loads")
    return block.channels[:, channel_columns(run, channel_names)], block.loads


def measured_components(run: Run, loads: Array) -> tuple[str, ...]:
    """Return the components of `loads` (n, 6) that were measured: all but those whose column is exactly zero.

    Raises UserError where a component that is declared as excited was not measured.
    """
    measured = tuple(name for name, column in zip(COMPONENTS, loads.T, strict=True) if np.any(column))
    for name in run.excited:
        if name not in measured:
            raise run_error(
                run, f"`{name}` is declared as excited but its column is zero", "Correct `excited`", "loads"
            )
    return measured


def load_columns(components: Sequence[str]) -> list[int]:
    """Return the columns of these components among the six loads."""
    return [COMPONENTS.index(name) for name in components]


def combination_text(weights: Array, names: Sequence[str]) -> str:
    """Return a combination of loads in words, its largest first."""
    order = np.argsort(-np.abs(weights), kind="stable")
    weights = weights / weights[order[0]]
    shown = [i for i in order if abs(weights[i]) >= SMALL_SHARE]
    words = [names[i] if weights[i] == 1.0 else f"{weights[i]:+.2g} {names[i]}" for i in shown]
    return " ".join(words)
