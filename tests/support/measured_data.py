"""Where measured data and files of other programs are looked for; tests of them are skipped where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

SHARED = Path(os.environ.get("BALANCE_SHARED", Path(__file__).parents[3] / "shared"))
"""A folder beside the project, or the one that the environment names."""
