"""What a plan can aim at."""

from __future__ import annotations

from typing import Literal, get_args

Aim = Literal["both", "effects", "loads"]
AIMS: tuple[Aim, ...] = get_args(Aim)
