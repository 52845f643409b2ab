"""Data reduction for a six-component rotor balance, from raw volts to rotor-harmonic hub loads."""

__version__ = "0.1.0"
