"""Terms of temperature of a calibration, for JSON and as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.calibration.temperature_terms import TemperatureTerms


def temperature_summary(calibration: Calibration) -> dict[str, Any] | None:
    """Terms of each channel with standard error; None where temperature has no effect or is not known."""
    terms = calibration.temperature
    if terms is None:
        return None
    return {
        "reference_degc": terms.reference,
        "lowest_degc": terms.lowest,
        "highest_degc": terms.highest,
        "channels": {name: _channel_terms(terms, at) for at, name in enumerate(terms.channel_names)},
    }


def _channel_terms(terms: TemperatureTerms, channel: int) -> dict[str, dict[str, float]]:
    at = np.flatnonzero(terms.coefficients[:, channel])
    values = terms.coefficients[at, channel].tolist()
    sigmas = np.sqrt(np.diag(terms.covariance[channel])[at]).tolist()
    named = zip(terms.names(channel), values, sigmas, strict=True)
    return {name: {"value": value, "sigma": sigma} for name, value, sigma in named}


def temperature_text(calibration: Calibration) -> Iterator[str]:
    """Lines on what temperature does to each channel, in percent of its largest reading."""
    terms = calibration.temperature
    if terms is None:
        return
    yield (
        f"temperature: readings refer to {terms.reference:.1f} degC, by terms from {terms.lowest:.1f} to "
        f"{terms.highest:.1f} degC"
    )
    trim = next(iter(calibration.trims.values()))
    for at, name in enumerate(terms.channel_names):
        if name not in trim.channel_names or not terms.names(at):
            continue
        response = np.abs(trim.C0[trim.channel_names.index(name)]) * trim.calibrated_range
        shift = 100.0 * terms.coefficients[0, at] / response.max()
        main = int(np.argmax(response))
        drift = 100.0 * terms.coefficients[1 + main, at] / trim.C0[trim.channel_names.index(name), main]
        yield (
            f"  {name:12s} zero {shift:+.3g} % of its largest reading per K, "
            f"sensitivity to {trim.components[main]} {drift:+.3g} % per K"
        )
