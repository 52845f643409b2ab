"""Names of the estimators and interpolations of frequency responses. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

AUTO, PERIODIC, LOCAL_RATIONAL, LOCAL_POLYNOMIAL = "auto", "periodic", "lrm", "lpm"
AVERAGED_ESTIMATORS = ("h1", "h2", "hv")
"""Estimators from averaged spectra."""
IMPORTED = "imported"
"""Estimator of responses that another program has estimated."""
Estimator = Literal["auto", "periodic", "lrm", "lpm", "h1", "h2", "hv"]
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
"""All estimators; the first is the default."""
Interpolation = Literal["local", "spline", "first-order", "nearest"]
INTERPOLATIONS: tuple[Interpolation, ...] = get_args(Interpolation)
"""How a measured response is interpolated; the first is the default."""

CONTRADICTING_RESPONSES = "responses of several sweeps contradict each other: "
"""How the finding begins that two sweeps of one component do not agree; responses keep it among their findings."""


def has_contradicting_responses(findings: tuple[str, ...] | None) -> bool:
    """Return whether the findings on the sweeps say that responses contradict each other."""
    return any(text.startswith(CONTRADICTING_RESPONSES) for text in findings or ())
