"""Identification in the form of the 1985 paper: sensor forces as states, free matrices, LS and ML (docs/theory)."""
