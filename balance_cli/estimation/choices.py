"""Names that the user of an identification chooses from, and the limit of a good fit. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["ls", "ml", "ls+ml", "computed"]
METHODS: tuple[Method, ...] = get_args(Method)
"""How a model is made: least squares, maximum likelihood, both, or computed from the geometry without a fit."""

Form = Literal["physical", "paper"]
FORMS: tuple[Form, ...] = get_args(Form)
"""Physical parameters with priors, or the six-sensor state form of the 1985 paper; the first is the default."""

Damping = Literal["diagonal", "full"]
DAMPING_FORMS: tuple[Damping, ...] = get_args(Damping)
"""Damping matrix of the paper's form; the first is the default."""

GOOD_FIT_CHI2_PER_DOF = 1.2
"""Largest chi-square per degree of freedom of a model that describes its data (verdict `explained`).

With the thousands of degrees of freedom of a campaign, chance alone stays within a few hundredths of 1. The rest of the
margin allows for the noise level, which is itself estimated from the records.
"""
