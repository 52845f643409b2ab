"""What a plan can aim at, and the terms that a static schedule is to tell."""

from __future__ import annotations

from typing import Literal, get_args

Aim = Literal["both", "effects", "loads"]
AIMS: tuple[Aim, ...] = get_args(Aim)

TermSet = Literal["linear", "quadratic", "all"]
TERM_SETS: tuple[TermSet, ...] = get_args(TermSet)
