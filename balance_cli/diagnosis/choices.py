"""What a diagnosis assumes if nobody says otherwise, for commands that state it without loading a diagnosis."""

from __future__ import annotations

SIGNIFICANCE_LEVEL = 0.003
"""Bonferroni-corrected p-value below which an effect is accepted: one false alarm in 300 campaigns."""
