"""Sweeps in which one force at one point drives several hub loads at once: a hammer, or a stinger beside the hub.

The hub loads are then multiples of one signal, F(t) a, and no response to a single one of them can be told: those of a
force at a point, or of one force cell whose signal was written times the direction and the lever arms. The record
is analyzed with one load alone, the largest; the others follow from it. Its noise is that of one signal as well. Its
covariance among the loads would be singular, so that it is counted as noise of the channels, H C H* with the response H
that the line itself shows, and the loads as exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, SampleBlock, SampleSource
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_REMAINDER = 1e-6
"""Of the loads, relative to their size, that is no multiple of the largest one: rounding of a computed transfer, or of
samples in four bytes. Force cells of their own have noise of 1e-5 at least."""


@dataclass(frozen=True)
class SingleForce:
    """Hub loads that are multiples (6,) of the load `component`, in a `run` with this load alone."""

    run: Run
    component: str
    multiples: Array

    @property
    def components(self) -> tuple[str, ...]:
        """The loads that the force drives."""
        return tuple(name for name, multiple in zip(COMPONENTS, self.multiples, strict=True) if multiple)

    def expand(self, spectrum: RunSpectrum) -> RunSpectrum:
        """Return a spectrum of the run with all loads that the force drives, and its noise in the channels."""
        multiples = self.multiples[[COMPONENTS.index(name) for name in self.components]]
        response = _shown_response(spectrum)
        offsets = spectrum.constant_loads
        window = spectrum.window
        return replace(
            spectrum,
            components=self.components,
            loads=np.asarray(spectrum.loads * multiples, complex),
            covariance=_with_exact_loads(spectrum.covariance, response, len(multiples)),
            window=None
            if window is None
            else replace(window, covariance=_with_exact_loads(window.covariance, response, len(multiples))),
            constant_loads=None if offsets is None else np.repeat(offsets, len(multiples), axis=1),
        )


def _shown_response(spectrum: RunSpectrum) -> ComplexArray:
    """The response (k, c) to the one load that each line shows; at frequency zero that of the lowest other line.

    A mean has the zero of its channel, as unloaded bridges do not read zero.
    """
    load = spectrum.loads[:, 0]
    response = np.asarray(spectrum.channels / np.where(np.abs(load) > 0, load, np.inf)[:, None], complex)
    at_rest = spectrum.frequency == 0
    if at_rest.any() and not at_rest.all():
        lowest = int(np.argmin(np.where(at_rest, np.inf, spectrum.frequency)))
        response[at_rest] = response[lowest].real
    return response


def _with_exact_loads(covariance: ComplexArray, response: ComplexArray, loads: int) -> ComplexArray:
    """Return the covariance (k, c + loads, c + loads) of channels and exact loads.

    The noise of the one load of `covariance` (k, c + 1, c + 1) is added to the channels by way of the response (k, c).
    """
    k, c = response.shape
    expanded = np.zeros((k, c + loads, c + loads), complex)
    expanded[:, :c, :c] = covariance[:, :c, :c]
    of_load = covariance[:, c, c][:, None, None] * response[:, :, None] * response[:, None, :].conj()
    expanded[:, :c, :c] += np.where(np.isfinite(expanded[:, :c, :c]), of_load, 0.0)
    return expanded


@dataclass(frozen=True)
class _OneLoad:
    """The samples of a run in which all loads but one column are zero."""

    parent: SampleSource
    column: int

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop with zeros in all loads but one."""
        block = self.parent.read(start, stop)
        assert block.loads is not None
        loads = np.zeros_like(block.loads)
        loads[:, self.column] = block.loads[:, self.column]
        return SampleBlock(start, block.channels, loads)


def single_force(run: Run) -> SingleForce | None:
    """Return the force of a run whose loads are multiples of one another; None where they are not, or there is one."""
    if not run.has_loads:
        return None
    loads = run.read().loads
    assert loads is not None
    forces = np.linalg.norm(loads[:, :3], axis=0)
    if not np.all(np.isfinite(loads)) or np.count_nonzero(np.any(loads, axis=0)) < 2 or not forces.any():
        return None
    column = int(np.argmax(forces))
    multiples = loads[:, column] @ loads / float(loads[:, column] @ loads[:, column])
    remainder = np.linalg.norm(loads - np.outer(loads[:, column], multiples), axis=0)
    if np.any(remainder > LARGEST_REMAINDER * np.linalg.norm(loads, axis=0)):
        return None
    # A computed transfer leaves rounding in loads that the force does not drive.
    multiples = np.where(np.abs(multiples) > LARGEST_REMAINDER, multiples, 0.0)
    alone = replace(run, source=_OneLoad(run.source, column), excited=(COMPONENTS[column],), level=run.level[:1])
    return SingleForce(alone, COMPONENTS[column], multiples)
