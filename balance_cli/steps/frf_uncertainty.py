"""Standard deviation of imported responses: stated, by coherence and averages, or from the scatter of the lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.frf_map import FrfMap
from balance_cli.signals.response.line_scatter import (
    SCATTER_DOF,
    coherence_variance,
    independent_share,
    scatter_variance,
)
from balance_cli.steps.frf_lines import CommonLines

Array = NDArray[np.float64]

NO_INFORMATION = 1e-6
"""One less the coherence, in the median, below which it is that of a single average: one whatever the noise."""
USUAL_WINDOW = "hann"
"""Where the map states none: analyzers have it as their default, and it hides most of the scatter of those in use."""
NO_UNCERTAINTY = "their uncertainty is not known: sigma is the rounding of the file alone, that of loads too small"
"""What is said of responses without coherence, averages and scatter."""


@dataclass(frozen=True)
class ResponseNoise:
    """The variance (k, c) of responses, its complex degrees of freedom, and where it comes from in words."""

    variance: Array
    dof: float
    origin: str


def response_noise(lines: CommonLines, mapping: FrfMap) -> ResponseNoise:
    """Return the noise of responses with the rounding of the file."""
    rounding = lines.resolution**2 * np.abs(lines.response) ** 2
    noise = _noise(lines, mapping)
    return replace(noise, variance=noise.variance + np.maximum(rounding, np.finfo(float).tiny))


def line_share(mapping: FrfMap, lines: int) -> Array | None:
    """Return the independent share (k,) of each line by the window of the map, or the usual one; None without any."""
    window = mapping.window or USUAL_WINDOW
    return None if window == "none" else np.full(lines, independent_share(window))


def _noise(lines: CommonLines, mapping: FrfMap) -> ResponseNoise:
    if mapping.uncertainty is not None:
        text = f"sigma is {100 * mapping.uncertainty:.3g} % of each response, as the map states"
        return ResponseNoise(mapping.uncertainty**2 * np.abs(lines.response) ** 2, float("inf"), text)
    averages, doubt = mapping.averages, ""
    if lines.coherence is not None and averages is not None and averages > 1:
        if np.median(1.0 - lines.coherence) > NO_INFORMATION:
            text = f"sigma by the coherence of {averages} averages"
            variance = coherence_variance(lines.response, lines.coherence, averages)
            return ResponseNoise(variance, averages - 1.0, text)
        doubt = " (the coherence is one at nearly all lines, as without averages, and tells nothing)"
    elif lines.coherence is not None:
        doubt = " (the coherence tells nothing of sigma without the number of `averages` in the map)"
    window = mapping.window or USUAL_WINDOW
    scatter = scatter_variance(lines.frequency, lines.response, window)
    if scatter is None:
        return ResponseNoise(np.zeros(lines.response.shape), float("inf"), NO_UNCERTAINTY + doubt)
    assumed = "" if mapping.window else ", which is assumed"
    text = f"sigma by the scatter of neighboring lines, window `{window}`{assumed}{doubt}"
    text += "; errors that are smooth over frequency (leakage, calibration, mass loading) are not in it"
    return ResponseNoise(scatter, SCATTER_DOF, text)


def coherence_of(lines: CommonLines, variance: Array, averages: int | None) -> Array:
    """Return the coherence (k, c) of the file, or that which belongs to the variance."""
    if lines.coherence is not None:
        return np.clip(lines.coherence, 0.0, 1.0)
    power = np.abs(lines.response) ** 2
    return np.asarray(power / np.maximum(power + variance * max((averages or 2) - 1, 1), np.finfo(float).tiny))
