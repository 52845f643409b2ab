"""Names of the estimators of frequency responses. Imports nothing, so that the command line can offer them."""

from __future__ import annotations

AUTO, PERIODIC, LOCAL_RATIONAL, LOCAL_POLYNOMIAL = "auto", "periodic", "lrm", "lpm"
AVERAGED_ESTIMATORS = ("h1", "h2", "hv")
"""Estimators from averaged spectra."""
ESTIMATORS = (AUTO, PERIODIC, LOCAL_RATIONAL, LOCAL_POLYNOMIAL, *AVERAGED_ESTIMATORS)
"""All estimators; the first is the default."""
