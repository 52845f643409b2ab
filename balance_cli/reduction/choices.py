"""Names that the user of a reduction chooses from: methods, load models. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

HARMONIC, KALMAN, SMOOTHER = "harmonic", "kalman", "smoother"
METHODS = (HARMONIC, KALMAN, SMOOTHER)
"""How loads are reduced; the first is the default."""
FREQUENCIES = "frequencies"
"""The method of loads at given frequencies in place of rotor harmonics."""

HARMONICS, RANDOM, FREE = "harmonics", "random", "free"
LoadModel = Literal["harmonics", "random", "free"]
LOAD_MODELS: tuple[LoadModel, ...] = get_args(LoadModel)
"""What a filter or smoother assumes of the loads; the first is the default."""
LOAD_MODEL_TEXTS = {
    HARMONICS: "harmonics locked to the azimuth, and random loads",
    RANDOM: "random loads",
    FREE: "any loads within the band",
}

ITERATIVE, NON_ITERATIVE = "iterative", "non-iterative"
MEAN_LOAD_METHODS = (ITERATIVE, NON_ITERATIVE)
"""How mean and static loads are computed where a calibration has both models (`calibration.load_method` chooses)."""

TABLE_SUFFIXES = (".csv", ".h5")
"""File names of a table of loads end so."""
MOST_HARMONICS = 64
"""Highest harmonic that can be asked for: the eighth multiple of eight blades."""
