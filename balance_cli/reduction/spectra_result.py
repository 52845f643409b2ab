"""Spectral densities of hub loads as a result: artefact, table, text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.result_view import ResultView, plural
from balance_cli.reduction.flags import (
    EXTRAPOLATED,
    MODEL_CONTRADICTED,
    NOT_STEADY,
    REDUNDANCY,
    SEPARATOR,
    UNRESOLVED,
    UNTESTED,
    join_flags,
    trust_word,
)
from balance_cli.reduction.weighted_least_squares import REDUNDANCY_CONFIDENCE
from balance_cli.signals.distributions import poisson

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SPECTRUM_COLUMNS = (
    "run",
    "component",
    "unit",
    "frequency_hz",
    "density",
    "sigma_density",
    "noise_density",
    "redundancy",
    "flag",
)
"""Columns of a table of spectra."""

NEIGHBORS_REJECTED = 2.0
"""Frequencies that one excursion of the noise rejects: neighbors within the bandwidth of the window go together."""
CORRELATED_BANDWIDTH = 1.33
"""Of the noise bandwidth: over so much frequency the random error of a density is one number.

It is the statistical bandwidth of the Blackman-Harris window, 2.8 bins at full overlap, less the excess of the variance
at an overlap of two thirds, so that a mean square has the variance of a record of that length and bandwidth.
"""
DENSITY_UNITS = {"N": "N2/Hz", "N m": "(N m)2/Hz"}
"""Unit of a spectral density for each unit of a load."""


@dataclass(frozen=True, repr=False)
class RunSpectra(ResultView):
    """One-sided spectral densities of the hub loads of one run: m components at k frequencies.

    frequency_hz (k,); density (k, m) [N2/Hz, (N m)2/Hz] with sigma (k, m), random error and error of the response;
    noise (k, m) the part that the noise of the channels has in it; redundancy (k,) chi-square per degree of freedom of
    the residual test with its limit; flags (k,); `resolution_hz`: noise bandwidth of a frequency; `averages`:
    independent spectra in the mean; interval [s] that was used; `load_error` {component applied: rms(reduced - applied)
    / rms(applied) over the band} of a check run; `untested`: components that rest on one sensor, None where all or none
    do; random_sigma (k, m) the part of sigma that differs from frequency to frequency; `not_steady`: components whose
    level changes within the record, None where none does, and `steadiness_note`, when.
    """

    run: str
    kind: str
    response: str
    components: tuple[str, ...]
    frequency_hz: Array
    density: Array
    sigma: Array
    noise: Array
    redundancy: Array
    redundancy_limit: Array
    flags: tuple[str, ...]
    resolution_hz: float
    averages: float
    interval: tuple[float, float]
    left_out: dict[str, str]
    load_error: dict[str, float] | None = field(default=None, metadata={"omit_if_none": True})
    untested: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    random_sigma: Array | None = field(default=None, metadata={"omit_if_none": True})
    not_steady: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    steadiness_note: str | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def band_rms(self) -> dict[str, tuple[float, float]]:
        """{component: rms of the load within the band and its sigma}, noise of the channels included."""
        step = float(np.mean(np.diff(self.frequency_hz)))
        square = step * self.density.sum(axis=0)
        # The random error differs from frequency to frequency; that of the response may be the same at all of them.
        random = self.density**2 / self.averages if self.random_sigma is None else self.random_sigma**2
        common = step * np.sqrt(np.maximum(self.sigma**2 - random, 0.0)).sum(axis=0)
        # Averages over neighbors are independent of each other, those of windows alone are not.
        width = CORRELATED_BANDWIDTH * self.resolution_hz if self.resolution_hz > 1.5 * step else step
        spread = np.hypot(np.sqrt(step * width * random.sum(axis=0)), common)
        rms = np.sqrt(np.maximum(square, 0.0))
        return {name: (float(rms[i]), float(spread[i] / (2.0 * rms[i]))) for i, name in enumerate(self.components)}

    @property
    def _component_flags(self) -> list[str]:
        """What each component has at all frequencies beside their own flags."""
        return [
            join_flags(
                (
                    UNTESTED if name in (self.untested or ()) else "",
                    NOT_STEADY if name in (self.not_steady or ()) else "",
                )
            )
            for name in self.components
        ]

    @property
    def peak_hz(self) -> dict[str, float]:
        """{component: frequency of its largest density}."""
        peaks = self.frequency_hz[np.argmax(self.density, axis=0)]
        return {name: float(peaks[i]) for i, name in enumerate(self.components)}

    @property
    def trust(self) -> str:
        """The word of trust of the run: `contradicted` only where more frequencies are than chance explains."""
        words = [flag.split(SEPARATOR) for flag in (*self.flags, *self._component_flags)]
        rejected = sum(REDUNDANCY in flags for flags in words)
        by_chance = float(poisson.ppf(REDUNDANCY_CONFIDENCE, (1.0 - REDUNDANCY_CONFIDENCE) * len(self.flags)))
        ignored = (REDUNDANCY,) if rejected <= NEIGHBORS_REJECTED * by_chance else ()
        return trust_word(SEPARATOR.join(word for flags in words for word in flags if word not in ignored))

    def summary_lines(self) -> Iterator[str]:
        """Run, band, averages."""
        low, high = self.frequency_hz[0], self.frequency_hz[-1]
        yield f"Spectra of the hub loads of {self.kind} run {self.run} by {self.response}"
        yield f"  {low:.4g} to {high:.4g} Hz, bandwidth {self.resolution_hz:.3g} Hz, {self.averages:.0f} averages"

    def to_frame(self) -> pd.DataFrame:
        """One row for each component and frequency."""
        import pandas as pd

        k, m = self.density.shape
        columns = (
            [self.run] * (k * m),
            np.repeat(self.components, k),
            np.repeat([DENSITY_UNITS[UNIT_OF[name]] for name in self.components], k),
            np.tile(self.frequency_hz, m),
            self.density.T.ravel(),
            self.sigma.T.ravel(),
            self.noise.T.ravel(),
            np.tile(self.redundancy, m),
            [join_flags((flag, word)) for word in self._component_flags for flag in self.flags],
        )
        return pd.DataFrame(dict(zip(SPECTRUM_COLUMNS, columns, strict=True)))


@dataclass(frozen=True, repr=False)
class LoadSpectra(ResultView):
    """Spectral densities of the hub loads of all runs of one reduction within a `band` [Hz]."""

    response: str
    geometry: Geometry
    band: tuple[float, float]
    runs: dict[str, RunSpectra]

    def summary_lines(self) -> Iterator[str]:
        """Rig, response, band, runs."""
        low, high = self.band
        yield f"Spectra of the hub loads of {self.geometry.rig} by {self.response}, {low:g} to {high:g} Hz"
        yield f"  {plural(len(self.runs), 'run')}: {', '.join(self.runs)}"

    def to_frame(self) -> pd.DataFrame:
        """One row for each run, component and frequency."""
        import pandas as pd

        return pd.concat([run.to_frame() for run in self.runs.values()], ignore_index=True)


def frequency_flags(words: Sequence[str], rejected: Bools, beyond: Bools) -> tuple[str, ...]:
    """Return the flags of each frequency: `words` of all, a rejected residual, a place beyond the sweeps (k,)."""
    return tuple(
        join_flags((*words, REDUNDANCY if is_bad else "", EXTRAPOLATED if is_beyond else ""))
        for is_bad, is_beyond in zip(rejected, beyond, strict=True)
    )


def shared_flags(is_redundant: bool, is_contradicted: bool, is_resolved: bool) -> tuple[str, ...]:
    """Return the flags that all frequencies of a spectrum have."""
    untested, contradicted = "" if is_redundant else UNTESTED, MODEL_CONTRADICTED if is_contradicted else ""
    return untested, contradicted, "" if is_resolved else UNRESOLVED
