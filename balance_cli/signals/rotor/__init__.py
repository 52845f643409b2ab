"""Azimuth of the rotor, and the harmonics of a run with their noise."""
